// How large models are, and at which scale they are shown first.

import assert from "node:assert/strict";
import { test } from "node:test";
import type { Size } from "../src/objects/glb_size";
import { fittingScale, sizeOf } from "../src/objects/size";

const bytes = (text: string): Uint8Array<ArrayBuffer> => new Uint8Array(new TextEncoder().encode(text));
const close = (size: Size | null, to: readonly number[]): void => {
  assert.ok(size !== null);
  to.forEach((side, axis) => assert.ok(Math.abs(size[axis]! - side) < 1e-6, `${size} is not ${to}`));
};

/** A GLB of one accessor's box, below nodes. */
function glb(nodes: readonly object[]): Uint8Array<ArrayBuffer> {
  const text = JSON.stringify({ scene: 0, scenes: [{ nodes: [0] }], nodes, meshes: [{ primitives: [{ attributes: { POSITION: 0 } }] }], accessors: [{ min: [-1, 0, -2], max: [1, 4, 2] }] });
  const padded = bytes(text.padEnd(Math.ceil(text.length / 4) * 4));
  const data = new Uint8Array(20 + padded.length);
  const words = new DataView(data.buffer);
  [0x46546c67, 2, data.length, padded.length, 0x4e4f534a].forEach((word, i) => words.setUint32(4 * i, word, true));
  data.set(padded, 20);
  return data;
}

test("of a GLB, with the transforms of its nodes", () => {
  close(sizeOf("glb", glb([{ mesh: 0 }])), [2, 4, 4]);
  const half = Math.SQRT1_2; // a quarter turn about x: height becomes depth
  close(sizeOf("glb", glb([{ children: [1], scale: [0.5, 0.5, 0.5] }, { mesh: 0, rotation: [half, 0, 0, half], translation: [5, 5, 5] }])), [1, 2, 2]);
  close(sizeOf("glb", glb([{ mesh: 0, matrix: [0.01, 0, 0, 0, 0, 0.01, 0, 0, 0, 0, 0.01, 0, 0, 0, 0, 1] }])), [0.02, 0.04, 0.04]);
  assert.equal(sizeOf("glb", glb([{ children: [0] }])), null); // a circle
  assert.equal(sizeOf("glb", bytes("no GLB")), null);
});

test("of OBJ, STL and PLY", () => {
  close(sizeOf("obj", bytes("# box\nv 0 0 0\nvn 9 9 9\nv 1 2 -3\nf 1 2 1\n")), [1, 2, 3]);
  close(sizeOf("stl", bytes("solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 2 3\nendloop\n")), [1, 3, 2]);
  const stl = new Uint8Array(84 + 50);
  const view = new DataView(stl.buffer);
  view.setUint32(80, 1, true);
  [0, 0, 1, 0, 0, 0, 10, 0, 0, 0, 20, 30].forEach((value, i) => view.setFloat32(84 + 4 * i, value, true));
  close(sizeOf("stl", stl), [10, 30, 20]);
  close(sizeOf("ply", bytes("ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n1 2 3\n")), [1, 3, 2]);
  const head = bytes("ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\nproperty uchar red\nend_header\n");
  const ply = new Uint8Array(head.length + 50);
  ply.set(head);
  const body = new DataView(ply.buffer, head.length);
  [1, 2, 3].forEach((value, i) => body.setFloat64(25 + 8 * i, value, true));
  close(sizeOf("ply", ply), [1, 3, 2]);
  assert.equal(sizeOf("ply", bytes("ply\nelement face 1\nend_header\n")), null);
  assert.equal(sizeOf("obj", bytes("f 1 2 3")), null);
});

test("things of a usual size keep it, others are shown 30 cm long", () => {
  assert.equal(fittingScale([0.2, 0.3, 0.2], "glb"), 1);
  assert.equal(fittingScale([20, 30, 20], "obj"), 0.01); // centimetres
  assert.equal(fittingScale([200, 300, 200], "stl"), 0.001); // millimetres
  assert.equal(fittingScale([2, 1.5, 2], "glb"), 0.15); // a table: 30 cm of 2 m
  assert.equal(fittingScale([165, 154, 114], "glb"), 0.0018); // 1.65 m in centimetres
  assert.equal(fittingScale([0.003, 0.002, 0.001], "glb"), 100);
});

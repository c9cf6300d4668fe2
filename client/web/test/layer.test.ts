// The surface that a layer lies on, and where another camera sees it.

import assert from "node:assert/strict";
import { test } from "node:test";
import { lensOf, worldFromCamera } from "../src/capture/axes";
import { type DepthPart, type LayerMesh, meshOf } from "../src/local/layer_mesh";
import { clipFromCamera, type View, viewOf } from "../src/local/view_matrix";
import { type Measured, project, seenFrom, surfaceAt } from "../src/objects/picking";

const SCALE_M = 0.001;

function partOf(width: number, height: number, depth: (x: number, y: number) => number): DepthPart {
  const units = Uint16Array.from({ length: width * height }, (_, i) => Math.round(depth(i % width, Math.floor(i / width))));
  return { x: 30, y: 20, width, height, depth: units, scale_m: SCALE_M };
}

function triangles({ vertices, indices }: LayerMesh): number[][][] {
  const corner = (i: number): number[] => [...vertices.subarray(3 * i, 3 * i + 3)];
  return Array.from({ length: indices.length / 3 }, (_, i) => [...indices.subarray(3 * i, 3 * i + 3)].map(corner));
}

const area = ([a, b, c]: number[][]): number => Math.abs((b![0]! - a![0]!) * (c![1]! - a![1]!) - (c![0]! - a![0]!) * (b![1]! - a![1]!)) / 2;

test("a plane is one surface without cracks, at the depth it has there", () => {
  const inverse = (x: number, y: number): number => 0.001 + 5e-6 * x - 3e-6 * y;
  const mesh = meshOf(partOf(12, 9, (x, y) => 1 / inverse(x, y)));
  assert.equal(mesh.vertices.length, 3 * 13 * 10);
  assert.equal(mesh.indices.length, 6 * 12 * 9);
  for (let i = 0; i < mesh.vertices.length; i += 3) {
    const [x, y, z] = [mesh.vertices[i]! - 30, mesh.vertices[i + 1]! - 20, mesh.vertices[i + 2]!];
    const within = [Math.min(11, Math.max(0, x)), Math.min(8, Math.max(0, y))] as const; // beyond the outermost pixels' middles nothing is known
    assert.ok(Math.abs(z - SCALE_M / inverse(...within)) < 0.006 * z, `${x}, ${y}: ${z}`);
  }
  const covered = triangles(mesh).reduce((sum, each) => sum + area(each), 0);
  assert.ok(Math.abs(covered - 12 * 9) < 1e-3);
});

test("where depth jumps the surface is cut, and where there is none there is a hole", () => {
  const mesh = meshOf(partOf(10, 8, (x, y) => (x === 7 && y === 3 ? 0 : x < 5 ? 600 : 1000)));
  for (const each of triangles(mesh)) {
    const depths = each.map((corner) => corner[2]!);
    assert.ok(Math.max(...depths) - Math.min(...depths) < 1e-6);
  }
  const near = triangles(mesh).filter((each) => each[0]![2]! < 0.8);
  assert.equal(near.length, 2 * 5 * 8);
  assert.equal(triangles(mesh).length, 2 * (10 * 8 - 1));
  assert.equal(Math.max(...near.flat().map((corner) => corner[0]!)), 30 + 5 - 0.5);
});

test("a steep floor is not cut", () => {
  const mesh = meshOf(partOf(4, 60, (_, y) => 40_000 / (y + 25)));
  assert.equal(mesh.vertices.length, 3 * 5 * 61);
});

test("of a large part cells are larger than pixels, and cover it all", () => {
  const [width, height] = [601, 403];
  const mesh = meshOf(partOf(width, height, () => 900));
  assert.ok(mesh.indices.length / 6 <= 1 << 16);
  const covered = triangles(mesh).reduce((sum, each) => sum + area(each), 0);
  assert.ok(Math.abs(covered - width * height) < 1, `${covered}`);
});

const FRAME = new Float32Array([0.8, 0, -0.6, 0, 0, 1, 0, 0, 0.6, 0, 0.8, 0, 0.1, -0.2, 0.3, 1]);
const NOW = new Float32Array([0.6, 0, -0.8, 0, 0, 1, 0, 0, 0.8, 0, 0.6, 0, 0.15, -0.1, 0.35, 1]);
const PROJECTION = new Float32Array([1.5, 0, 0, 0, 0, 2, 0, 0, 0.1, -0.2, -1, -1, 0, 0, -0.1, 0]);

function onScreen(clip: Float32Array, [x, y, z]: readonly number[]): number[] {
  const at = (row: number): number => clip[row]! * x! + clip[4 + row]! * y! + clip[8 + row]! * z! + clip[12 + row]!;
  return [at(0) / at(3), at(1) / at(3)];
}

test("a point of one camera is seen by another where the world says that it is", () => {
  const [pose, now] = [worldFromCamera(FRAME), worldFromCamera(NOW)];
  const point = [0.1, -0.05, 0.9] as const;
  const world = [0, 1, 2].map((row) => pose[4 * row]! * point[0] + pose[4 * row + 1]! * point[1] + pose[4 * row + 2]! * point[2] + pose[4 * row + 3]!);
  const lens = lensOf(PROJECTION, 640, 480);
  const pixel = project(lens, now, world as unknown as [number, number, number])!;
  const expected = [(2 * pixel.x + 1) / 640 - 1, 1 - (2 * pixel.y + 1) / 480];
  const view: View = { projectionMatrix: PROJECTION, transform: { matrix: NOW } };
  for (const each of [view, viewOf(lens, now)]) {
    const found = onScreen(clipFromCamera(each, pose), point);
    assert.ok(Math.hypot(found[0]! - expected[0]!, found[1]! - expected[1]!) < 1e-5, `${found} ${expected}`);
  }
});

test("a finger on the newest picture finds the surface that an older frame has measured", () => {
  const [pose, now] = [worldFromCamera(FRAME), worldFromCamera(NOW)];
  const lens = { width: 160, height: 120, fx: 140, fy: 140, cx: 79.5, cy: 59.5 };
  const metres = (x: number): number => (x >= 90 ? 0.6 : 1.1); // a box before a wall
  const depth = Uint16Array.from({ length: 160 * 120 }, (_, i) => Math.round(1000 * metres(i % 160)));
  const measured = { camera: lens, world_from_camera: pose, up: [0, 1, 0], depth } as const;
  const seen = seenFrom(seenFrom(measured, pose), now) as Measured;
  for (const [x, y] of [[40, 60], [70, 30], [110, 50], [125, 80]] as const) {
    const z = metres(x);
    const place = surfaceAt(measured, { x, y })!;
    const pixel = project(lens, now, place)!;
    const found = surfaceAt(seen, pixel)!;
    const error_m = Math.hypot(found[0] - place[0], found[1] - place[1], found[2] - place[2]);
    assert.ok(error_m < 0.01 * z, `${x}, ${y}: ${error_m} m`);
    const unmoved = surfaceAt(measured, pixel);
    assert.ok(unmoved === null || Math.hypot(unmoved[0] - place[0], unmoved[2] - place[2]) > 0.05);
  }
  assert.equal(surfaceAt(seen, { x: 2000, y: 60 }), null);
});

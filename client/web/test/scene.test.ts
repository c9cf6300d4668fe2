// What is asked of the server while objects are placed, dragged and removed.

import assert from "node:assert/strict";
import { test } from "node:test";
import { toGlb } from "../src/objects/glb";
import { sizeOfGlb } from "../src/objects/glb_size";
import { type Model, Scene } from "../src/objects/scene";
import { ball, cube, vase } from "../src/objects/shapes";
import { pixelAt } from "../src/objects/touch";
import type { Asked } from "../src/session";

const MODEL: Model = { name: "Box", format: "glb", data: new Uint8Array(4), radius_m: 0.1, height_m: 0.1, scale: 1 };

function asked(): { scene: Scene; log: Asked[] } {
  const log: Asked[] = [];
  return { scene: new Scene((request) => log.push(request) - 1, () => undefined, "x"), log };
}

test("a drag asks for its last place only, once the one before is answered", () => {
  const { scene, log } = asked();
  const box = scene.place(MODEL, [0, 0, 0]);
  for (let i = 1; i <= 5; i++) scene.change(box, { position: [i, 0, 0] });
  assert.deepEqual(log.map((each) => each.type), ["place_object"]);
  scene.acknowledge(0, null);
  const last = log.at(-1)!;
  assert.ok(log.length === 2 && last.type === "move_object");
  assert.deepEqual(last.position_m, [5, 0, 0]);
  scene.remove(box);
  scene.acknowledge(1, null);
  assert.equal(log.at(-1)!.type, "remove_object");
  scene.acknowledge(2, null);
  assert.deepEqual([scene.placed.length, log.length], [0, 3]);
});

test("a refused object is gone, and it is said why", () => {
  const { scene } = asked();
  scene.place(MODEL, [0, 0, 0]);
  assert.equal(scene.acknowledge(0, "it is no GLB"), "Box: it is no GLB");
  assert.deepEqual([scene.placed.length, scene.selected], [0, null]);
});

test("an object that could not be saved is there, and it is said", () => {
  const { scene } = asked();
  scene.place(MODEL, [0, 0, 0]);
  assert.equal(scene.acknowledge(0, "not saved: the disk is full"), "Box: not saved: the disk is full");
  assert.equal(scene.placed.length, 1);
});

test("a server that has begun anew is given everything again, where it stands now", () => {
  const { scene, log } = asked();
  const box = scene.place(MODEL, [0, 0, 0]);
  scene.acknowledge(0, null);
  scene.change(box, { position: [1, 2, 3], yaw_deg: 30 });
  scene.placeAgain();
  const again = log.at(-1)!;
  assert.ok(again.type === "place_object");
  assert.deepEqual([again.position_m, again.yaw_deg], [[1, 2, 3], 30]);
});

test("undo brings back what stood before, drag by drag, also what was deleted", () => {
  const { scene, log } = asked();
  let request = 0;
  const answer = (): void => {
    while (request < log.length) scene.acknowledge(request++, null);
  };
  scene.remember();
  const box = scene.place(MODEL, [0, 0, 0]);
  answer();
  scene.remember();
  for (let i = 1; i <= 5; i++) scene.change(box, { position: [i, 0, 0] });
  answer();
  scene.remember(); // a touch that moves nothing
  scene.remember();
  scene.remove(box);
  answer();
  assert.equal(scene.placed.length, 0);
  assert.ok(scene.undo());
  answer();
  const back = log.at(-1)!;
  assert.ok(back.type === "place_object" && back.object === box.id);
  assert.deepEqual(back.position_m, [5, 0, 0]);
  assert.ok(scene.undo());
  answer();
  const moved = log.at(-1)!;
  assert.ok(moved.type === "move_object");
  assert.deepEqual(moved.position_m, [0, 0, 0]);
  assert.ok(scene.undo());
  answer();
  assert.equal(log.at(-1)!.type, "remove_object");
  assert.deepEqual([scene.canUndo, scene.undo(), scene.placed.length], [false, false, 0]);
});

test("an object whose spot the server looks for stands where the server says, and is moved from there", () => {
  const { scene, log } = asked();
  const box = scene.place(MODEL, { on: "table" });
  const asks = log.at(-1)!;
  assert.ok(asks.type === "place_object" && asks.spot?.on === "table" && asks.position_m === undefined);
  scene.acknowledge(0, null);
  scene.change(box, { yaw_deg: 90 }); // nobody knows where it stands
  assert.equal(log.length, 1);
  scene.remember();
  scene.found({ object: "another", position_m: [9, 9, 9], scale: 1, yaw_deg: 0 });
  scene.found({ object: box.id, position_m: [1, 2, 3], scale: 0.5, yaw_deg: 10 });
  scene.change(box, { position: [2, 2, 3] });
  const moved = log.at(-1)!;
  assert.ok(moved.type === "move_object");
  assert.deepEqual([moved.position_m, moved.scale, moved.yaw_deg], [[2, 2, 3], 0.5, 10]);
  scene.acknowledge(1, null);
  assert.ok(scene.undo());
  assert.deepEqual(box.position, [1, 2, 3]);
});

for (const [name, shape, size] of [["vase", vase(), [0.154, 0.24, 0.154]], ["ball", ball(), [0.16, 0.16, 0.16]], ["cube", cube(), [0.15, 0.15, 0.15]]] as const) {
  test(`the ${name} stands on its foot, closed, its triangles outwards`, () => {
    const found = sizeOfGlb(toGlb(shape))!;
    found.forEach((side, axis) => assert.ok(Math.abs(side - size[axis]!) < 1e-3, `${name} ${axis} ${side}`));
    const at = (i: number): number[] => [...shape.positions.subarray(3 * i, 3 * i + 3)];
    let volume = 0;
    for (let i = 0; i < shape.triangles.length; i += 3) {
      const [a, b, c] = [0, 1, 2].map((k) => at(shape.triangles[i + k]!)) as [number[], number[], number[]];
      volume += (a[0]! * (b[1]! * c[2]! - b[2]! * c[1]!) - a[1]! * (b[0]! * c[2]! - b[2]! * c[0]!) + a[2]! * (b[0]! * c[1]! - b[1]! * c[0]!)) / 6;
    }
    assert.ok(volume > 0.2 * size[0] * size[1] * size[2], `${volume}`);
    assert.ok(Math.abs(Math.min(...shape.positions.filter((_, i) => i % 3 === 1))) < 1e-6);
    shape.normals.forEach((value) => assert.ok(Number.isFinite(value)));
  });
}

test("a touch beside the picture, in the bars that keep its shape, is none", () => {
  const box = { left: 10, top: 20, width: 400, height: 200 } as DOMRect;
  const size = { width: 100, height: 100 };
  assert.equal(pixelAt(box, size, 50, 100), null);
  assert.deepEqual(pixelAt(box, size, 210, 120), { x: 49.5, y: 49.5 });
});

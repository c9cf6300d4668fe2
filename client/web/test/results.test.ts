// The page of results: what needs no browser.

import assert from "node:assert/strict";
import { test } from "node:test";
import { niceStep, topOf } from "../src/results/charts";
import { frameAt, lastDuration, showTimes } from "../src/results/clock";
import { cameraFile, compositeFile, type FrameRow, fromBase64, type LightRow } from "../src/results/data";
import { Pace } from "../src/results/pace";
import { certainty, clock, horizontal, placeName, whence } from "../src/results/words";
import type { Vector3 } from "../src/sh";

const UP: Vector3 = [0, -1, 0];
/** A camera of OpenCV's axes that stands upright and looks along world z: x is right. */
const POSE = [1, 0, 0, 0.5, 0, 1, 0, 0.2, 0, 0, 1, 3];

const close = (a: readonly number[], b: readonly number[]): void => a.forEach((value, i) => assert.ok(Math.abs(value - b[i]!) < 1e-9, `${a} is not ${b}`));

test("frames are shown when they were taken, pauses shortened, time that stands still at the source's rate", () => {
  close(showTimes([5, 5.1, 5.4, 5.4, 5.3, 20], 10), [0, 0.1, 0.4, 0.5, 0.6, 1.6]);
  close(showTimes([1, 1], 0), [0, 1 / 30]);
  assert.deepEqual(showTimes([], 30), []);
});

test("the frame that is due", () => {
  const times = [0, 0.1, 0.4];
  assert.deepEqual([-1, 0, 0.09, 0.1, 0.39, 0.4, 9].map((at) => frameAt(times, at)), [0, 0, 0, 1, 1, 2, 2]);
  assert.equal(frameAt([0], 5), 0);
  close([lastDuration(times, 30), lastDuration([0], 25)], [0.2, 0.04]);
});

test("where light comes from, for somebody behind the camera", () => {
  const said = (towards: Vector3): string => whence(towards, UP, POSE)!.text;
  assert.equal(said([0, -1, 0]), "from above");
  assert.equal(said([0, 1, 0]), "from below");
  assert.equal(said([1, 0, 0]), "from the side, on the right");
  assert.equal(said([-0.7, -0.7, 0.7]), "from above, ahead on the left");
  assert.equal(said([0, -0.6, -0.8]), "from above, behind the camera");
  assert.equal(said([0, 0.6, 0.8]), "from below, ahead");
  assert.equal(whence([0, 0, 0], UP, POSE), null);
  const found = whence([0.5, -Math.SQRT1_2, 0.5], UP, POSE)!;
  close([found.elevation_deg, found.azimuth_deg], [45, 45]);
});

test("horizontal axes of a camera that is tilted, and of one that looks straight down", () => {
  const tilted = [1, 0, 0, 0, 0, 0.8, 0.6, 0, 0, -0.6, 0.8, 0];
  close(horizontal(UP, tilted)[0], [0, 0, 1]);
  close(horizontal(UP, tilted)[1], [1, 0, 0]);
  const down = [1, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0, 0];
  close(horizontal(UP, down).flat().map(Math.abs), [0, 0, 1, 1, 0, 0]);
});

test("how sure a direction is", () => {
  const light = { spread: 12.4, valid: true } as LightRow;
  assert.equal(certainty(light), "Sure to about 12°");
  assert.equal(certainty({ ...light, spread: 40, valid: false }), "Not sure: may be off by 40°");
  assert.equal(certainty({ ...light, seen: 0 }), "A guess: no scanned surface is seen from there");
  assert.equal(certainty({ ...light, spread: null }), "Sure to 15° or better");
  assert.equal(certainty({ ...light, spread: null, valid: false }), "Not known: the pictures do not fix the direction");
});

test("names, times and files", () => {
  assert.deepEqual([placeName(["object", 1], ["a.glb", "b.glb"]), placeName(["object", 2], []), placeName(["place", 0], [])], ["b.glb", "Object 3", "Place 1"]);
  assert.deepEqual([clock(0), clock(75.04), clock(600)], ["0:00.0", "1:15.0", "10:00.0"]);
  const row = { frame: 12 } as FrameRow;
  assert.deepEqual([compositeFile(row), cameraFile({ ...row, frame: 1234567 })], ["frames/000012.png", "camera/1234567.jpg"]);
  assert.deepEqual([...fromBase64("AP8Q")], [0, 255, 16]);
});

test("what is slow is drawn less often while frames are played, and the last one at once", async () => {
  let now = 0;
  const drawn: number[] = [];
  const ends: (() => void)[] = [];
  const pace = new Pace(
    (index) => {
      drawn.push(index);
      return new Promise((done) => ends.push(done));
    },
    () => now,
  );
  const settle = (): Promise<void> => new Promise((done) => setImmediate(done));
  pace.ask(0, true);
  now = 100;
  pace.ask(1, true); // the first is still being drawn
  await settle();
  assert.deepEqual(drawn, [0]);
  ends.shift()!();
  await settle();
  pace.ask(2, true);
  assert.deepEqual(drawn, [0]); // it took 100 ms: the next is drawn 400 ms later
  now = 499;
  pace.ask(3, true);
  assert.deepEqual(drawn, [0]);
  pace.ask(4, false); // and where playing stops
  assert.deepEqual(drawn, [0, 4]);
});

test("a frame that compiles does not flatten the chart", () => {
  assert.equal(topOf([3000, 150, 160, 200, 140]), 200);
  assert.equal(topOf([100, 150, 250]), 250);
  assert.equal(topOf([]), 1);
  assert.deepEqual([0.7, 1, 13, 30, 61].map(niceStep), [1, 1, 20, 50, 100]);
});

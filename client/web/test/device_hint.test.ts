// What devices are told, by what their browsers call themselves.

import assert from "node:assert/strict";
import { test } from "node:test";
import { deviceOf, hintFor } from "../src/device_hint";

const IPHONE = "Mozilla/5.0 (iPhone; CPU iPhone OS 18_5 like Mac OS X) AppleWebKit/605.1.15 (KHTML, like Gecko) Version/18.5 Mobile/15E148 Safari/604.1";
const IPAD = "Mozilla/5.0 (Macintosh; Intel Mac OS X 10_15_7) AppleWebKit/605.1.15 (KHTML, like Gecko) Version/18.5 Safari/605.1.15";
const QUEST = "Mozilla/5.0 (X11; Linux x86_64; Quest 3) AppleWebKit/537.36 (KHTML, like Gecko) OculusBrowser/38.0.0.7 Chrome/136.0.7103.177 VR Safari/537.36";
const ANDROID = "Mozilla/5.0 (Linux; Android 15; Pixel 9) AppleWebKit/537.36 (KHTML, like Gecko) Chrome/136.0.0.0 Mobile Safari/537.36";

test("devices", () => {
  assert.deepEqual([deviceOf(IPHONE, 5), deviceOf(IPAD, 5), deviceOf(IPAD, 0), deviceOf(QUEST, 5), deviceOf(ANDROID, 5)], ["iphone", "iphone", "other", "quest", "other"]);
});

test("an iPhone is told what it can do, with a camera only where the page may use one", () => {
  const told = hintFor("iphone", { xr: "none", camera: null })!;
  assert.match(told, /measure no depth/);
  assert.match(told, /plain camera/);
  assert.doesNotMatch(hintFor("iphone", { xr: "none", camera: "not over http" })!, /plain camera/);
});

test("a headset is told to watch, and a phone that has all nothing", () => {
  assert.match(hintFor("quest", { xr: null, camera: "none" })!, /watch a room/);
  assert.match(hintFor("quest", { xr: "none", camera: "none" })!, /no pictures of its cameras/);
  assert.equal(hintFor("other", { xr: null, camera: null }), null);
});

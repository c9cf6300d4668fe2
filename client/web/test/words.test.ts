// What the page says in words, and when it tries again.

import assert from "node:assert/strict";
import { test } from "node:test";
import { LADDER } from "../src/capture/adaptive";
import { pause_ms, streamUrl } from "../src/connection";
import { FrameRate } from "../src/rate";
import { describeBound, describeDirection, describePoint, describeSending, milliseconds, number, plain } from "../src/words";

test("directions", () => {
  assert.equal(describeDirection([0, -1, 0]), "from behind the camera, 90° up");
  assert.equal(describeDirection([0, 0, 1]), "from ahead");
  assert.equal(describeDirection([-Math.SQRT1_2, 0, -Math.SQRT1_2]), "from behind the camera, 45° left");
  assert.equal(describeDirection([0.5, 0.5, Math.SQRT1_2]), "from ahead, 35° right, 30° down");
  assert.equal(describeDirection([0, 0, 0]), "none");
});

test("bounds", () => {
  assert.equal(describeBound(null), "no bound is known");
  assert.equal(describeBound(0), "changes nothing");
  assert.match(describeBound(0.31), /^invisible: at most 0\.31\/255$/);
  assert.match(describeBound(2), /^hardly visible/);
  assert.match(describeBound(40), /^may be visible: at most 40\/255$/);
});

test("operating points", () => {
  const point = { settings: "--preset reg8 --rays 49", reason: "asked for", expected_ms: null, light_error_deg: null };
  assert.equal(describePoint(point), "--preset reg8 --rays 49 (asked for)");
  assert.equal(
    describePoint({ ...point, expected_ms: 131.5, light_error_deg: 3.25 }),
    "--preset reg8 --rays 49 (asked for), 132 ms expected, light off by 3.25° where measured",
  );
  assert.equal(describePoint(null), "none: the camera is lost");
});

test("numbers", () => {
  assert.equal(number(1.2345), "1.23");
  assert.equal(number(1234.5), "1235");
  assert.equal(number(123456), "1.2e5");
  assert.equal(number(0), "0");
  assert.equal(number(Number.POSITIVE_INFINITY), "∞");
  assert.equal(milliseconds(3.14159), "3.1");
  assert.equal(milliseconds(99.96), "100");
  assert.equal(plain("radiance_transfer"), "Radiance transfer");
});

test("frame rate", () => {
  const rate = new FrameRate(1000);
  assert.equal(rate.value(0), null);
  for (const time of [0, 100, 200, 300]) rate.add(time);
  assert.equal(rate.value(300), 10);
  assert.equal(rate.value(1150), 10); // 200 and 300 are left
  assert.equal(rate.value(1250), null); // 300 alone says nothing
  assert.equal(rate.value(5000), null);
});

test("what is sent is said as a person would", () => {
  const [best, , , , half] = LADDER;
  assert.equal(describeSending({ as: "jpeg", coding: best! }, null), "full size, quality 90");
  assert.equal(describeSending({ as: "jpeg", coding: half! }, 6.2), "half size, quality 75, 6 frames/s");
  assert.equal(describeSending({ as: "video", coding: best! }, 14.6), "video at its full bit rate, 15 frames/s");
  assert.equal(describeSending({ as: "video", coding: half! }, 2.84), "video at 20 % of its bit rate, 2.8 frames/s");
  assert.equal(describeSending({ as: "recorded" }, 9), "as recorded, 9 frames/s");
});

test("pauses grow to a limit and differ between pages", () => {
  const longest = [1, 2, 3, 4, 5, 6, 50].map((attempt) => pause_ms(attempt, () => 0));
  assert.deepEqual(longest, [500, 1000, 2000, 4000, 8000, 15000, 15000]);
  assert.equal(pause_ms(1, () => 1), 375);
});

test("the stream is on the host the page came from", () => {
  assert.equal(streamUrl(new URL("http://tablet.local:8000/?session=a")), "ws://tablet.local:8000/v1/stream");
  assert.equal(streamUrl(new URL("https://example.org/")), "wss://example.org/v1/stream");
  const withToken = new URL("http://tablet.local:8000/?token=a%2Bb%26c&session=a");
  assert.equal(streamUrl(withToken), "ws://tablet.local:8000/v1/stream?token=a%2Bb%26c");
});

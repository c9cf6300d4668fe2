// Recordings are read message by message, whatever lies where the file is cut into pieces.

import assert from "node:assert/strict";
import { test } from "node:test";
import { encode as pack } from "@msgpack/msgpack";
import { lengthOfValue } from "../src/capture/message_length";
import { framesOf, type RecordedFrame } from "../src/capture/recording";
import { encode } from "../src/messages";
import type { CameraModel, Frame } from "../src/protocol";

const CAMERA: CameraModel = { width: 8, height: 4, fx: 8, fy: 8, cx: 3.5, cy: 1.5 };
const HELLO = encode({ type: "hello", client: "test", camera: CAMERA, wishes: { poses: "given" } });
const bye = encode({ type: "bye", reason: "" });

function frame(index: number, bytes = 96): Uint8Array<ArrayBuffer> {
  const color = { width: 8, height: 4, codec: "raw" as const, data: new Uint8Array(bytes).fill(index) };
  return encode({ type: "frame", frame: index, timestamp_s: index / 30, world_from_camera: null, color, depth: null });
}

async function readAll(parts: Uint8Array<ArrayBuffer>[]): Promise<{ found: RecordedFrame[]; said: string[] }> {
  const found: RecordedFrame[] = [];
  const said: string[] = [];
  for await (const each of framesOf(new File(parts, "kitchen.rec"), (text) => said.push(text))) found.push(each);
  return { found, said };
}

const numbers = (found: readonly { frame: Frame }[]): number[] => found.map((each) => each.frame.frame);

test("the length of every kind of value is known from its bytes, and from a part of them that there is more", () => {
  const values = [
    null, true, 0, -1, 127, 128, 70000, 2 ** 40, -129, -70000, 1.5, "", "a", "b".repeat(40), "c".repeat(300), "d".repeat(70000),
    new Uint8Array(3), new Uint8Array(300), new Uint8Array(70000), [], [1, [2, [3]]], Array.from({ length: 20 }, (_, i) => i),
    Array.from({ length: 70000 }, () => "x"), {}, { a: { b: [1, { c: new Uint8Array(5) }] } },
    Object.fromEntries(Array.from({ length: 20 }, (_, i) => [`key${i}`, i])),
  ];
  for (const value of values) {
    const bytes = pack(value);
    assert.equal(lengthOfValue(bytes), bytes.length);
    const behind = new Uint8Array([...bytes, 0xc1, 0xc1]);
    assert.equal(lengthOfValue(behind), bytes.length);
    for (const part of [0, 1, 2, 3, bytes.length >> 1, bytes.length - 1]) {
      if (part >= bytes.length) continue;
      const least = lengthOfValue(bytes.subarray(0, part));
      assert.ok(least > part && least <= bytes.length, `${part} of ${bytes.length}: ${least}`);
    }
  }
  assert.throws(() => lengthOfValue(new Uint8Array([0xc1])), /0xc1 begins no value/);
});

test("frames come in their order, with their camera, and nothing else does", async () => {
  const { found, said } = await readAll([HELLO, frame(0), bye, frame(1, 600_000), frame(2), frame(3, 300_000)]);
  assert.deepEqual(numbers(found), [0, 1, 2, 3]);
  assert.deepEqual(found[3]!.camera, CAMERA);
  assert.equal(found[1]!.frame.color!.data.length, 600_000);
  assert.ok(found[1]!.frame.color!.data.every((value) => value === 1));
  assert.deepEqual(said, []);
});

test("a file that was cut off is told, and its whole messages are good", async () => {
  for (const lost of [1, 50, frame(2).length - 1]) {
    const cut = frame(2).slice(0, -lost);
    const { found, said } = await readAll([HELLO, frame(0), frame(1), cut]);
    assert.deepEqual(numbers(found), [0, 1]);
    assert.deepEqual(said, [`kitchen.rec was cut off inside a message: its last ${cut.length} bytes were left out.`]);
  }
});

test("what is no recording is told in one sentence", async () => {
  const text = (words: string): Uint8Array<ArrayBuffer> => new TextEncoder().encode(words);
  for (const [parts, why] of [
    [[text("not a recording at all")], /no recording \(byte 0: not a message of this version\)/],
    [[frame(0)], /no recording \(byte 0: a frame before any hello\)/],
    [[HELLO, text("?")], /no recording \(byte \d+: not a message/],
    [[HELLO, new Uint8Array([0xc6, 255, 255, 255, 255])], /a message longer than any may be/],
    [[HELLO, new Uint8Array([0xc1])], /0xc1 begins no value/],
  ] as const) {
    await assert.rejects(readAll([...parts]), (error: Error) => why.test(error.message) && /probeless stream SOURCE --record FILE/.test(error.message));
  }
});

test("a recording of video is told to be one", async () => {
  const color = { width: 8, height: 4, codec: "h264" as const, data: new Uint8Array(9) };
  const video = encode({ type: "frame", frame: 0, timestamp_s: 0, world_from_camera: null, color, depth: null });
  await assert.rejects(readAll([HELLO, video]), /kitchen.rec holds h264 video, .* \(stream --record without --color h264\)/);
});

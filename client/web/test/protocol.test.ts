// The golden vectors, which the Python tests write and read, mean the same here.

import assert from "node:assert/strict";
import { readdirSync, readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { test } from "node:test";
import { inflateRawSync } from "node:zlib";
import { decode } from "@msgpack/msgpack";
import { decodeDepth, encodeDepth, filterDepth, unfilterDepth } from "../src/depth";
import { rankDepth, unrankDepth } from "../src/depth_ranks";
import { decodeServer, encode } from "../src/messages";
import type { ClientMessage, DepthImage, Frame } from "../src/protocol";

const folder = process.env["PROBELESS_GOLDEN"] ?? join(import.meta.dirname, "..", "..", "..", "tests", "golden");

function reviveBytes(_key: string, value: unknown): unknown {
  const wrapped = value as { $base64?: string } | null;
  return typeof wrapped?.$base64 === "string" ? new Uint8Array(Buffer.from(wrapped.$base64, "base64")) : value;
}

const expected = JSON.parse(readFileSync(join(folder, "messages.json"), "utf8"), reviveBytes) as Record<
  string,
  { type: string }
>;
const golden = (name: string): Uint8Array => new Uint8Array(readFileSync(join(folder, `${name}.msgpack`)));
const names = readdirSync(folder).filter((file) => file.endsWith(".msgpack")).map((file) => file.slice(0, -8));
const fromServer = new Set(["welcome", "composite", "layer", "light", "dropped", "mesh_part", "panorama", "acknowledged", "error", "bye"]);

test("there are golden vectors", () => assert.deepEqual(new Set(names), new Set(Object.keys(expected))));

for (const name of names) {
  test(`${name} means the same in Python and here`, () => {
    assert.deepEqual(decode(golden(name)), expected[name]);
    if (fromServer.has(expected[name]!.type)) assert.deepEqual(decodeServer(golden(name)), expected[name]);
    else assert.throws(() => decodeServer(golden(name)), /not a message of a server/);
    assert.deepEqual(decode(encode(expected[name] as ClientMessage)), expected[name]);
  });
}

test("what is no message is refused", () => {
  const welcome = golden("welcome");
  assert.throws(() => decodeServer(welcome.subarray(0, welcome.length - 1)));
  assert.throws(() => decodeServer(new Uint8Array([...welcome, 0])));
  assert.throws(() => decodeServer(new Uint8Array([0xdd, 255, 255, 255, 255])));
  assert.throws(() => decodeServer(new Uint8Array([0xc0])), /not a message/);
});

const [WIDTH, HEIGHT] = [10, 8] as const;
/** The formula of tests/protocol/golden.py. */
const ramp = Uint16Array.from({ length: HEIGHT * WIDTH }, (_, i) => {
  const [x, y] = [i % WIDTH, Math.floor(i / WIDTH)];
  return (x + y) % 5 === 0 ? 0 : (x * 9001 + y * 30011) % 65536;
});

test("depth that Python compressed is read bit for bit", async () => {
  const frame = decode(golden("frame_zdelta")) as Frame;
  assert.deepEqual(await decodeDepth(frame.depth!), ramp);
});

test("depth survives, whatever it is", async () => {
  for (const width of [1, 7, 64]) {
    const noise = Uint16Array.from({ length: 3 * width }, (_, i) => (i * 40503 + width * 977) % 65536);
    assert.deepEqual(unfilterDepth(filterDepth(noise, width), width), noise);
    for (const codec of ["zdelta", "zranks"] as const) assert.deepEqual(await decodeDepth(await encodeDepth(noise, width, codec)), noise);
  }
});

const written = process.env["PROBELESS_PYTHON_DEPTHS"];

test("every codec of depth that Python writes is read bit for bit", { skip: written === undefined }, async () => {
  const files = readdirSync(written!);
  assert.ok(files.length >= 6);
  for (const file of files) {
    const [codec, rows] = file.split("_") as [DepthImage["codec"], string];
    const image = { width: WIDTH, height: Number(rows), codec, data: new Uint8Array(readFileSync(join(written!, file))) };
    const depth = ramp.subarray(0, WIDTH * image.height).slice();
    assert.deepEqual(await decodeDepth(image), depth, file);
    if (codec === "zranks") assert.deepEqual(rankDepth(depth, WIDTH), new Uint8Array(inflateRawSync(image.data)));
    await assert.rejects(decodeDepth({ ...image, height: image.height + 2 }), file);
    await assert.rejects(decodeDepth({ ...image, data: image.data.subarray(0, -1) }), file);
  }
});

test("ranks that are no picture are refused", () => {
  const picture = (values: number, escapes: number, ...rest: number[]): Uint8Array => {
    const counts = new Uint32Array([values, escapes]);
    return new Uint8Array([...new Uint8Array(counts.buffer), ...rest]);
  };
  assert.deepEqual(unrankDepth(picture(2, 0, 0, 5, 0, 1, 0x20, 0), 2, 2), new Uint16Array([0, 0, 261, 261]));
  assert.throws(() => unrankDepth(new Uint8Array(7), 2, 2));
  assert.throws(() => unrankDepth(picture(2, 0, 0, 5, 0, 0, 0x20), 2, 2), /size/);
  assert.throws(() => unrankDepth(picture(2 ** 32 - 1, 2 ** 32 - 1, 0, 5, 0, 0, 0x20, 0), 2, 2), /size/);
  assert.throws(() => unrankDepth(picture(2, 0, 0, 5, 0, 0, 0x40, 0), 2, 2), /does not hold/);
  assert.throws(() => unrankDepth(picture(2, 0, 0, 5, 0, 0, 0x10, 0), 2, 2), /does not hold/);
  assert.throws(() => unrankDepth(picture(2, 1, 0, 5, 0, 0, 0, 0, 0, 0), 2, 2), /size/);
});

test("a frame as a browser writes it", async () => {
  const color = { width: WIDTH, height: HEIGHT, codec: "raw" as const, data: new Uint8Array(3 * ramp.length) };
  const depth = await encodeDepth(ramp, WIDTH);
  const data = encode({ type: "frame", frame: 3, timestamp_s: 1, world_from_camera: null, color, depth });
  const file = process.env["PROBELESS_BROWSER_FRAME"]; // read back by the Python test that runs this one
  if (file !== undefined) writeFileSync(file, data);
  assert.ok(data.length > 3 * ramp.length);
});

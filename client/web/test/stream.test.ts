// A capturing session against a server in memory: what is sent, how much at once, and what after a lost connection.

import assert from "node:assert/strict";
import { test } from "node:test";
import { decode } from "@msgpack/msgpack";
import { Adaptive } from "../src/capture/adaptive";
import { CaptureStream, type Numbered } from "../src/capture/stream";
import { encode } from "../src/messages";
import type { CameraModel, ClientMessage, Frame, ServerMessage, Wishes } from "../src/protocol";

class FakeSocket {
  static readonly OPEN = 1;
  static all: FakeSocket[] = [];
  readyState = 1;
  sent: ClientMessage[] = [];
  onopen: () => void = () => undefined;
  onmessage: ((event: { data: ArrayBuffer }) => void) | null = null;
  onclose: ((event: { code: number; reason: string }) => void) | null = null;
  constructor(readonly url: string) {
    FakeSocket.all.push(this);
  }
  static get last(): FakeSocket {
    return FakeSocket.all.at(-1)!;
  }
  send(data: Uint8Array): void {
    this.sent.push(decode(data) as ClientMessage);
  }
  close(): void {
    this.readyState = 3;
  }
  say(message: unknown): void {
    this.onmessage?.({ data: encode(message as ClientMessage).slice().buffer });
  }
}

const CAMERA: CameraModel = { width: 64, height: 48, fx: 50, fy: 50, cx: 31.5, cy: 23.5, depth_scale_m: 0.001, depth: null };
const welcome = (more: object = {}): object => ({
  type: "welcome", session: "s", server: "p", device: "d", max_inflight: 2, key: "secret", resumed: false, room: null, ...more,
});

function begin(wishes: Wishes = {}, pace: Adaptive | null = null, encoding: () => void = () => undefined): { stream: CaptureStream; wanted: () => number; heard: ServerMessage[]; frame: (number: number, camera?: CameraModel) => Numbered } {
  FakeSocket.all = [];
  Object.assign(globalThis, { WebSocket: FakeSocket });
  let wanted = 0;
  const heard: ServerMessage[] = [];
  const packed = (frame: Numbered): Promise<Frame> => {
    encoding();
    return Promise.resolve({ type: "frame", frame: frame.number, timestamp_s: frame.timestamp_s, world_from_camera: frame.world_from_camera });
  };
  const stream = new CaptureStream("ws://host/v1/stream", { client: "test", keep_s: 30, wishes }, packed, {
    onWanted: () => wanted++,
    onState: () => undefined,
    onMessage: (message) => heard.push(message),
    say: () => undefined,
  }, pace);
  stream.start();
  const frame = (number: number, camera = CAMERA): Numbered => ({
    number, camera, timestamp_s: number, captured_ms: 0, world_from_camera: null, color: new Uint8ClampedArray(4), depth: null,
  });
  return { stream, wanted: () => wanted, heard, frame };
}

const framesOf = (socket: FakeSocket): number[] => socket.sent.filter((each) => each.type === "frame").map((each) => each.frame);

async function opened(wishes?: Wishes, pace?: Adaptive, encoding?: () => void): Promise<ReturnType<typeof begin>> {
  const session = begin(wishes, pace, encoding);
  await session.stream.offer(session.frame(0));
  FakeSocket.last.onopen();
  FakeSocket.last.say(welcome());
  return session;
}

test("hello names the camera; no more frames are under way than the server allows", async () => {
  const { stream, wanted, frame } = await opened();
  const socket = FakeSocket.last;
  const hello = socket.sent[0]!;
  assert.ok(hello.type === "hello" && hello.camera.fx === 50 && hello.keep_s === 30 && hello.resume === null);
  assert.equal(wanted(), 2); // before the camera was known, and after the welcome
  await stream.offer(frame(1));
  await stream.offer(frame(2));
  assert.equal(wanted(), 3); // two are under way: no more is asked for
  await stream.offer(frame(3));
  assert.deepEqual(framesOf(socket), [1, 2]);
  socket.say({ type: "dropped", frame: 1, reason: "replaced" });
  assert.equal(wanted(), 4);
  await stream.offer(frame(4));
  assert.deepEqual(framesOf(socket), [1, 2, 4]);
  stream.stop("");
});

test("a light is the answer where no picture is wanted, and only there", async () => {
  for (const answer of ["light", "picture"] as const) {
    const { stream, wanted, frame } = await opened({ answer });
    for (const number of [1, 2]) await stream.offer(frame(number));
    FakeSocket.last.say({ type: "light", frame: 1, sh: [] });
    assert.equal(wanted(), answer === "light" ? 4 : 3);
    stream.stop("");
  }
});

test("after a lost connection it resumes, sends unanswered requests again and forgets frames", async (context) => {
  context.mock.timers.enable({ apis: ["setTimeout"] });
  const { stream, heard, frame } = await opened();
  const first = FakeSocket.last;
  await stream.offer(frame(1));
  stream.request({ type: "remove_object", request: 0, object: "a" });
  stream.request({ type: "remove_object", request: 1, object: "b" });
  first.say({ type: "acknowledged", request: 0, error: null, notes: [] });
  first.onclose!({ code: 1006, reason: "" });
  assert.ok(heard.some((message) => message.type === "dropped" && message.frame === 1));
  context.mock.timers.tick(200);
  const second = FakeSocket.last;
  assert.notEqual(first, second);
  second.onopen();
  second.say(welcome({ resumed: true }));
  const [hello, ...rest] = second.sent;
  assert.ok(hello?.type === "hello" && hello.resume === "secret");
  assert.deepEqual(rest, [{ type: "remove_object", request: 1, object: "b" }]);
  await stream.offer(frame(2));
  assert.deepEqual(framesOf(second), [2]);
  stream.stop("");
});

test("where the session is gone, another one begins", async (context) => {
  context.mock.timers.enable({ apis: ["setTimeout"] });
  const { stream } = await opened();
  FakeSocket.last.onclose!({ code: 1006, reason: "" });
  context.mock.timers.tick(200);
  FakeSocket.last.onopen();
  FakeSocket.last.onclose!({ code: 4410, reason: "there is no such session" });
  context.mock.timers.tick(400);
  FakeSocket.last.onopen();
  const hello = FakeSocket.last.sent[0]!;
  assert.ok(FakeSocket.all.length === 3 && hello.type === "hello" && hello.resume === null);
  stream.stop("");
});

test("a camera that was turned is a session of its own", async () => {
  const { stream, frame } = await opened();
  const first = FakeSocket.last;
  await stream.offer(frame(1, { ...CAMERA, width: 48, height: 64 }));
  assert.equal(first.sent.at(-1)!.type, "bye");
  FakeSocket.last.onopen();
  const hello = FakeSocket.last.sent[0]!;
  assert.ok(FakeSocket.last !== first && hello.type === "hello" && hello.camera.width === 48 && hello.resume === null);
  stream.stop("");
});

const composite = (frame: number, more: object = {}): object => ({
  type: "composite", frame, color: { width: 64, height: 48, codec: "jpeg", data: new Uint8Array(1000) }, timings: { total: 200 }, waited_ms: 0, ...more,
});

test("with a pace a frame is asked for when the one before it is past the slowest stage", async (context) => {
  context.mock.timers.enable({ apis: ["setTimeout"] });
  let now_ms = 0;
  context.mock.method(performance, "now", () => now_ms);
  const pace = new Adaptive(1 / 15, 0.02);
  const { stream, wanted, frame } = await opened({}, pace);
  const socket = FakeSocket.last;
  await stream.offer(frame(1));
  assert.equal(wanted(), 3); // nothing is known yet
  now_ms = 220;
  socket.say(composite(1));
  assert.ok(Math.abs(pace.busy_s - 0.2) < 1e-6); // computing: 20 ms on the way are the link's own
  await stream.offer(frame(2));
  assert.equal(wanted(), 3); // it has just gone
  const later = (ms: number): void => {
    now_ms += ms;
    context.mock.timers.tick(ms);
  };
  later(150);
  assert.equal(wanted(), 3);
  later(60);
  assert.equal(wanted(), 4);
  await stream.offer(frame(3));
  later(1000);
  assert.equal(wanted(), 4); // two are under way
  socket.say(composite(2, { waited_ms: 1010 }));
  assert.ok(Math.abs(pace.busy_s - (0.2 + 1.01 / 2)) < 1e-3); // others had a turn before it, as in half of what is known; it is no transfer
  later(680);
  assert.equal(wanted(), 4);
  later(20);
  assert.equal(wanted(), 5);
  stream.stop("");
});

test("with a pace as many frames as a server allows are asked for, without one no more than it gives unasked", async () => {
  for (const [pace, wanted] of [[new Adaptive(1 / 15), 8], [null, undefined]] as const) {
    const { stream } = await opened({}, pace ?? undefined);
    const hello = FakeSocket.last.sent[0]!;
    assert.ok(hello.type === "hello" && hello.max_inflight === wanted);
    stream.stop("");
  }
});

test("a frame is asked for so early that it is encoded when the one before it is done", async (context) => {
  context.mock.timers.enable({ apis: ["setTimeout"] });
  let now_ms = 0;
  context.mock.method(performance, "now", () => now_ms);
  const pace = new Adaptive(1 / 15, 0.02);
  const { stream, wanted, frame } = await opened({}, pace, () => (now_ms += 80));
  const later = (ms: number): void => {
    now_ms += ms;
    context.mock.timers.tick(ms);
  };
  await stream.offer(frame(1)); // 20 of 80 ms are expected of the next
  later(220);
  FakeSocket.last.say(composite(1));
  await stream.offer(frame(2)); // 35
  const before = wanted();
  later(160);
  assert.equal(wanted(), before);
  later(10);
  assert.equal(wanted(), before + 1); // 30 ms before the server is expected to have done with it
  stream.stop("");
});

test("after a lost connection a rung down is sent", async (context) => {
  context.mock.timers.enable({ apis: ["setTimeout"] });
  const pace = new Adaptive(1 / 15);
  const { stream } = await opened({}, pace);
  FakeSocket.last.onclose!({ code: 1006, reason: "" });
  assert.equal(pace.rung, 1);
  context.mock.timers.tick(200);
  FakeSocket.last.onclose!({ code: 1006, reason: "" }); // nothing was sent on this one
  assert.equal(pace.rung, 1);
  stream.stop("");
});

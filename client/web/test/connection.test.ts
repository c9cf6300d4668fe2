// When the page tries again, and when it says that this would change nothing.

import assert from "node:assert/strict";
import { test } from "node:test";
import { CAPTURING, Connection, type ConnectionState, pause_ms, REFUSED_CAPTURE } from "../src/connection";

class FakeSocket {
  static last: FakeSocket;
  onclose: (event: { code: number; reason: string }) => void = () => undefined;
  constructor(readonly url: string) {
    FakeSocket.last = this;
  }
}

/** The state that a page is in once its socket was closed. */
function stateAfter(code: number, reason: string, refused?: readonly number[]): ConnectionState {
  const states: ConnectionState[] = [];
  Object.assign(globalThis, { WebSocket: FakeSocket });
  const hooks = {
    greeting: () => ({ type: "watch" }) as const,
    onState: (state: ConnectionState) => states.push(state),
    onMessage: () => undefined,
  };
  const connection = new Connection("ws://host/v1/stream", hooks, CAPTURING, refused);
  connection.open();
  const socket = FakeSocket.last;
  socket.onclose({ code, reason });
  connection.stop();
  const last = states.at(-1);
  assert.ok(last !== undefined);
  return last;
}

test("without its token a page says what to do and does not try again", () => {
  const reason = "the token is missing: use the URL that the server printed at its start, which ends in ?token=...";
  assert.deepEqual(stateAfter(4401, reason), { kind: "refused", reason });
  assert.equal(stateAfter(4403, "pages of elsewhere").kind, "refused");
  assert.equal(stateAfter(1002, "another version").kind, "refused");
});

test("a server that restarts or is full is tried again", () => {
  for (const code of [1006, 1012, 1013]) assert.equal(stateAfter(code, "later").kind, "lost");
});

test("a session that is not there yet may come; wishes that cannot be met stay so", () => {
  assert.equal(stateAfter(1008, "no session").kind, "lost");
  assert.deepEqual(stateAfter(1008, "no such preset", REFUSED_CAPTURE), { kind: "refused", reason: "no such preset" });
});

test("a session that is kept for a while is tried for sooner", () => {
  const pauses = [1, 2, 3, 4, 5, 6, 50].map((attempt) => pause_ms(attempt, () => 0, CAPTURING));
  assert.deepEqual(pauses, [100, 200, 400, 800, 1600, 2000, 2000]);
});

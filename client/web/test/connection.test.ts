// When the page tries again, and when it says that this would change nothing.

import assert from "node:assert/strict";
import { test } from "node:test";
import { Connection, type ConnectionState } from "../src/connection";

class FakeSocket {
  static last: FakeSocket;
  onclose: (event: { code: number; reason: string }) => void = () => undefined;
  constructor(readonly url: string) {
    FakeSocket.last = this;
  }
}

/** The state that a page is in once its socket was closed. */
function stateAfter(code: number, reason: string): ConnectionState {
  const states: ConnectionState[] = [];
  Object.assign(globalThis, { WebSocket: FakeSocket });
  const connection = new Connection("ws://host/v1/stream", null, (state) => states.push(state), () => undefined);
  connection.open();
  FakeSocket.last.onclose({ code, reason });
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

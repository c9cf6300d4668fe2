// What is sent now, in words.

import type { Sending } from "./capture/encode";
import { byId, setText } from "./dom";
import { FrameRate } from "./rate";
import { describeSending } from "./words";

const rate = new FrameRate();
const line = byId("sending");
let last: Sending | null = null;

/** A frame goes to the server. */
export function noteSending(sending: Sending): void {
  last = sending;
  rate.add(performance.now());
}

/** To be called as time passes. */
export function showSending(now_ms: number): void {
  line.hidden = last === null;
  if (last !== null) setText(line, `Sent now: ${describeSending(last, rate.value(now_ms))}`);
}

export function clearSending(): void {
  last = null;
  rate.clear();
  line.hidden = true;
}

// Measurements of the link to the server.

import type { Composite, Frame, Layer } from "../protocol";
import type { Measured } from "./adaptive";

/** Number of round trips; the shortest counts, since the first one also opens a connection. */
const ROUND_TRIPS = 3;

/** Round-trip time of a small message to the server of `streamUrl` in seconds; Infinity if it does not answer. */
export async function measureDelay_s(streamUrl: string): Promise<number> {
  const url = new URL(streamUrl.replace(/^ws/, "http"));
  [url.pathname, url.search] = ["/healthz", ""];
  let least_s = Infinity;
  for (let i = 0; i < ROUND_TRIPS; i++) {
    const begun_ms = performance.now();
    try {
      await (await fetch(url, { cache: "no-store" })).arrayBuffer();
    } catch {
      return least_s; // the stream's own connection reports the error
    }
    least_s = Math.min(least_s, (performance.now() - begun_ms) / 1000);
  }
  return least_s;
}

/** Bytes of a frame's images; the rest is small. */
export const bytesOf = ({ color, depth }: Frame): number => (color?.data.length ?? 0) + (depth?.data.length ?? 0);

/** Link measurement from an answer; none from a light alone, which lacks the server's times. */
export function measuredOf(answer: Composite | Layer, bytesUp: number, sent_ms: number, answered_ms: number): Measured {
  const parts = answer.type === "composite" ? [] : [answer.virtual, answer.ratio];
  const bytesDown = answer.type === "composite" ? answer.color.data.length : 0;
  return {
    sent_s: sent_ms / 1000,
    answered_s: answered_ms / 1000,
    computed_s: answer.timings.total / 1000,
    bytes_up: bytesUp,
    bytes_down: parts.reduce((sum, part) => sum + (part === null ? 0 : part.color.data.length + part.depth.data.length), bytesDown),
    waited_s: answer.waited_ms ? answer.waited_ms / 1000 : null, // older servers do not send it
  };
}

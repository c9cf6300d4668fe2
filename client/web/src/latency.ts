// How long a frame is under way: captured, sent, answered, shown.

import { now_ms } from "./capture/source";
import type { Times } from "./capture/stream";
import { byId, setText } from "./dom";
import type { Timings } from "./protocol";
import { milliseconds } from "./words";

const HISTORY = 90;
const STAGES = ["packed", "answered", "computed", "shown", "all"] as const;
type Stage = (typeof STAGES)[number];

const history: Record<Stage, number[]> = { packed: [], answered: [], computed: [], shown: [], all: [] };

/** Note a frame whose picture is drawn now: it is seen when the browser draws next. */
export function noteShown(times: Times, timings: Timings): void {
  requestAnimationFrame(() => {
    const stages = stagesOf(times, timings, now_ms());
    for (const stage of STAGES) {
      history[stage].push(stages[stage]);
      if (history[stage].length > HISTORY) history[stage].shift();
      setText(byId(`latency-${stage}`), milliseconds(stages[stage]));
      setText(byId(`latency-${stage}-median`), milliseconds(median(history[stage])));
    }
    byId("latency").hidden = false;
  });
}

/** Milliseconds of each stage; `computed` is a part of `answered`. */
export function stagesOf(times: Times, timings: Timings, shown_ms: number): Record<Stage, number> {
  return {
    packed: times.sent_ms - times.captured_ms,
    answered: times.answered_ms - times.sent_ms,
    computed: timings.total,
    shown: shown_ms - times.answered_ms,
    all: shown_ms - times.captured_ms,
  };
}

export function clearLatency(): void {
  for (const stage of STAGES) history[stage].length = 0;
  byId("latency").hidden = true;
}

function median(values: readonly number[]): number {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.floor(sorted.length / 2)] ?? 0;
}

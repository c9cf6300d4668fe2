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

/** How old what is on the screen is. */
export interface Ages {
  /** Of the camera's picture: times that the display has drawn since it came. */
  picture_frames: number;
  /** Of the frame that the virtual things were drawn for, since it was captured; null: there is none yet. */
  layer_ms: number | null;
}

const ages: { layer: number[]; picture: number[] } = { layer: [], picture: [] };

/** How old what is on the screen is, in layer mode; null: in no other mode is it another age than that of an answer. */
export function showAges(now: Ages | null): void {
  byId("latency").classList.toggle("layered", now !== null);
  if (now === null || now.layer_ms === null) return;
  for (const [name, value, say] of [["layer", now.layer_ms, milliseconds], ["picture", now.picture_frames, String]] as const) {
    ages[name].push(value);
    if (ages[name].length > HISTORY) ages[name].shift();
    setText(byId(`age-${name}`), say(value));
    setText(byId(`age-${name}-median`), say(median(ages[name])));
  }
}

export function clearLatency(): void {
  for (const values of [...Object.values(history), ...Object.values(ages)]) values.length = 0;
  showAges(null);
  byId("latency").hidden = true;
}

function median(values: readonly number[]): number {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.floor(sorted.length / 2)] ?? 0;
}

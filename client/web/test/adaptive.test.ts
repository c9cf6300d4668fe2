// The page's rules of sending decide as the Python client's do, which has recorded its decisions.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { Adaptive, LADDER, type Measured } from "../src/capture/adaptive";

/** tests/client/link_series.py */
type Step =
  | ({ kind: "answered"; rung: number; quality: number; divisor: number; busy_s: number } & Measured)
  | { kind: "asked"; now_s: number; last_sent_s: number; unanswered: number; may_send: boolean }
  | { kind: "lost"; rung: number };

interface Series {
  wanted_interval_s: number;
  delay_s: number | null;
  steps: Step[];
}

const written = process.env["PROBELESS_LINK_SERIES"];
const series = (): Series[] => JSON.parse(readFileSync(written!, "utf8")) as Series[];

function follow({ wanted_interval_s, delay_s, steps }: Series): void {
  const adaptive = new Adaptive(wanted_interval_s, delay_s ?? Infinity);
  steps.forEach((step, place) => {
    if (step.kind === "asked") {
      const asked = [step.now_s, step.last_sent_s, step.unanswered] as const;
      assert.equal(adaptive.maySend(...asked), step.may_send, `step ${place}`);
      assert.equal(adaptive.wait_s(...asked) === 0, step.may_send);
      return;
    }
    if (step.kind === "lost") adaptive.noteLost();
    else adaptive.note(step);
    assert.equal(adaptive.rung, step.rung, `step ${place}`);
    if (step.kind === "lost") return;
    assert.deepEqual([adaptive.coding.quality, adaptive.coding.divisor], [step.quality, step.divisor]);
    assert.ok(Math.abs(adaptive.busy_s - step.busy_s) <= 1e-12 * (1 + step.busy_s), `step ${place}`);
  });
}

test("rungs and turns are those of the Python client, over links of every kind", { skip: written === undefined }, () => {
  const all = series();
  all.forEach(follow);
  const seen = new Set(all.flatMap(({ steps }) => steps.flatMap((step) => (step.kind === "asked" ? [] : [step.rung]))));
  assert.equal(seen.size, LADDER.length);
});

test("a frame that has to wait says for how long", () => {
  const adaptive = new Adaptive(1 / 15, 0.04);
  adaptive.note({ sent_s: 0, answered_s: 0.54, computed_s: 0.3, bytes_up: 100, bytes_down: 0, waited_s: 0 });
  assert.ok(Math.abs(adaptive.busy_s - 0.3) < 1e-9);
  assert.equal(adaptive.wait_s(1, 1, 0), 0);
  assert.ok(Math.abs(adaptive.wait_s(1.1, 1, 1) - 0.2) < 1e-9);
  assert.equal(adaptive.wait_s(1.1, 1, 2), Infinity);
  assert.ok(!adaptive.maySend(1.25, 1, 1) && adaptive.maySend(1.31, 1, 1));
});

test("over a far link the next frame follows before the first is answered", () => {
  const adaptive = new Adaptive(1 / 15, 1);
  adaptive.note({ sent_s: 0, answered_s: 1.1, computed_s: 0.1, bytes_up: 100, bytes_down: 0, waited_s: 0 });
  assert.equal(adaptive.mostInFlight, 11);
  assert.ok(Math.abs(adaptive.wait_s(1.1, 1, 1)) < 1e-9);
  assert.ok(Math.abs(adaptive.wait_s(1.65, 1.6, 4) - 0.05) < 1e-9);
  assert.equal(adaptive.wait_s(5, 1.6, 11), Infinity);
});

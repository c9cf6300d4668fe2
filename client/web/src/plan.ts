// Shows the plan of effects: which ran, which were left out, why, and the error bound.

import { byId, make } from "./dom";
import type { LeftOut, Plan } from "./protocol";
import { describeBound, describePoint, plain } from "./words";

const point = byId("plan-point");
const run = byId("plan-run");
const leftOut = byId("plan-left-out");
let shown = "";

/** Show a plan; the page is touched only when it differs from the one before. */
export function showPlan(plan: Plan): void {
  point.textContent = describePoint(plan.point ?? null); // its expectation changes with every frame
  const key = JSON.stringify([plan.run, plan.left_out]);
  if (key === shown) return;
  shown = key;
  run.replaceChildren(...plan.run.map((effect) => make("li", "chip", plain(effect))));
  leftOut.replaceChildren(...plan.left_out.map(describe));
  if (plan.run.length === 0) run.append(make("li", "quiet", "No effect: the picture is the camera's"));
  if (plan.left_out.length === 0) leftOut.append(make("li", "quiet", "Nothing"));
}

function describe(effect: LeftOut): HTMLLIElement {
  const item = make("li");
  item.append(make("strong", "", `${plain(effect.effect)}:`), make("span", "", ` ${effect.reason}`));
  item.append(make("span", "bound", describeBound(effect.error_bound)));
  return item;
}

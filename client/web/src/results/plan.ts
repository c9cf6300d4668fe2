// The plan of a frame: which effects ran, which were left out and why, how it was sampled, and notes.

import { byId, make, setText } from "../dom";
import { describeBound, plain } from "../words";
import type { DrawnRow, RunData } from "./data";

const point = byId("plan-point");
const run = byId("plan-run");
const out = byId("plan-out");
const notes = byId("notes");
let shown = "";

export function showPlan({ tables }: RunData, drawn: DrawnRow | null): void {
  const key = JSON.stringify([drawn?.run, drawn?.out, drawn?.point, drawn?.notes]);
  if (key === shown) return;
  shown = key;
  const sampled = drawn?.point == null ? null : tables.points[drawn.point]!;
  setText(point, sampled === null ? (drawn === null ? "No picture was asked for" : "Nothing was sampled: the camera is lost") : `${sampled[0]} (${sampled[1]})`);
  run.replaceChildren(...(drawn?.run ?? []).map((effect) => make("li", "", plain(tables.effects[effect]!))));
  out.replaceChildren(...(drawn?.out ?? []).map((effect) => leftOut(...tables.left_out[effect]!)));
  if (run.childElementCount === 0) run.append(make("li", "", "None: the picture is the camera's"));
  if (out.childElementCount === 0) out.append(make("li", "quiet", "Nothing"));
  notes.replaceChildren(...(drawn?.notes ?? []).map((note) => make("li", "", note)));
  byId("notes-part").hidden = !drawn?.notes?.length;
}

function leftOut(effect: string, reason: string, bound: number | null): HTMLElement {
  const item = make("li");
  item.append(make("strong", "", `${plain(effect)}: `), reason, make("span", "bound", describeBound(bound)));
  return item;
}

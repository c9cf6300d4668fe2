// Milliseconds of each stage: one bar for the whole frame, a row of numbers and a short history for each.

import { byId, make, setText } from "./dom";
import type { Timings } from "./protocol";
import { milliseconds, plain } from "./words";

const HISTORY = 90;
const SVG = "http://www.w3.org/2000/svg";
const STAGES = [
  "input",
  "reconstruct",
  "surface",
  "dynamic_geometry",
  "radiance_transfer",
  "light_estimation",
  "rendering",
] as const satisfies readonly (keyof Timings)[];

interface Row {
  readonly name: keyof Timings;
  readonly segment: HTMLElement | null;
  readonly now: HTMLElement;
  readonly mean: HTMLElement;
  readonly line: SVGPolylineElement;
  readonly history: number[];
}

const bar = byId("timing-bar");
const body = byId("timing-rows");
const rows: readonly Row[] = [...STAGES, "total" as const].map(makeRow);

function makeRow(name: keyof Timings, index: number): Row {
  const isTotal = name === "total";
  const row = make("tr", isTotal ? "total" : `stage-${index}`);
  const head = make("th", "", isTotal ? "Total (wall)" : plain(name));
  head.scope = "row";
  if (!isTotal) head.prepend(make("span", "swatch"));
  const now = make("td", "number", "–");
  const mean = make("td", "number mean", "–");
  const history = make("td", "history");
  const { svg, line } = makeSparkline();
  history.append(svg);
  row.append(head, now, mean, history);
  body.append(row);
  const segment = isTotal ? null : make("span", `stage-${index}`);
  if (segment) bar.append(segment);
  return { name, segment, now, mean, line, history: [] };
}

function makeSparkline(): { svg: SVGSVGElement; line: SVGPolylineElement } {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", `0 0 ${HISTORY - 1} 20`);
  svg.setAttribute("preserveAspectRatio", "none");
  svg.setAttribute("aria-hidden", "true");
  const line = document.createElementNS(SVG, "polyline");
  svg.append(line);
  return { svg, line };
}

/** Take one frame's times into the history; cheap, called for every frame. */
export function addTimings(timings: Timings): void {
  for (const row of rows) {
    row.history.push(timings[row.name]);
    if (row.history.length > HISTORY) row.history.shift();
  }
}

export function clearTimings(): void {
  for (const row of rows) row.history.length = 0;
}

/** Draw the newest times; called at most once per displayed frame. */
export function showTimings(timings: Timings): void {
  const stages_ms = STAGES.reduce((sum, name) => sum + timings[name], 0);
  for (const row of rows) {
    const share = stages_ms > 0 ? timings[row.name] / stages_ms : 0;
    if (row.segment) row.segment.style.flexGrow = share.toFixed(4);
    setText(row.now, milliseconds(timings[row.name]));
    setText(row.mean, milliseconds(row.history.reduce((sum, value) => sum + value, 0) / Math.max(1, row.history.length)));
    row.line.setAttribute("points", sparkline(row.history));
  }
  const longest = STAGES.reduce((a, b) => (timings[b] > timings[a] ? b : a));
  bar.setAttribute("aria-label", `Share of each stage; ${plain(longest)} takes longest, ${milliseconds(timings[longest])} ms`);
}

/** Points of a line from 0 at the bottom to the largest value at the top, the newest value at the right. */
export function sparkline(values: readonly number[]): string {
  const top = Math.max(...values, 1e-9);
  const first = HISTORY - values.length;
  return values.map((value, i) => `${first + i},${(19 - (18 * value) / top).toFixed(1)}`).join(" ");
}

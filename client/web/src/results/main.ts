// The page of results: what a run wrote into its folder, from disk.

import { byId, make, setText } from "../dom";
import { Charts } from "./charts";
import { setSplit, showNone, startCompare } from "./compare";
import { readData, type FrameRow, type RunData } from "./data";
import { Lights } from "./lights";
import { Pace } from "./pace";
import { showPlan } from "./plan";
import { Player } from "./player";
import { Space } from "./space";

const STANDING = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0];

/** Shares of the picture's width: between the divider and what is virtual, and from its left side to the divider. */
const [MARGIN, LEAST_SPLIT] = [0.03, 0.08];

function start(): void {
  const data = readData();
  showHead(data);
  const { width, height } = data.camera;
  startCompare(width, height);
  showNone();
  const poses = posesOf(data.frames);
  const lights = new Lights(data, poses[0]!);
  const space = startSpace(data);
  const charts = new Charts(data, (index) => player.seek(index));
  const slow = [
    new Pace((index) => lights.show(data.frames[index]!.lights, poses[index]!)),
    ...(space === null ? [] : [new Pace((index) => space.show(data.frames[index]!))]),
  ];
  const player = new Player(data, (index, isPlaying) => {
    charts.show(index);
    showPlan(data, data.frames[index]!.drawn);
    if (space !== null) space.isPlaying = isPlaying;
    for (const each of slow) each.ask(index, isPlaying);
  });
  byId("modes").hidden = data.frames.every(({ drawn }) => drawn?.picture !== 2);
  const first = telling(data.frames);
  const changed = data.frames[first]!.drawn?.changed;
  if (changed) setSplit(splitFor(changed[1], changed[2]));
  player.seek(first);
}

/** The frame of the second half, where the light is known best, in which virtual content shows most. */
function telling(frames: readonly FrameRow[]): number {
  const share = (index: number): number => frames[index]!.drawn?.changed?.[0] ?? -1;
  let found = frames.length - 1;
  for (let i = Math.floor(frames.length / 2); i < frames.length; i++) if (share(i) > share(found)) found = i;
  return found;
}

/** In the middle, unless what is virtual lies there or left of it: then left of that, or across what is too near the side. */
function splitFor(from: number, to: number): number {
  if (from - MARGIN >= 0.5) return 0.5;
  return from - MARGIN >= LEAST_SPLIT ? from - MARGIN : (from + to) / 2;
}

/** Of each frame; one without a pose has the one before. */
function posesOf(frames: readonly FrameRow[]): (readonly number[])[] {
  let pose: readonly number[] = frames.find(({ drawn }) => drawn !== null)?.drawn?.pose ?? STANDING;
  return frames.map(({ drawn }) => (pose = drawn?.pose ?? pose));
}

function showHead(data: RunData): void {
  const name = data.source.split(/[\\/]/).filter(Boolean).at(-1) ?? data.source;
  document.title = `${name}: probeless`;
  setText(byId("source"), name);
  byId("source").title = data.source;
  const { width, height } = data.camera;
  const frames = `${data.frames.length} ${data.frames.length === 1 ? "frame" : "frames"}`;
  const facts = [frames, `${width} × ${height}`, data.objects.join(", ") || "no virtual object", data.device].filter(Boolean);
  byId("facts").replaceChildren(...facts.map((fact) => make("li", "", fact)));
  if (data.video !== null) {
    const link = Object.assign(make("a", "", data.video), { href: data.video });
    const item = make("li");
    item.append(link);
    byId("facts").append(item);
  }
  if (data.ended) byId("facts").append(make("li", "early", `Ended early: ${data.ended}${data.total === null ? "" : `, after ${data.frames.length} of ${data.total} frames`}`));
}

function startSpace(data: RunData): Space | null {
  const canvas = byId<HTMLCanvasElement>("view");
  try {
    const space = new Space(canvas, data);
    const through = byId<HTMLButtonElement>("from-camera");
    space.onThrough = (isThrough) => through.setAttribute("aria-pressed", String(isThrough));
    through.addEventListener("click", () => space.through());
    byId("from-outside").addEventListener("click", () => space.overview());
    setText(byId("space-note"), data.scan === null ? "no depth was seen" : `${data.scan.count.toLocaleString("en")} points`);
    return space;
  } catch (error) {
    canvas.hidden = byId("space-tools").hidden = true;
    setText(byId("space-said"), `This browser draws nothing in three dimensions (${error instanceof Error ? error.message : String(error)}).`);
    return null;
  }
}

try {
  start();
} catch (error) {
  const fault = byId("fault");
  fault.hidden = false;
  setText(fault, `This page cannot be shown: ${error instanceof Error ? error.message : String(error)}`);
  throw error;
}

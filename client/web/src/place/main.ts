// The page of `probeless place`: a click in a frame, and the option of the command line that says the same.

import { byId, setText } from "../dom";

interface Frame {
  /** Position in the source. */
  index: number;
  /** As a data URL. */
  picture: string;
  /** Depth in millimetres of every `step`-th pixel, 0: none; little-endian uint16 in base64. Null: of another lens. */
  depth: string | null;
}

interface Data {
  source: string;
  /** What follows "--object FILE@pixel:U,V:N". */
  object: string;
  width: number;
  height: number;
  step: number;
  frames: Frame[];
}

const data = JSON.parse(byId("data").textContent) as Data;
const picture = byId<HTMLImageElement>("picture");
const stage = byId("stage");
const mark = byId("mark");
const slider = byId<HTMLInputElement>("frame");
const copy = byId<HTMLButtonElement>("copy");
let chosen: { u: number; v: number } | null = null;

const frame = (): Frame => data.frames[Number(slider.value)]!;

/** A word of a shell's command line. */
const quoted = (word: string): string => (/^[\w@%+=:,./-]+$/.test(word) ? word : `'${word.replaceAll("'", "'\\''")}'`);

function depthAt({ depth }: Frame, u: number, v: number): number | null {
  if (depth === null) return null;
  const bytes = Uint8Array.from(atob(depth), (character) => character.charCodeAt(0));
  const at = 2 * (Math.floor(v / data.step) * Math.ceil(data.width / data.step) + Math.floor(u / data.step));
  return bytes[at]! + 256 * bytes[at + 1]!;
}

function show(): void {
  const { index, picture: url } = frame();
  picture.src = url;
  picture.alt = `Frame ${index} of ${data.source}`;
  byId("number").textContent = String(index);
  slider.setAttribute("aria-valuetext", `frame ${index}`);
  mark.hidden = copy.disabled = chosen === null;
  if (chosen === null) return;
  const { u, v } = chosen;
  mark.style.left = `${(100 * (u + 0.5)) / data.width}%`;
  mark.style.top = `${(100 * (v + 0.5)) / data.height}%`;
  const depth_mm = depthAt(frame(), u, v);
  const away = depth_mm === null ? "" : depth_mm === 0 ? "; the sensor saw no depth there: choose a place beside it" : `, ${(depth_mm / 1000).toFixed(2)} m from the camera`;
  setText(byId("said"), `Pixel ${u}, ${v} of frame ${index}${away}.`);
  setText(byId("command"), `probeless run ${quoted(data.source)} --object ${quoted(`${data.object}@pixel:${u},${v}:${index}`)} --out out/placed`);
}

function choose(u: number, v: number): void {
  chosen = { u: Math.min(data.width - 1, Math.max(0, u)), v: Math.min(data.height - 1, Math.max(0, v)) };
  show();
}

stage.addEventListener("click", (event) => {
  const box = picture.getBoundingClientRect();
  choose(Math.floor(((event.clientX - box.left) / box.width) * data.width), Math.floor(((event.clientY - box.top) / box.height) * data.height));
});
const ARROWS: Readonly<Record<string, readonly [number, number]>> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
stage.addEventListener("keydown", (event) => {
  const by = ARROWS[event.key];
  if (by === undefined) return;
  event.preventDefault();
  const far = event.shiftKey ? 20 : 2;
  const { u, v } = chosen ?? { u: Math.floor(data.width / 2), v: Math.floor(data.height / 2) };
  choose(u + far * by[0], v + far * by[1]);
});
slider.addEventListener("input", () => {
  chosen = null; // the camera has moved: the pixel shows another place
  setText(byId("said"), "Nothing is chosen yet.");
  setText(byId("command"), "");
  show();
});
copy.addEventListener("click", () => {
  const text = byId("command").textContent;
  const done = (): void => setText(byId("said"), "Copied.");
  const select = (): void => getSelection()?.selectAllChildren(byId("command"));
  if (navigator.clipboard === undefined) select();
  else navigator.clipboard.writeText(text).then(done, select);
});

setText(byId("source"), data.source);
stage.style.width = `min(100%, ${(62 * data.width) / data.height}vh)`; // the command below stays in sight
slider.max = String(data.frames.length - 1);
byId("frames").hidden = data.frames.length < 2;
show();

// The picture: the composite, and over a part of it the camera's own, with a divider that a hand or the keys move.

import { byId, context2d } from "../dom";

export type Mode = "split" | "with" | "without";

const stage = byId("stage");
const canvases = { with: byId<HTMLCanvasElement>("with"), without: byId<HTMLCanvasElement>("without") };
const input = byId<HTMLInputElement>("split");
const divider = byId("divider");
const modes = [...document.querySelectorAll<HTMLInputElement>("[name=mode]")];

let mode: Mode = "split";

export function startCompare(width: number, height: number): void {
  for (const canvas of Object.values(canvases)) [canvas.width, canvas.height] = [width, height];
  stage.style.aspectRatio = `${width} / ${height}`;
  stage.style.maxWidth = `calc(78vh * ${(width / height).toFixed(4)})`;
  input.addEventListener("input", place);
  for (const each of modes) each.addEventListener("change", () => setMode(each.value as Mode));
  stage.addEventListener("pointerdown", (event) => {
    if (mode !== "split" || event.button !== 0) return;
    stage.setPointerCapture(event.pointerId);
    input.focus({ preventScroll: true });
    event.preventDefault();
    drag(event);
  });
  stage.addEventListener("pointermove", (event) => {
    if (stage.hasPointerCapture(event.pointerId)) drag(event);
  });
  setMode("split");
  place();
}

/** Show the composite and the camera's picture; null: there is none but the composite. */
export function show(composite: CanvasImageSource, own: CanvasImageSource | null): void {
  stage.classList.remove("empty");
  draw(canvases.with, composite);
  stage.classList.toggle("single", own === null);
  if (own !== null) draw(canvases.without, own);
}

/** There is no picture. */
export function showNone(): void {
  stage.classList.add("empty");
}

export function setMode(next: Mode): void {
  mode = next;
  stage.dataset["mode"] = mode;
  for (const each of modes) each.checked = each.value === mode;
  place();
}

/** Put the divider at a share of the width. */
export function setSplit(share: number): void {
  input.value = String(Math.round(100 * share));
  place();
}

/** From before to after and back; from both, to before. */
export function flip(): void {
  setMode(mode === "without" ? "with" : "without");
}

function drag(event: PointerEvent): void {
  const { left, width } = stage.getBoundingClientRect();
  setSplit(Math.max(0, Math.min(1, (event.clientX - left) / width)));
}

function place(): void {
  const share = Number(input.value);
  divider.style.left = `${share}%`;
  canvases.without.style.clipPath = mode === "split" ? `inset(0 ${100 - share}% 0 0)` : "none";
  input.setAttribute("aria-valuetext", `${share} % before, ${100 - share} % after`);
}

function draw(canvas: HTMLCanvasElement, picture: CanvasImageSource): void {
  context2d(canvas).drawImage(picture, 0, 0, canvas.width, canvas.height);
}

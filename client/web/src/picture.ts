// The composited picture, the newest that was decoded.

import { byId, context2d, setText } from "./dom";
import type { Composite, Layer } from "./protocol";
import { TRACKING } from "./words";

const canvas = byId<HTMLCanvasElement>("picture");
const guide = byId<HTMLCanvasElement>("guide");
const context = context2d(canvas);
const frame = byId("picture-frame");
const caption = byId("picture-caption");

/** Make room for pictures of this size. */
export function fitPicture({ width, height }: { width: number; height: number }): void {
  if (canvas.width === width && canvas.height === height) return;
  for (const each of [canvas, guide]) {
    each.width = width;
    each.height = height;
  }
  frame.style.setProperty("--aspect", `${width} / ${height}`);
}

/** Show a composite's picture, which is closed. */
export function showPicture(composite: Composite, bitmap: ImageBitmap): void {
  drawPicture(bitmap);
  bitmap.close();
  captionPicture(composite);
}

export function drawPicture(picture: ImageBitmap | HTMLCanvasElement): void {
  fitPicture(picture);
  context.drawImage(picture, 0, 0);
  frame.classList.add("has-picture");
}

/** Show what there is to begin with instead. */
export function forgetPicture(): void {
  frame.classList.remove("has-picture");
  canvas.setAttribute("aria-label", "No picture yet");
  setText(caption, "");
}

/** Say of which frame the virtual things on the screen are. */
export function captionPicture(answer: Composite | Layer): void {
  const size = `${canvas.width}×${canvas.height}`;
  canvas.setAttribute("aria-label", `Camera picture with the virtual objects in it, ${size}, frame ${answer.frame}`);
  setText(caption, `Frame ${answer.frame} · ${size} · ${answer.timestamp_s.toFixed(2)} s · ${TRACKING[answer.tracking]}`);
  caption.classList.toggle("bad", answer.tracking === "lost");
}

/** Say whether what is seen is current. */
export function markPicture(live: boolean): void {
  frame.classList.toggle("stale", !live);
}

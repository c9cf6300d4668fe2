// The composited picture, the newest that was decoded.

import { byId, context2d, setText } from "./dom";
import type { Composite } from "./protocol";
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
  fitPicture(bitmap);
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  frame.classList.add("has-picture");
  const size = `${canvas.width}×${canvas.height}`;
  canvas.setAttribute("aria-label", `Camera picture with the virtual objects in it, ${size}, frame ${composite.frame}`);
  setText(caption, `Frame ${composite.frame} · ${size} · ${composite.timestamp_s.toFixed(2)} s · ${TRACKING[composite.tracking]}`);
  caption.classList.toggle("bad", composite.tracking === "lost");
}

/** Say whether what is seen is current. */
export function markPicture(live: boolean): void {
  frame.classList.toggle("stale", !live);
}

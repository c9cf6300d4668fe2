// The composited picture: the newest one that can be decoded in time.

import { byId, context2d, setText } from "./dom";
import type { ColorImage, Composite } from "./protocol";
import { TRACKING } from "./words";

const canvas = byId<HTMLCanvasElement>("picture");
const context = context2d(canvas);
const frame = byId("picture-frame");
const caption = byId("picture-caption");

let waiting: Composite | null = null;
let busy = false;

/** Show a composite; one that arrives while another is being decoded replaces an older one that waits. */
export async function showPicture(composite: Composite): Promise<void> {
  waiting = composite;
  if (busy) return;
  busy = true;
  try {
    while (waiting !== null) {
      const next: Composite = waiting;
      waiting = null;
      draw(next, await decode(next.color));
    }
  } finally {
    busy = false;
  }
}

/** Say whether what is seen is current. */
export function markPicture(live: boolean): void {
  frame.classList.toggle("stale", !live);
}

async function decode(color: ColorImage): Promise<ImageBitmap> {
  if (color.codec === "raw") throw new Error("the picture is raw, which this page does not show");
  const blob = new Blob([new Uint8Array(color.data)], { type: `image/${color.codec}` });
  return createImageBitmap(blob);
}

function draw(composite: Composite, bitmap: ImageBitmap): void {
  if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
    canvas.width = bitmap.width;
    canvas.height = bitmap.height;
    frame.style.setProperty("--aspect", `${bitmap.width} / ${bitmap.height}`);
  }
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  frame.classList.add("has-picture");
  const size = `${canvas.width}×${canvas.height}`;
  canvas.setAttribute("aria-label", `Camera picture with the virtual objects in it, ${size}, frame ${composite.frame}`);
  setText(caption, `Frame ${composite.frame} · ${size} · ${composite.timestamp_s.toFixed(2)} s · ${TRACKING[composite.tracking]}`);
  caption.classList.toggle("bad", composite.tracking === "lost");
}

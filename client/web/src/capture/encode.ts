// A captured frame as it goes over the wire.

import { encodeDepth } from "../depth";
import type { ColorImage, Frame } from "../protocol";
import type { Captured } from "./source";
import type { Numbered } from "./stream";

const JPEG_QUALITY = 0.85;

export async function encodeFrame(frame: Numbered): Promise<Frame> {
  const { number, timestamp_s, world_from_camera } = frame;
  const pictures = "packed" in frame ? frame.packed : await packed(frame);
  return { type: "frame", frame: number, timestamp_s, world_from_camera, ...pictures };
}

async function packed(frame: Captured): Promise<Pick<Frame, "color" | "depth">> {
  const { camera, depth } = frame;
  const lens = camera.depth ?? camera;
  const [color, coded] = await Promise.all([encodeColor(frame), depth === null ? null : encodeDepth(depth, lens.width)]);
  return { color, depth: coded };
}

async function encodeColor({ color, camera: { width, height } }: Captured): Promise<ColorImage> {
  const canvas = new OffscreenCanvas(width, height);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  if (context === null) throw new Error("this browser gives no 2D canvas to a worker");
  if ("close" in color) {
    context.drawImage(color, 0, 0);
    color.close();
  } else {
    context.putImageData(new ImageData(color, width, height), 0, 0);
  }
  const blob = await canvas.convertToBlob({ type: "image/jpeg", quality: JPEG_QUALITY });
  return { width, height, codec: "jpeg", data: new Uint8Array(await blob.arrayBuffer()) };
}

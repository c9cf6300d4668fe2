// A layer's parts, unpacked: pictures whose codes are as they were sent, and the surface that they lie on.

import { decodeDepth } from "../depth";
import type { Layer, LayerPatch } from "../protocol";
import { type LayerMesh, meshOf } from "./layer_mesh";

export interface LayerPart {
  /** Column and row of the camera's picture in which the part begins. */
  x: number;
  y: number;
  /** Not multiplied by its fourth channel. */
  bitmap: ImageBitmap;
  mesh: LayerMesh;
}

export interface LayerParts {
  virtual: LayerPart | null;
  ratio: LayerPart | null;
}

/** Throws Error for what is not what it declares. */
export async function decodeLayer({ virtual, ratio, depth_scale_m }: Layer): Promise<LayerParts> {
  const [first, second] = await Promise.all([virtual, ratio].map((patch) => (patch === null ? null : decodePatch(patch, depth_scale_m))));
  return { virtual: first!, ratio: second! };
}

async function decodePatch({ x, y, color, depth }: LayerPatch, scale_m: number): Promise<LayerPart> {
  const blob = new Blob([new Uint8Array(color.data)], { type: `image/${color.codec}` });
  const [bitmap, units] = await Promise.all([
    createImageBitmap(blob, { premultiplyAlpha: "none", colorSpaceConversion: "none" }),
    decodeDepth(depth),
  ]);
  const { width, height } = bitmap;
  if (width !== depth.width || height !== depth.height) throw new Error("its colour and depth are of two sizes");
  return { x, y, bitmap, mesh: meshOf({ x, y, width, height, depth: units, scale_m }) };
}

/** What is handed over with the parts. */
export function transferOf({ virtual, ratio }: LayerParts): Transferable[] {
  return [virtual, ratio].flatMap((part) => (part === null ? [] : [part.bitmap, part.mesh.vertices.buffer, part.mesh.indices.buffer]));
}

export function closeParts({ virtual, ratio }: LayerParts): void {
  virtual?.bitmap.close();
  ratio?.bitmap.close();
}

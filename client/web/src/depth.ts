// Depth as the wire has it (protocol/README.md): a browser writes `zranks` and `zdelta` with nothing but what it has.

import { rankDepth, unrankDepth } from "./depth_ranks";
import type { DepthImage } from "./protocol";

/** Low bytes of the zigzagged row deltas, row-major, then their high bytes. */
export function filterDepth(depth: Uint16Array, width: number): Uint8Array<ArrayBuffer> {
  const planes = new Uint8Array(2 * depth.length);
  for (let i = 0; i < depth.length; i++) {
    const left = i % width === 0 ? 0 : depth[i - 1]!;
    const delta = ((depth[i]! - left) << 16) >> 16; // modulo 2^16, as a signed number
    const zigzag = (delta << 1) ^ (delta >> 15);
    planes[i] = zigzag & 255;
    planes[depth.length + i] = (zigzag >> 8) & 255;
  }
  return planes;
}

export function unfilterDepth(planes: Uint8Array, width: number): Uint16Array<ArrayBuffer> {
  const depth = new Uint16Array(planes.length / 2);
  for (let i = 0; i < depth.length; i++) {
    const zigzag = planes[i]! | (planes[depth.length + i]! << 8);
    const delta = (zigzag >> 1) ^ -(zigzag & 1);
    depth[i] = (i % width === 0 ? 0 : depth[i - 1]!) + delta;
  }
  return depth;
}

export async function encodeDepth(depth: Uint16Array, width: number, codec: "zdelta" | "zranks" = "zdelta"): Promise<DepthImage> {
  const bytes = codec === "zranks" ? rankDepth(depth, width) : filterDepth(depth, width);
  return { width, height: depth.length / width, codec, data: await pipe(bytes, new CompressionStream("deflate-raw")) };
}

export async function decodeDepth(image: DepthImage): Promise<Uint16Array<ArrayBuffer>> {
  const { width, height } = image;
  const codec: string = image.codec; // a recording may be of a later version
  const bytes = await unpacked(codec, image.data);
  if (codec === "zstd-ranks" || codec === "zranks") return unrankDepth(bytes, width, height);
  if (bytes.length !== 2 * width * height) throw new Error("depth is not of the size it declares");
  return codec === "raw" ? new Uint16Array(bytes.slice().buffer) : unfilterDepth(bytes, width);
}

async function unpacked(codec: string, data: Uint8Array): Promise<Uint8Array> {
  switch (codec) {
    case "raw":
      return data;
    case "zdelta":
    case "zranks":
      return pipe(new Uint8Array(data), new DecompressionStream("deflate-raw"));
    case "zstd-delta":
    case "zstd-ranks": // no browser has Zstandard for pages
      return (await import("fzstd")).decompress(data);
    default:
      throw new Error(`depth codec ${codec} is not read here`);
  }
}

async function pipe(
  data: Uint8Array<ArrayBuffer>,
  through: CompressionStream | DecompressionStream,
): Promise<Uint8Array<ArrayBuffer>> {
  return new Uint8Array(await new Response(new Blob([data]).stream().pipeThrough(through)).arrayBuffer());
}

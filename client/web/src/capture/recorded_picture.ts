// A picture of a recording as the browser shows it.

import type { ColorImage } from "../protocol";

/** sRGB. Throws Error for one that cannot be read. */
export function pictureOf(color: ColorImage): Promise<ImageBitmap> {
  if (color.codec !== "raw") {
    return createImageBitmap(new Blob([new Uint8Array(color.data)], { type: `image/${color.codec}` }), { colorSpaceConversion: "none" });
  }
  const codes = color.encoding === "linear16" ? codesOfLinear(color.data) : color.data;
  const count = color.width * color.height;
  if (codes.length !== 3 * count) throw new Error("it is not of the size it declares");
  const rgba = new Uint8ClampedArray(4 * count).fill(255);
  for (let i = 0; i < count; i++) rgba.set(codes.subarray(3 * i, 3 * i + 3), 4 * i);
  return createImageBitmap(new ImageData(rgba, color.width, color.height));
}

/** sRGB codes of little-endian uint16, 65535 the largest. */
function codesOfLinear(data: Uint8Array): Uint8Array {
  const words = new DataView(data.buffer, data.byteOffset, data.byteLength);
  return Uint8Array.from({ length: data.length / 2 }, (_, i) => {
    const value = words.getUint16(2 * i, true) / 65535;
    return Math.round(255 * (value <= 0.0031308 ? 12.92 * value : 1.055 * value ** (1 / 2.4) - 0.055));
  });
}

// Depth as ranks among the values of a picture: what the wire's `zstd-ranks` holds once it is unpacked (protocol/README.md).

const ESCAPE = 15;
const COUNTS_BYTES = 8;

/** uint16, rows from the top. Throws Error for bytes that are not exactly such a picture of this size. */
export function unrankDepth(data: Uint8Array, width: number, height: number): Uint16Array<ArrayBuffer> {
  const pairBytes = Math.ceil(height / 2) * width;
  const words = new DataView(data.buffer, data.byteOffset, data.byteLength);
  const [valueCount, escapeCount] = data.length < COUNTS_BYTES ? [0, 0] : [words.getUint32(0, true), words.getUint32(4, true)];
  if (data.length !== COUNTS_BYTES + 2 * (valueCount + escapeCount) + pairBytes) throw new Error("depth is not of the size it declares");
  const values = summed(numbersOf(data.subarray(COUNTS_BYTES), valueCount));
  const pairs = data.subarray(COUNTS_BYTES + 2 * valueCount);
  const escapes = numbersOf(pairs.subarray(pairBytes), escapeCount);
  const depth = new Uint16Array(width * height);
  let escape = 0;
  for (let y = 0; y < height; y++) {
    let rank = 0;
    for (let x = 0; x < width; x++) {
      const pair = pairs[(y >> 1) * width + x]!;
      const half = y % 2 === 0 ? pair & 15 : pair >> 4;
      const zigzag = half < ESCAPE ? half : ESCAPE + (escapes[escape++] ?? 0);
      rank = (rank + ((zigzag >> 1) ^ -(zigzag & 1))) & 65535;
      if (rank >= valueCount) throw new Error("depth names values that it does not hold");
      depth[y * width + x] = values[rank]!;
    }
  }
  if (escape !== escapeCount) throw new Error("depth is not of the size it declares");
  return depth;
}

/** Low bytes first, then the high bytes. */
const numbersOf = (planes: Uint8Array, count: number): Uint16Array => Uint16Array.from({ length: count }, (_, i) => planes[i]! | (planes[count + i]! << 8));

function summed(steps: Uint16Array): Uint16Array {
  let sum = 0;
  return steps.map((step) => (sum += step));
}

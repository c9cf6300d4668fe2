// Depth as ranks among the values of a picture: what the wire's `zranks` and `zstd-ranks` hold once unpacked (protocol/README.md).

const ESCAPE = 15;
const COUNTS_BYTES = 8;

/** Of uint16, rows from the top. */
export function rankDepth(depth: Uint16Array, width: number): Uint8Array<ArrayBuffer> {
  const height = depth.length / width;
  const ranks = new Int32Array(1 << 16).fill(-1);
  for (const value of depth) ranks[value] = 0;
  const values: number[] = [];
  for (let value = 0; value < ranks.length; value++) if (ranks[value] === 0) ranks[value] = values.push(value) - 1;
  const pairs = new Uint8Array(Math.ceil(height / 2) * width);
  const escapes: number[] = [];
  for (let y = 0; y < height; y++) {
    let left = 0;
    for (let x = 0; x < width; x++) {
      const rank = ranks[depth[y * width + x]!]!;
      const delta = ((rank - left) << 16) >> 16; // modulo 2^16, as a signed number
      const zigzag = ((delta << 1) ^ (delta >> 15)) & 65535;
      if (zigzag >= ESCAPE) escapes.push(zigzag - ESCAPE);
      pairs[(y >> 1) * width + x]! |= Math.min(zigzag, ESCAPE) << (4 * (y & 1));
      left = rank;
    }
  }
  const steps = values.map((value, i) => value - (values[i - 1] ?? 0));
  const counts = new Uint8Array(COUNTS_BYTES);
  new DataView(counts.buffer).setUint32(0, values.length, true);
  new DataView(counts.buffer).setUint32(4, escapes.length, true);
  return joined([counts, planesOf(steps), pairs, planesOf(escapes)]);
}

function joined(parts: readonly Uint8Array[]): Uint8Array<ArrayBuffer> {
  const bytes = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of parts) {
    bytes.set(part, at);
    at += part.length;
  }
  return bytes;
}

/** Low bytes first, then the high bytes. */
const planesOf = (numbers: readonly number[]): Uint8Array => Uint8Array.from([...numbers.map((n) => n & 255), ...numbers.map((n) => n >> 8)]);

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

/** Back from that. */
const numbersOf = (planes: Uint8Array, count: number): Uint16Array => Uint16Array.from({ length: count }, (_, i) => planes[i]! | (planes[count + i]! << 8));

function summed(steps: Uint16Array): Uint16Array {
  let sum = 0;
  return steps.map((step) => (sum += step));
}

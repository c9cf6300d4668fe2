// How long a MessagePack value is, told by what of it is there: a file of messages is read message by message.

/** Bytes of what follows the first byte: its length field, of bytes or of values, and its fixed part. */
const SIZED: Readonly<Record<number, readonly [lengthBytes: number, counts: "bytes" | "values" | "pairs"]>> = {
  0xc4: [1, "bytes"], 0xc5: [2, "bytes"], 0xc6: [4, "bytes"],
  0xd9: [1, "bytes"], 0xda: [2, "bytes"], 0xdb: [4, "bytes"],
  0xdc: [2, "values"], 0xdd: [4, "values"],
  0xde: [2, "pairs"], 0xdf: [4, "pairs"],
};
const FIXED: Readonly<Record<number, number>> = {
  0xc0: 0, 0xc2: 0, 0xc3: 0, 0xca: 4, 0xcb: 8, 0xcc: 1, 0xcd: 2, 0xce: 4, 0xcf: 8, 0xd0: 1, 0xd1: 2, 0xd2: 4, 0xd3: 8,
};

/**
 * How many bytes the value at the beginning has: exactly, or, where it goes on beyond `bytes`, at least so many, which is
 * more than are there. Throws Error for a byte that begins nothing, or an extension, which messages do not have.
 */
export function lengthOfValue(bytes: Uint8Array): number {
  let at = 0;
  for (let values = 1; values > 0; values--) {
    if (at >= bytes.length) return at + values; // each has a byte at least
    const head = headAt(bytes, at);
    at = head.end;
    values += head.values;
  }
  return at;
}

/** Where a value's own bytes end, and how many values follow as its parts. */
function headAt(bytes: Uint8Array, at: number): { end: number; values: number } {
  const first = bytes[at]!;
  if (first <= 0x7f || first >= 0xe0) return { end: at + 1, values: 0 };
  if (first <= 0x8f) return { end: at + 1, values: 2 * (first & 15) };
  if (first <= 0x9f) return { end: at + 1, values: first & 15 };
  if (first <= 0xbf) return { end: at + 1 + (first & 31), values: 0 };
  const fixed = FIXED[first];
  if (fixed !== undefined) return { end: at + 1 + fixed, values: 0 };
  const sized = SIZED[first];
  if (sized === undefined) throw new Error(`byte 0x${first.toString(16)} begins no value`);
  const [lengthBytes, counts] = sized;
  const body = at + 1 + lengthBytes;
  if (body > bytes.length) return { end: body, values: 0 };
  let length = 0;
  for (let i = at + 1; i < body; i++) length = 256 * length + bytes[i]!;
  if (counts === "bytes") return { end: body + length, values: 0 };
  return { end: body, values: counts === "pairs" ? 2 * length : length };
}

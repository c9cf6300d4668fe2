// Sizes of models from their files, and the scale at which one fits into a room.

import { type Size, sizeOfGlb } from "./glb_size";
import type { Model } from "./scene";

/** Models up to this long are taken to be in metres, as server/scene/units.py does. */
const LONGEST_M = 3;
/** Larger than this a model hides the room from a camera that looks at a table, smaller it is hard to see. */
const [LARGEST_M, USUAL_M, SMALLEST_M] = [0.6, 0.3, 0.04] as const;

/** Null where the file does not say it in a way that is read here; the server reads it all. */
export function sizeOf(format: Model["format"], data: Uint8Array<ArrayBuffer>): Size | null {
  try {
    if (format === "glb") return sizeOfGlb(data);
    const [x, y, z] = format === "obj" ? boxOfObj(data) : format === "stl" ? boxOfStl(data) : boxOfPly(data);
    const size: Size = format === "obj" ? [x, y, z] : [x, z, y]; // STL and PLY stand along +z
    return size.every((side) => Number.isFinite(side) && side >= 0) && Math.max(...size) > 0 ? size : null;
  } catch {
    return null; // the server says what is wrong with it
  }
}

/** The scale at which a model of this size is shown first: metres, else centimetres or millimetres, and no longer than fits. */
export function fittingScale(size: Size, format: Model["format"]): number {
  const longest = Math.max(...size);
  const units = longest <= LONGEST_M ? 1 : format !== "stl" && format !== "ply" && longest <= 100 * LONGEST_M ? 0.01 : 0.001;
  const longest_m = longest * units;
  if (longest_m <= LARGEST_M && longest_m >= SMALLEST_M) return units;
  return rounded((USUAL_M / longest_m) * units);
}

/** Two significant digits, so that it can be read aloud. */
const rounded = (value: number): number => Number(value.toPrecision(2));

class Box {
  private readonly low = [Infinity, Infinity, Infinity];
  private readonly high = [-Infinity, -Infinity, -Infinity];

  add(x: number, y: number, z: number): void {
    [x, y, z].forEach((value, axis) => {
      this.low[axis] = Math.min(this.low[axis]!, value);
      this.high[axis] = Math.max(this.high[axis]!, value);
    });
  }

  get size(): [number, number, number] {
    return [this.high[0]! - this.low[0]!, this.high[1]! - this.low[1]!, this.high[2]! - this.low[2]!];
  }
}

function boxOfObj(data: Uint8Array): [number, number, number] {
  const box = new Box();
  for (const [, x, y, z] of text(data).matchAll(/^[ \t]*v[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)/gm)) box.add(Number(x), Number(y), Number(z));
  return box.size;
}

/** 80 bytes, the number of triangles, then 50 bytes each: a normal, three corners, two bytes. Else it is text. */
function boxOfStl(data: Uint8Array): [number, number, number] {
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  const box = new Box();
  const count = data.length >= 84 ? view.getUint32(80, true) : 0;
  if (data.length !== 84 + 50 * count) {
    for (const [, x, y, z] of text(data).matchAll(/vertex[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)/g)) box.add(Number(x), Number(y), Number(z));
    return box.size;
  }
  for (let corner = 0; corner < 3 * count; corner++) {
    const at = 84 + 50 * Math.floor(corner / 3) + 12 * (1 + (corner % 3));
    box.add(view.getFloat32(at, true), view.getFloat32(at + 4, true), view.getFloat32(at + 8, true));
  }
  return box.size;
}

const PLY_BYTES: Readonly<Record<string, number>> = {
  char: 1, uchar: 1, int8: 1, uint8: 1, short: 2, ushort: 2, int16: 2, uint16: 2, int: 4, uint: 4, int32: 4, uint32: 4, float: 4, float32: 4, double: 8, float64: 8,
};

/** Of files whose first element is vertices that begin with x, y, z. */
function boxOfPly(data: Uint8Array): [number, number, number] {
  const head = text(data.subarray(0, 4096));
  const end = /end_header\r?\n/.exec(head);
  const first = /element vertex (\d+)\r?\n((?:property [^\n]*\n)+)/.exec(head);
  if (end === null || first === null) throw new Error("no vertices");
  const properties = [...first[2]!.matchAll(/property (\S+) (\S+)/g)].map(([, type, name]) => ({ bytes: PLY_BYTES[type!]!, name }));
  if (properties.slice(0, 3).map(({ name }) => name).join() !== "x,y,z") throw new Error("no vertices first");
  const [box, count, body] = [new Box(), Number(first[1]), data.subarray(end.index + end[0].length)];
  if (/format ascii/.test(head)) {
    for (const line of text(body).split("\n", count)) {
      const [x, y, z] = line.trim().split(/\s+/).map(Number);
      box.add(x!, y!, z!);
    }
    return box.size;
  }
  const view = new DataView(body.buffer, body.byteOffset, body.byteLength);
  const isLittle = /format binary_little/.test(head);
  const step = properties.reduce((sum, { bytes }) => sum + bytes, 0);
  const [bytes] = [properties[0]!.bytes];
  const read = (at: number): number => (bytes === 8 ? view.getFloat64(at, isLittle) : view.getFloat32(at, isLittle));
  for (let i = 0; i < count; i++) box.add(read(i * step), read(i * step + bytes), read(i * step + 2 * bytes));
  return box.size;
}

const text = (data: Uint8Array): string => new TextDecoder("latin1").decode(data);

// The size of what a GLB shows, from the boxes of its accessors and the transforms of its nodes.

/** Width, height and depth, as the model stands; in units of the file. */
export type Size = readonly [number, number, number];

const MAGIC = 0x46546c67;
type Matrix = readonly number[];

interface Document {
  scene?: number;
  scenes?: { nodes?: number[] }[];
  nodes?: { mesh?: number; children?: number[]; matrix?: number[]; translation?: number[]; rotation?: number[]; scale?: number[] }[];
  meshes?: { primitives: { attributes: { POSITION: number } }[] }[];
  accessors?: { min: number[]; max: number[] }[];
}

/** Width, height and depth; null where the file does not say it. */
export function sizeOfGlb(data: Uint8Array): Size | null {
  try {
    const words = new DataView(data.buffer, data.byteOffset, data.byteLength);
    if (words.getUint32(0, true) !== MAGIC) return null;
    const document = JSON.parse(new TextDecoder().decode(data.subarray(20, 20 + words.getUint32(12, true)))) as Document;
    const corners = document.scenes![document.scene ?? 0]!.nodes!.flatMap((node) => cornersOf(document, node, IDENTITY, 0));
    const side = (axis: number): number => Math.max(...corners.map((each) => each[axis]!)) - Math.min(...corners.map((each) => each[axis]!));
    const size: Size = [side(0), side(1), side(2)];
    return size.every((each) => Number.isFinite(each)) ? size : null;
  } catch {
    return null; // the server says what is wrong with it
  }
}

const DEEPEST = 64;

function cornersOf(document: Document, index: number, parent: Matrix, depth: number): number[][] {
  const node = document.nodes![index]!;
  if (depth > DEEPEST) throw new Error("nodes in a circle");
  const matrix = product(parent, node.matrix ?? fromParts(node.translation, node.rotation, node.scale));
  const own = node.mesh === undefined ? [] : document.meshes![node.mesh]!.primitives.flatMap(({ attributes }) => boxCorners(document.accessors![attributes.POSITION]!));
  return [...own.map((point) => moved(matrix, point)), ...(node.children ?? []).flatMap((child) => cornersOf(document, child, matrix, depth + 1))];
}

const boxCorners = ({ min, max }: { min: number[]; max: number[] }): number[][] =>
  Array.from({ length: 8 }, (_, corner) => [0, 1, 2].map((axis) => ((corner >> axis) & 1 ? max : min)[axis]!));

/** Column-major, as glTF has them. */
const IDENTITY: Matrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

const moved = (m: Matrix, point: number[]): number[] => [0, 1, 2].map((row) => m[row]! * point[0]! + m[4 + row]! * point[1]! + m[8 + row]! * point[2]! + m[12 + row]!);

const product = (a: Matrix, b: Matrix): Matrix =>
  Array.from({ length: 16 }, (_, i) => [0, 1, 2, 3].reduce((sum, k) => sum + a[4 * k + (i % 4)]! * b[4 * Math.floor(i / 4) + k]!, 0));

function fromParts([tx, ty, tz]: number[] = [0, 0, 0], [x, y, z, w]: number[] = [0, 0, 0, 1], [sx, sy, sz]: number[] = [1, 1, 1]): Matrix {
  const column = (a: number, b: number, c: number, by: number): number[] => [a * by, b * by, c * by, 0];
  const [qx, qy, qz, qw] = [x!, y!, z!, w!];
  return [
    ...column(1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy + qw * qz), 2 * (qx * qz - qw * qy), sx!),
    ...column(2 * (qx * qy - qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz + qw * qx), sy!),
    ...column(2 * (qx * qz + qw * qy), 2 * (qy * qz - qw * qx), 1 - 2 * (qx * qx + qy * qy), sz!),
    tx!, ty!, tz!, 1,
  ];
}

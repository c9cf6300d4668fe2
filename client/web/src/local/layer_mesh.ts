// The surface under a part of a picture, from the depth of its pixels: triangles over them, cut where depth jumps.

/** Neighbours farther apart than this share of their depth, a pixel, are of two surfaces. */
const JUMP = 0.05;
/** Of larger parts, a cell of the surface is of more pixels than one. */
const MOST_CELLS = 1 << 16;

export interface DepthPart {
  /** Column and row of the camera's picture in which the part begins. */
  x: number;
  y: number;
  width: number;
  height: number;
  /** Units, 0 where the pixel says nothing. */
  depth: Uint16Array;
  scale_m: number;
}

export interface LayerMesh {
  /** Of each corner of pixels: column and row in the camera's picture, and metres along the camera's z. */
  vertices: Float32Array<ArrayBuffer>;
  /** Three of a triangle. */
  indices: Uint32Array<ArrayBuffer>;
}

/** Of a cell's corners. */
const TRIANGLES = [0, 2, 1, 1, 2, 3] as const;

interface Cells {
  /** Pixels along a side of a cell. */
  step: number;
  columns: number;
  rows: number;
  /** The nearest depth in each, 0 where there is none. */
  depth: Uint16Array;
}

export function meshOf(part: DepthPart): LayerMesh {
  const { columns, rows, step, depth } = cellsOf(part);
  const known = depth.reduce((count, z) => count + Number(z > 0), 0);
  const vertices = new Float32Array(3 * 4 * known);
  /** Of each cell its four vertices: above left, above right, below left, below right. */
  const corners = new Uint32Array(4 * columns * rows);
  let count = 0;
  /** A vertex of those of the four cells around a corner that are set in `members`, bit by bit. */
  const join = (column: number, row: number, z: Depths, members: number): void => {
    let [inverse, number] = [0, 0];
    for (let k = 0; k < 4; k++) {
      if (!(members & (1 << k))) continue;
      inverse += 1 / z[k]!; // of a plane, it is linear in the picture
      number++;
      corners[4 * ((row - 1 + (k >> 1)) * columns + column - 1 + (k & 1)) + (3 - k)] = count;
    }
    vertices[3 * count] = part.x + Math.min(column * step, part.width) - 0.5;
    vertices[3 * count + 1] = part.y + Math.min(row * step, part.height) - 0.5;
    vertices[3 * count++ + 2] = (number / inverse) * part.scale_m;
  };
  const z: Depths = [0, 0, 0, 0];
  for (let row = 0; row <= rows; row++) {
    for (let column = 0; column <= columns; column++) {
      const [isLeft, isRight, here] = [column > 0, column < columns, row * columns + column];
      z[0] = row > 0 && isLeft ? depth[here - columns - 1]! : 0;
      z[1] = row > 0 && isRight ? depth[here - columns]! : 0;
      z[2] = row < rows && isLeft ? depth[here - 1]! : 0;
      z[3] = row < rows && isRight ? depth[here]! : 0;
      const near = Math.min(z[0], z[1], z[2], z[3]);
      const far = Math.max(z[0], z[1], z[2], z[3]);
      if (near > 0 && far - near <= JUMP * step * near) join(column, row, z, 0b1111);
      else if (far > 0) for (const members of surfacesOf(z, JUMP * step)) join(column, row, z, members);
    }
  }
  return { vertices: vertices.slice(0, 3 * count), indices: trianglesOf(depth, corners, known) };
}

type Depths = [number, number, number, number];

function cellsOf({ width, height, depth }: DepthPart): Cells {
  const step = Math.ceil(Math.sqrt((width * height) / MOST_CELLS));
  if (step === 1) return { step, columns: width, rows: height, depth };
  const [columns, rows] = [Math.ceil(width / step), Math.ceil(height / step)];
  const nearest = new Uint16Array(columns * rows);
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) {
      const cell = Math.floor(y / step) * columns + Math.floor(x / step);
      const z = depth[y * width + x]!;
      if (z > 0 && (nearest[cell] === 0 || z < nearest[cell]!)) nearest[cell] = z;
    }
  }
  return { step, columns, rows, depth: nearest };
}

/** Four depths around a corner, by the surfaces that they are of: the members of each as bits. */
function surfacesOf(z: Depths, jump: number): number[] {
  let surfaces: number[] = [];
  for (let k = 0; k < 4; k++) {
    if (z[k] === 0) continue;
    const isNear = (i: number): boolean => z[i]! > 0 && Math.abs(z[i]! - z[k]!) <= jump * Math.min(z[i]!, z[k]!);
    const touched = surfaces.filter((members) => [0, 1, 2, 3].some((i) => members & (1 << i) && isNear(i)));
    const joined = touched.reduce((all, members) => all | members, 1 << k);
    surfaces = [...surfaces.filter((members) => !touched.includes(members)), joined];
  }
  return surfaces;
}

function trianglesOf(depth: Uint16Array, corners: Uint32Array, known: number): Uint32Array<ArrayBuffer> {
  const indices = new Uint32Array(6 * known);
  let count = 0;
  for (let cell = 0; cell < depth.length; cell++) {
    if (depth[cell] === 0) continue;
    for (const corner of TRIANGLES) indices[count++] = corners[4 * cell + corner]!;
  }
  return indices;
}

// From the camera of one frame to the screen of another.

import type { Lens } from "../capture/axes";

/** Where a picture is drawn from, as WebXR tells it: column-major, camera x right, y up, z backward. */
export interface View {
  readonly projectionMatrix: Float32Array;
  readonly transform: { readonly matrix: Float32Array };
}

const NEAR_M = 0.05;
/** A camera in the origin, turned by nothing. */
export const STANDING: readonly number[] = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

/** 4x4, column-major, to clip space: of points of a camera (the wire's axes) that stood there (row-major). */
export function clipFromCamera({ projectionMatrix, transform: { matrix } }: View, worldFromCamera: readonly number[]): Float32Array {
  const clip = new Float32Array(16);
  const [px, py, pz] = [matrix[12]!, matrix[13]!, matrix[14]!];
  for (let column = 0; column < 4; column++) {
    const at = (row: number): number => worldFromCamera[4 * row + column]!;
    const [x, y, z] = column < 3 ? [at(0), at(1), at(2)] : [at(0) - px, at(1) - py, at(2) - pz];
    const inView = [0, 1, 2].map((axis) => matrix[4 * axis]! * x + matrix[4 * axis + 1]! * y + matrix[4 * axis + 2]! * z);
    for (let row = 0; row < 4; row++) {
      const offset = column < 3 ? 0 : projectionMatrix[12 + row]!;
      clip[4 * column + row] = inView.reduce((sum, value, axis) => sum + projectionMatrix[4 * axis + row]! * value, offset);
    }
  }
  return clip;
}

/** The view of a camera with this lens that stands there (row-major, the wire's axes). */
export function viewOf({ width, height, fx, fy, cx, cy }: Lens, worldFromCamera: readonly number[]): View {
  const at = (row: number, column: number): number => worldFromCamera[4 * row + column]!;
  const turned = [0, 1, 2, 3].flatMap((column) => [0, 1, 2, 3].map((row) => (column === 1 || column === 2 ? -1 : 1) * at(row, column)));
  const projection = [(2 * fx) / width, 0, 0, 0, 0, (2 * fy) / height, 0, 0, 1 - (2 * cx + 1) / width, (2 * cy + 1) / height - 1, -1, -1, 0, 0, -2 * NEAR_M, 0];
  return { projectionMatrix: new Float32Array(projection), transform: { matrix: new Float32Array(turned) } };
}

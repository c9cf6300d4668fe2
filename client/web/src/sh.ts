// Real orthonormal spherical harmonics without Condon-Shortley phase, index l(l+1)+m, up to l = 3 (protocol/README.md).

export type Vector3 = readonly [number, number, number];
export type Rgb = readonly [number, number, number];

export const COEFFICIENTS = 16;

/** Lambert's transfer with its 1/pi, per band (Ramamoorthi and Hanrahan 2001): a uniform sky of 1 shades white to 1. */
const LAMBERT = [1, 2 / 3, 1 / 4, 0] as const;

/** The 16 basis functions in the unit direction (x, y, z), written to `out`. */
export function evaluateBasis(x: number, y: number, z: number, out: Float64Array): void {
  out[0] = 0.28209479177387814;
  out[1] = 0.4886025119029199 * y;
  out[2] = 0.4886025119029199 * z;
  out[3] = 0.4886025119029199 * x;
  out[4] = 1.0925484305920792 * x * y;
  out[5] = 1.0925484305920792 * y * z;
  out[6] = 0.31539156525252005 * (3 * z * z - 1);
  out[7] = 1.0925484305920792 * x * z;
  out[8] = 0.5462742152960396 * (x * x - y * y);
  out[9] = 0.5900435899266435 * y * (3 * x * x - y * y);
  out[10] = 2.890611442640554 * x * y * z;
  out[11] = 0.4570457994644658 * y * (5 * z * z - 1);
  out[12] = 0.3731763325901154 * z * (5 * z * z - 3);
  out[13] = 0.4570457994644658 * x * (5 * z * z - 1);
  out[14] = 1.445305721320277 * z * (x * x - y * y);
  out[15] = 0.5900435899266435 * x * (x * x - 3 * y * y);
}

/** 16 x RGB of radiance as one flat array; coefficients that are missing are 0. */
export function flatten(sh: readonly Rgb[]): Float64Array {
  const flat = new Float64Array(3 * COEFFICIENTS);
  for (let i = 0; i < COEFFICIENTS; i++) flat.set(sh[i] ?? [0, 0, 0], 3 * i);
  return flat;
}

/** Radiance coefficients to those of what a white matt surface sends back, as a function of its normal. */
export function toMatt(flat: Float64Array): Float64Array {
  return flat.map((value, i) => value * (LAMBERT[Math.floor(Math.sqrt(Math.floor(i / 3)))] ?? 0));
}

const scratch = new Float64Array(COEFFICIENTS);

/** The value of flat coefficients in a unit direction, written to `rgb`; negative lobes are left as they are. */
export function evaluate(flat: Float64Array, x: number, y: number, z: number, rgb: Float64Array): void {
  evaluateBasis(x, y, z, scratch);
  let red = 0;
  let green = 0;
  let blue = 0;
  for (let i = 0; i < COEFFICIENTS; i++) {
    const basis = scratch[i]!;
    red += basis * flat[3 * i]!;
    green += basis * flat[3 * i + 1]!;
    blue += basis * flat[3 * i + 2]!;
  }
  rgb[0] = red;
  rgb[1] = green;
  rgb[2] = blue;
}

export function luminance(red: number, green: number, blue: number): number {
  return 0.2126 * red + 0.7152 * green + 0.0722 * blue;
}

/** `world_from_camera` (row-major 4x4) applied to a direction. */
export function toWorld(m: readonly number[], [x, y, z]: Vector3): Vector3 {
  return [
    m[0]! * x + m[1]! * y + m[2]! * z,
    m[4]! * x + m[5]! * y + m[6]! * z,
    m[8]! * x + m[9]! * y + m[10]! * z,
  ];
}

/** The transposed rotation of `world_from_camera` applied to a direction. */
export function toCamera(m: readonly number[], [x, y, z]: Vector3): Vector3 {
  return [
    m[0]! * x + m[4]! * y + m[8]! * z,
    m[1]! * x + m[5]! * y + m[9]! * z,
    m[2]! * x + m[6]! * y + m[10]! * z,
  ];
}

// Converts WebXR's conventions to those of the wire format (protocol/README.md).
//
// WebXR: camera x right, y up, z backward; matrices column-major; pictures' edges are at -1 and 1.
// The wire: camera x right, y down, z forward; matrices row-major; a pixel's centre is at integer coordinates.

import type { CameraModel, DepthCamera } from "../protocol";
import type { XrDepth, XrDepthFormat } from "./xr";

export interface Lens {
  width: number;
  height: number;
  fx: number;
  fy: number;
  cx: number;
  cy: number;
}

/** `world_from_camera` of a view's `transform.matrix`. */
export function worldFromCamera(matrix: Float32Array): number[] {
  const at = (row: number, column: number): number => matrix[4 * column + row]!;
  return [0, 1, 2, 3].flatMap((row) => [at(row, 0), -at(row, 1), -at(row, 2), at(row, 3)]);
}

/** The lens of an image of this size that fills the view. */
export function lensOf(projection: Float32Array, width: number, height: number): Lens {
  return {
    width,
    height,
    fx: (projection[0]! * width) / 2,
    fy: (projection[5]! * height) / 2,
    cx: ((1 - projection[8]!) * width) / 2 - 0.5,
    cy: ((1 + projection[9]!) * height) / 2 - 0.5,
  };
}

/** Position of the depth in the view: x in [0, 1] of the view's side is at `share x + offset` of the depth's side. */
export interface UprightDepth {
  width: number;
  height: number;
  units: Uint16Array<ArrayBuffer>;
  share: readonly [number, number];
  offset: readonly [number, number];
}

const MOST_UNITS = 65535;

/** uint16 values of a depth buffer, 0: no measurement, and the unit in metres. */
export function depthUnits(depth: XrDepth, format: XrDepthFormat): { units: Uint16Array; scale_m: number } {
  const count = depth.width * depth.height;
  if (format !== "float32") return { units: new Uint16Array(depth.data, 0, count), scale_m: depth.rawValueToMeters };
  const values = new Float32Array(depth.data, 0, count);
  const units = new Uint16Array(count);
  for (let i = 0; i < count; i++) {
    const millimetres = Math.round(values[i]! * depth.rawValueToMeters * 1000);
    units[i] = millimetres > 0 && millimetres <= MOST_UNITS ? millimetres : 0;
  }
  return { units, scale_m: 0.001 };
}

/**
 * Turn a depth buffer upright in the view; every value is kept. Sensors lie across a tablet that is held upright, so that
 * `normDepthBufferFromNormView` (view and buffer from 0 to 1, y down) turns by quarters and cuts off margins.
 * Throws Error where it does anything else.
 */
export function upright(units: Uint16Array, width: number, height: number, matrix: Float32Array): UprightDepth {
  const [a, b, c, d] = [matrix[0]!, matrix[4]!, matrix[1]!, matrix[5]!]; // column = a x + b y, row = c x + d y
  const isTurned = Math.abs(b) + Math.abs(c) > Math.abs(a) + Math.abs(d);
  const [along, across] = isTurned ? [c, b] : [a, d]; // by what the view's x and y move in the buffer
  const skew = isTurned ? Math.abs(a) + Math.abs(d) : Math.abs(b) + Math.abs(c);
  if (skew > 1e-3 || along === 0 || across === 0) throw new Error("this device's depth lies askew in its picture");
  const [size, other] = isTurned ? [height, width] : [width, height];
  const [startX, startY] = isTurned ? [matrix[13]!, matrix[12]!] : [matrix[12]!, matrix[13]!];
  const result = new Uint16Array(units.length);
  for (let y = 0; y < other; y++) {
    const fromY = across > 0 ? y : other - 1 - y;
    for (let x = 0; x < size; x++) {
      const fromX = along > 0 ? x : size - 1 - x;
      result[y * size + x] = units[isTurned ? fromX * width + fromY : fromY * width + fromX]!;
    }
  }
  return {
    width: size,
    height: other,
    units: result,
    share: [Math.abs(along), Math.abs(across)],
    offset: [along > 0 ? startX : 1 - startX, across > 0 ? startY : 1 - startY],
  };
}

/** The lens of upright depth for a colour image that fills the view. */
export function depthLens(color: Lens, depth: UprightDepth): Lens {
  const [shareX, shareY] = depth.share;
  const [offsetX, offsetY] = depth.offset;
  const across = (depth.width * shareX) / color.width;
  const down = (depth.height * shareY) / color.height;
  return {
    width: depth.width,
    height: depth.height,
    fx: color.fx * across,
    fy: color.fy * down,
    cx: (color.cx + 0.5) * across + depth.width * offsetX - 0.5,
    cy: (color.cy + 0.5) * down + depth.height * offsetY - 0.5,
  };
}

const NUMBERS = ["fx", "fy", "cx", "cy"] as const;
/** Tolerance as a share of the width; smaller differences are rounding. */
const SAME = 2e-3;

/** Whether two cameras are equal, so that a session may continue. */
export function isSameCamera(a: CameraModel, b: CameraModel): boolean {
  return a.depth_scale_m === b.depth_scale_m && isSameLens(a, b) && isSameLens(a.depth ?? null, b.depth ?? null);
}

function isSameLens(a: Lens | DepthCamera | null, b: Lens | DepthCamera | null): boolean {
  if (a === null || b === null) return a === b;
  return a.width === b.width && a.height === b.height && NUMBERS.every((name) => Math.abs(a[name] - b[name]) < SAME * a.width);
}

// Where light comes from, in words that need no axes.

import type { Vector3 } from "./sh";

const DEGREE = Math.PI / 180;
/** Elevation in degrees from which on a light comes from straight above or below. */
const STEEP = 65;
const SLANTED = 20;

export interface Whence {
  text: string;
  elevation_deg: number;
  /** To the right of the camera's view, -180 to 180. */
  azimuth_deg: number;
}

/** A world direction towards a light, for a viewer behind the camera of `pose` (3x4 or 4x4, row-major); null: there is none. */
export function whence(towards: Vector3, up: Vector3, pose: readonly number[]): Whence | null {
  if (Math.hypot(...towards) < 1e-6) return null;
  const vertical = dot(towards, up) / Math.hypot(...towards);
  const elevation_deg = Math.asin(Math.max(-1, Math.min(1, vertical))) / DEGREE;
  const [ahead, right] = horizontal(up, pose);
  const azimuth_deg = Math.atan2(dot(towards, right), dot(towards, ahead)) / DEGREE;
  return { text: inWords(elevation_deg, azimuth_deg), elevation_deg, azimuth_deg };
}

function inWords(elevation: number, azimuth: number): string {
  if (elevation >= STEEP) return "from above";
  if (elevation <= -STEEP) return "from below";
  const height = elevation >= SLANTED ? "from above, " : elevation <= -SLANTED ? "from below, " : "from the side, ";
  return height + SECTORS[((Math.round(azimuth / 45) % 8) + 8) % 8]!;
}

const SECTORS = ["ahead", "ahead on the right", "on the right", "behind on the right", "behind the camera", "behind on the left", "on the left", "ahead on the left"];

/** Horizontal unit vectors along and to the right of the camera's view. */
export function horizontal(up: Vector3, pose: readonly number[]): [ahead: Vector3, right: Vector3] {
  const axis = (column: number): Vector3 => [pose[column]!, pose[4 + column]!, pose[8 + column]!];
  const flat = (v: Vector3): Vector3 => subtract(v, up, dot(v, up));
  let ahead = flat(axis(2));
  if (Math.hypot(...ahead) < 0.05) ahead = flat(axis(1)); // it looks straight up or down
  const length = Math.hypot(...ahead);
  ahead = [ahead[0] / length, ahead[1] / length, ahead[2] / length];
  return [ahead, cross(ahead, up)];
}

const dot = (a: Vector3, b: Vector3): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const subtract = (a: Vector3, b: Vector3, times: number): Vector3 => [a[0] - times * b[0], a[1] - times * b[1], a[2] - times * b[2]];
const cross = (a: Vector3, b: Vector3): Vector3 => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

// From a finger on the picture to a place in the room, and back. World axes of a WebXR session: +y is up.

import type { Lens } from "../capture/axes";
import type { CameraModel } from "../protocol";
import { toCamera, toWorld, type Vector3 } from "../sh";

/** A frame as far as a finger needs it. */
export interface Seen {
  camera: CameraModel;
  /** Row-major. */
  world_from_camera: readonly number[];
  depth: Uint16Array;
}

export interface Pixel {
  x: number;
  y: number;
}

export const positionOf = (m: readonly number[]): Vector3 => [m[3]!, m[7]!, m[11]!];

export function toWorldPoint(m: readonly number[], point: Vector3): Vector3 {
  const turned = toWorld(m, point);
  return [turned[0] + m[3]!, turned[1] + m[7]!, turned[2] + m[11]!];
}

/** Where a point of the world is in the picture; null behind the camera. */
export function project(lens: Lens, worldFromCamera: readonly number[], [x, y, z]: Vector3): Pixel | null {
  const [px, py, pz] = positionOf(worldFromCamera);
  const [right, down, ahead] = toCamera(worldFromCamera, [x - px, y - py, z - pz]);
  if (ahead < 0.01) return null;
  return { x: lens.cx + (lens.fx * right) / ahead, y: lens.cy + (lens.fy * down) / ahead };
}

const FARTHEST_PX = 6;

/** The surface under a pixel of the picture; null where none was measured there or near. */
export function surfaceAt({ camera, world_from_camera, depth }: Seen, pixel: Pixel): Vector3 | null {
  const [right, down] = slopes(camera, pixel);
  const lens = camera.depth ?? camera;
  const column = Math.round(lens.cx + lens.fx * right);
  const row = Math.round(lens.cy + lens.fy * down);
  for (let reach = 1; reach <= FARTHEST_PX; reach += 2) {
    const units = medianAround(depth, lens, column, row, reach);
    if (units === null) continue;
    const ahead = units * (camera.depth_scale_m ?? 0.001);
    return toWorldPoint(world_from_camera, [right * ahead, down * ahead, ahead]);
  }
  return null;
}

/** Where the ray through a pixel meets the level plane at height `y`; null where it does not, or beyond 20 m. */
export function levelAt({ camera, world_from_camera }: Omit<Seen, "depth">, pixel: Pixel, y: number): Vector3 | null {
  const [right, down] = slopes(camera, pixel);
  const ray = toWorld(world_from_camera, [right, down, 1]);
  const from = positionOf(world_from_camera);
  const ahead = (y - from[1]) / ray[1];
  if (!Number.isFinite(ahead) || ahead <= 0 || ahead > 20) return null;
  return [from[0] + ahead * ray[0], y, from[2] + ahead * ray[2]];
}

/** How far a pixel's ray goes right and down for each metre ahead. */
function slopes(camera: Lens, pixel: Pixel): [number, number] {
  return [(pixel.x - camera.cx) / camera.fx, (pixel.y - camera.cy) / camera.fy];
}

function medianAround(depth: Uint16Array, { width, height }: Lens, column: number, row: number, reach: number): number | null {
  const found: number[] = [];
  for (let y = Math.max(0, row - reach); y <= Math.min(height - 1, row + reach); y++) {
    for (let x = Math.max(0, column - reach); x <= Math.min(width - 1, column + reach); x++) {
      const units = depth[y * width + x]!;
      if (units > 0) found.push(units);
    }
  }
  found.sort((a, b) => a - b);
  return found[Math.floor(found.length / 2)] ?? null;
}

const LOWEST_SHARE = 0.02;

/** Height of the lowest surface in sight, a few outliers aside; null without depth. */
export function floorOf({ camera, world_from_camera, depth }: Seen): number | null {
  const lens = camera.depth ?? camera;
  const heights: number[] = [];
  for (let i = 0; i < depth.length; i += 7) {
    const ahead = depth[i]! * (camera.depth_scale_m ?? 0.001);
    if (ahead === 0) continue;
    const [x, y] = [i % lens.width, Math.floor(i / lens.width)];
    heights.push(toWorldPoint(world_from_camera, [((x - lens.cx) / lens.fx) * ahead, ((y - lens.cy) / lens.fy) * ahead, ahead])[1]);
  }
  heights.sort((a, b) => a - b);
  return heights[Math.floor(heights.length * LOWEST_SHARE)] ?? null;
}

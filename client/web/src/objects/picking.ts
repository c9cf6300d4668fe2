// Picking: maps between pixels of the image and points in the room.

import type { Lens } from "../capture/axes";
import { decodeDepth } from "../depth";
import type { CameraModel, DepthImage } from "../protocol";
import { toCamera, toWorld, type Vector3 } from "../sh";

/** Up direction in a WebXR session's world. */
export const Y_UP: Vector3 = [0, 1, 0];

/** Data of a frame that picking needs. */
export interface Seen {
  camera: CameraModel;
  /** Row-major pose of the image on the screen. */
  world_from_camera: readonly number[];
  /** Pose of the depth, if it belongs to another image. */
  measured_from?: readonly number[];
  /** Unit vector in the world. */
  up: Vector3;
  /** Compressed until it is needed; null: the server alone has it. */
  depth: Uint16Array | DepthImage | null;
}

export interface Measured extends Seen {
  depth: Uint16Array;
}

export const isMeasured = (seen: Seen): seen is Measured => seen.depth instanceof Uint16Array;

/** The frame with its depth decompressed and cached. Throws Error. */
export async function measured(seen: Seen): Promise<Measured> {
  if (seen.depth === null) throw new Error("no depth came with this picture");
  if (!isMeasured(seen)) seen.depth = await decodeDepth(seen.depth as DepthImage);
  return seen as Measured;
}

/** The same depth with an image taken from another pose. */
export function seenFrom(seen: Seen, world_from_camera: readonly number[]): Seen {
  return { ...seen, world_from_camera, measured_from: seen.measured_from ?? seen.world_from_camera };
}

/** The level axes that a model at yaw 0 stands in, as server/scene/placement.py has them: right, up, front. */
export function uprightAxes(up: Vector3): readonly [Vector3, Vector3, Vector3] {
  let right = levelled([1, 0, 0], up);
  if (Math.hypot(...right) < 1e-3) right = levelled([0, 1, 0], up);
  right = scaled(right, 1 / Math.hypot(...right));
  return [right, up, cross(right, up)];
}

export const dot = (a: Vector3, b: Vector3): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const scaled = (a: Vector3, by: number): Vector3 => [a[0] * by, a[1] * by, a[2] * by];
export const sum = (...all: readonly Vector3[]): Vector3 => all.reduce((a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]]);
export const cross = (a: Vector3, b: Vector3): Vector3 => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
/** Horizontal part of a direction. */
export const levelled = (a: Vector3, up: Vector3): Vector3 => sum(a, scaled(up, -dot(a, up)));

export interface Pixel {
  x: number;
  y: number;
}

export const positionOf = (m: readonly number[]): Vector3 => [m[3]!, m[7]!, m[11]!];

export function toWorldPoint(m: readonly number[], point: Vector3): Vector3 {
  const turned = toWorld(m, point);
  return [turned[0] + m[3]!, turned[1] + m[7]!, turned[2] + m[11]!];
}

/** Pixel of a world point; null behind the camera. */
export function project(lens: Lens, worldFromCamera: readonly number[], [x, y, z]: Vector3): Pixel | null {
  const [px, py, pz] = positionOf(worldFromCamera);
  const [right, down, ahead] = toCamera(worldFromCamera, [x - px, y - py, z - pz]);
  if (ahead < 0.01) return null;
  return { x: lens.cx + (lens.fx * right) / ahead, y: lens.cy + (lens.fy * down) / ahead };
}

const FARTHEST_PX = 6;
/** Step length as a share of the distance, and assumed thickness of surfaces: points further behind are occluded. */
const [FIRST_M, LAST_M, STEP, THICKNESS] = [0.1, 20, 1.01, 0.03] as const;

/** The surface point at a pixel; null if there is no depth nearby. Ignores distortion. */
export function surfaceAt(seen: Omit<Measured, "up">, pixel: Pixel): Vector3 | null {
  const [right, down] = slopes(seen.camera, pixel);
  for (let reach = 1; reach <= FARTHEST_PX; reach += 2) {
    const ahead = aheadOf(seen, right, down, reach);
    if (ahead !== null) return toWorldPoint(seen.world_from_camera, [right * ahead, down * ahead, ahead]);
  }
  return null;
}

/** Distance along z at which the ray first meets the depth; by ray marching if depth has another pose. */
function aheadOf(seen: Omit<Measured, "up">, right: number, down: number, reach: number): number | null {
  const { camera, world_from_camera, depth } = seen;
  const lens = camera.depth ?? camera;
  const inWorld = (ahead: number): Vector3 => toWorldPoint(world_from_camera, [right * ahead, down * ahead, ahead]);
  const worldFromLens = worldFromLensOf(seen);
  /** Distance of a ray point behind the surface; null without depth. */
  const behind = (ahead: number): number | null => {
    const point = inWorld(ahead);
    const place = project(lens, worldFromLens, point);
    const units = place === null ? null : medianAround(depth, lens, Math.round(place.x), Math.round(place.y), reach);
    return units === null ? null : aheadIn(worldFromLens, point) - units * (camera.depth_scale_m ?? 0.001);
  };
  if (worldFromLens === world_from_camera) {
    const there = behind(FIRST_M);
    return there === null ? null : FIRST_M - there;
  }
  let [before, beforeBehind]: [number, number | null] = [FIRST_M, null];
  for (let ahead = FIRST_M; ahead < LAST_M; ahead *= STEP) {
    const now = behind(ahead);
    if (now !== null && now >= 0 && now < THICKNESS * ahead) {
      return beforeBehind === null ? ahead : before + ((ahead - before) * -beforeBehind) / (now - beforeBehind);
    }
    [before, beforeBehind] = [ahead, now !== null && now < 0 ? now : null];
  }
  return null;
}

/** Lens of the depth; the camera's if they share one. */
function worldFromLensOf({ camera, world_from_camera, measured_from = world_from_camera }: Pick<Measured, "camera" | "world_from_camera" | "measured_from">): readonly number[] {
  const fromLens = camera.depth?.color_from_depth;
  if (fromLens === undefined) return measured_from;
  const column = (i: number): Vector3 => toWorld(measured_from, [fromLens[i]!, fromLens[4 + i]!, fromLens[8 + i]!]);
  const [x, y, z] = [column(0), column(1), column(2)];
  const place = toWorldPoint(measured_from, positionOf(fromLens));
  return [0, 1, 2].flatMap((row) => [x[row]!, y[row]!, z[row]!, place[row]!]).concat([0, 0, 0, 1]);
}

/** z of a world point in a camera. */
const aheadIn = (worldFromCamera: readonly number[], point: Vector3): number =>
  toCamera(worldFromCamera, sum(point, scaled(positionOf(worldFromCamera), -1)))[2];

const fromPixel = (lens: Lens, { x, y }: Pixel, ahead: number): Vector3 => [((x - lens.cx) / lens.fx) * ahead, ((y - lens.cy) / lens.fy) * ahead, ahead];

/** Intersection of a pixel's ray with the horizontal plane of a height; null if there is none within 20 m. */
export function levelAt({ camera, world_from_camera, up }: Omit<Seen, "depth">, pixel: Pixel, height_m: number): Vector3 | null {
  const [right, down] = slopes(camera, pixel);
  const ray = toWorld(world_from_camera, [right, down, 1]);
  const from = positionOf(world_from_camera);
  const ahead = (height_m - dot(up, from)) / dot(up, ray);
  return Number.isFinite(ahead) && ahead > 0 && ahead <= 20 ? sum(from, scaled(ray, ahead)) : null;
}

/** The ray of a pixel, in the world. */
export function rayOf({ camera, world_from_camera }: Pick<Seen, "camera" | "world_from_camera">, pixel: Pixel): { origin_m: [number, number, number]; direction: [number, number, number] } {
  const [right, down] = slopes(camera, pixel);
  return { origin_m: [...positionOf(world_from_camera)], direction: [...toWorld(world_from_camera, [right, down, 1])] };
}

/** Direction of a pixel's ray: x and y for z = 1. */
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

/** Height of the lowest visible surface, robust to a few outliers; null without depth. */
export function floorOf(seen: Measured): number | null {
  const { camera, up, depth } = seen;
  const lens = camera.depth ?? camera;
  const worldFromLens = worldFromLensOf(seen);
  const heights: number[] = [];
  for (let i = 0; i < depth.length; i += 7) {
    const ahead = depth[i]! * (camera.depth_scale_m ?? 0.001);
    if (ahead === 0) continue;
    const pixel = { x: i % lens.width, y: Math.floor(i / lens.width) };
    heights.push(dot(up, toWorldPoint(worldFromLens, fromPixel(lens, pixel, ahead))));
  }
  heights.sort((a, b) => a - b);
  return heights[Math.floor(heights.length * LOWEST_SHARE)] ?? null;
}

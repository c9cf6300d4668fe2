// Where the selected object stands: a grid on the level that it stands on, and a disc in its shadow's place.

import type { Lens } from "../capture/axes";
import { context2d } from "../dom";
import type { Vector3 } from "../sh";
import { type Pixel, project, scaled, sum, uprightAxes } from "./picking";

const CELL_M = 0.1;
const CELLS = 4;
const ROUND = 32;

export interface Standing {
  position: Vector3;
  up: Vector3;
  radius_m: number;
  height_m: number;
  yaw_deg: number;
}

/** Draw the guide of `standing` on a canvas of the picture's size; null clears and hides it. */
export function drawGuide(canvas: HTMLCanvasElement, camera: Lens, worldFromCamera: readonly number[], standing: Standing | null): void {
  const context = context2d(canvas);
  context.clearRect(0, 0, canvas.width, canvas.height);
  canvas.toggleAttribute("hidden", standing === null); // Chromium sometimes goes on showing what was cleared last
  if (standing === null) return;
  const { position, radius_m, height_m, yaw_deg } = standing;
  const [right, up, front] = uprightAxes(standing.up);
  const at = (x: number, z: number, y = 0): Pixel | null =>
    project(camera, worldFromCamera, sum(position, scaled(right, x), scaled(up, y), scaled(front, z)));
  const thin = Math.max(1, canvas.width / 640);
  drawGrid(context, at, thin);
  const ring = Array.from({ length: ROUND + 1 }, (_, i) => at(...around(radius_m, (360 * i) / ROUND)));
  trace(context, ring);
  context.fillStyle = "rgb(0 0 0 / 35%)";
  context.fill();
  stroke(context, "#ffb454", 2 * thin);
  trace(context, [at(0, 0), at(...around(1.35 * radius_m, yaw_deg))]); // its front
  stroke(context, "#ffb454", 3 * thin);
  trace(context, [at(0, 0), at(0, 0, height_m)]);
  stroke(context, "rgb(255 180 84 / 70%)", thin);
}

/** How far right and to the front, at an angle about up; 0 is the front of a model. */
function around(radius: number, angle_deg: number): [number, number] {
  const angle = (angle_deg * Math.PI) / 180;
  return [radius * Math.sin(angle), radius * Math.cos(angle)];
}

function drawGrid(context: CanvasRenderingContext2D, at: (x: number, z: number) => Pixel | null, thin: number): void {
  const end = CELLS * CELL_M;
  for (let i = -CELLS; i <= CELLS; i++) {
    const place = i * CELL_M;
    const color = i === 0 ? "rgb(255 255 255 / 65%)" : "rgb(255 255 255 / 28%)";
    for (const line of [[at(place, -end), at(place, end)], [at(-end, place), at(end, place)]]) {
      trace(context, line);
      stroke(context, color, thin);
    }
  }
}

/** A path through pixels; nothing of what is behind the camera. */
function trace(context: CanvasRenderingContext2D, pixels: readonly (Pixel | null)[]): void {
  context.beginPath();
  if (pixels.some((pixel) => pixel === null)) return;
  for (const pixel of pixels) context.lineTo(pixel!.x, pixel!.y);
}

function stroke(context: CanvasRenderingContext2D, color: string, width: number): void {
  context.strokeStyle = color;
  context.lineWidth = width;
  context.stroke();
}

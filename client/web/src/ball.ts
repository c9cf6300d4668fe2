// Spherical harmonics drawn on a ball, as the camera would see it.

import { evaluate, luminance, toWorld, type Vector3 } from "./sh";

export const BALL_PX = 200;
const RADIUS_PX = 78;
const CENTRE_PX = BALL_PX / 2;
const BASIS_0 = 0.28209479177387814;

const SRGB = Uint8ClampedArray.from({ length: 1025 }, (_, i) => {
  const linear = i / 1024;
  return 255 * (linear <= 0.0031308 ? 12.92 * linear : 1.055 * linear ** (1 / 2.4) - 0.055);
});

/** Exposure that maps the mean of the light to half of white. */
export function exposureOf(radiance: Float64Array): number {
  const mean = BASIS_0 * luminance(radiance[0]!, radiance[1]!, radiance[2]!);
  return mean > 1e-9 ? Math.LN2 / mean : 1;
}

/** Linear radiance to an sRGB byte: 1 - exp(-exposure x), so that a lamp does not wash out the room. */
export function toneMap(radiance: number, exposure: number): number {
  const shown = 1 - Math.exp(-Math.max(0, radiance) * exposure);
  return SRGB[Math.round(1024 * shown)]!;
}

/** RGBA of a ball whose points show `flat` in the direction of their normals; transparent outside. */
export function paintBall(
  flat: Float64Array,
  worldFromCamera: readonly number[],
  exposure: number,
): Uint8ClampedArray<ArrayBuffer> {
  const pixels = new Uint8ClampedArray(4 * BALL_PX * BALL_PX);
  const rgb = new Float64Array(3);
  for (let row = 0; row < BALL_PX; row++) {
    const y = (row + 0.5 - CENTRE_PX) / RADIUS_PX;
    for (let column = 0; column < BALL_PX; column++) {
      const x = (column + 0.5 - CENTRE_PX) / RADIUS_PX;
      const distance = Math.hypot(x, y);
      const coverage = Math.min(1, (1 - distance) * RADIUS_PX + 0.5);
      if (coverage <= 0) continue;
      const z = -Math.sqrt(Math.max(0, 1 - distance * distance)); // camera z points away, the normal to the viewer
      evaluate(flat, ...toWorld(worldFromCamera, [x, y, z]), rgb);
      const at = 4 * (row * BALL_PX + column);
      for (let channel = 0; channel < 3; channel++) pixels[at + channel] = toneMap(rgb[channel]!, exposure);
      pixels[at + 3] = 255 * coverage;
    }
  }
  return pixels;
}

/** Mark the light's direction: a dot on the ball (a ring if it is on the far side) and an arrow beside it. */
export function drawDirection(context: CanvasRenderingContext2D, direction: Vector3): void {
  const [x, y, z] = direction;
  const sideways = Math.hypot(x, y);
  drawDot(context, CENTRE_PX + x * RADIUS_PX, CENTRE_PX + y * RADIUS_PX, z > 0);
  if (sideways > 0.2) drawArrow(context, x / sideways, y / sideways);
}

function drawDot(context: CanvasRenderingContext2D, x: number, y: number, far: boolean): void {
  context.beginPath();
  context.arc(x, y, 6, 0, 2 * Math.PI);
  if (far) context.setLineDash([3, 3]);
  strokeTwice(context, 2);
  context.setLineDash([]);
  if (far) return;
  context.fillStyle = "#ffb454";
  context.fill();
}

function drawArrow(context: CanvasRenderingContext2D, x: number, y: number): void {
  const tip = RADIUS_PX + 4;
  const at = (along: number, across: number): [number, number] => [
    CENTRE_PX + x * along - y * across,
    CENTRE_PX + y * along + x * across,
  ];
  context.beginPath();
  context.moveTo(...at(RADIUS_PX + 20, 0));
  context.lineTo(...at(tip, 0));
  context.moveTo(...at(tip + 7, -5));
  context.lineTo(...at(tip, 0));
  context.lineTo(...at(tip + 7, 5));
  strokeTwice(context, 2.5);
}

/** Bright on dark, so that the mark is visible on any background. */
function strokeTwice(context: CanvasRenderingContext2D, width: number): void {
  context.lineCap = context.lineJoin = "round";
  context.strokeStyle = "#101318";
  context.lineWidth = width + 2.5;
  context.stroke();
  context.strokeStyle = "#ffb454";
  context.lineWidth = width;
  context.stroke();
}

/** Where the ball will be. */
export function drawOutline(context: CanvasRenderingContext2D): void {
  context.beginPath();
  context.arc(CENTRE_PX, CENTRE_PX, RADIUS_PX - 1, 0, 2 * Math.PI);
  context.setLineDash([5, 5]);
  context.strokeStyle = "#4a5462";
  context.lineWidth = 2;
  context.stroke();
  context.setLineDash([]);
}

/** Grey diagonal lines over the ball: the light is not valid. */
export function drawHatch(context: CanvasRenderingContext2D): void {
  context.save();
  context.beginPath();
  context.arc(CENTRE_PX, CENTRE_PX, RADIUS_PX, 0, 2 * Math.PI);
  context.clip();
  context.fillStyle = "rgb(70 76 86 / 55%)";
  context.fillRect(0, 0, BALL_PX, BALL_PX);
  context.strokeStyle = "rgb(190 197 208 / 60%)";
  context.lineWidth = 2;
  context.beginPath();
  for (let offset = -BALL_PX; offset < BALL_PX; offset += 12) {
    context.moveTo(offset, BALL_PX);
    context.lineTo(offset + BALL_PX, 0);
  }
  context.stroke();
  context.restore();
}

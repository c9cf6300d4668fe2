// The estimated light: as it arrives, as a matt white ball would look in it, and in numbers.

import { BALL_PX, drawDirection, drawHatch, drawOutline, exposureOf, paintBall } from "./ball";
import { byId, context2d, make, setText } from "./dom";
import { describeCertainty, unknownPlaces } from "./lighting";
import type { Light } from "./protocol";
import { evaluate, flatten, toCamera, toMatt } from "./sh";
import { describeDirection, number } from "./words";

const balls = [byId<HTMLCanvasElement>("ball-arriving"), byId<HTMLCanvasElement>("ball-matt")] as const;
const summary = byId("light-validity");
const swatch = byId("light-swatch");
const direction = byId("light-direction");
const intensity = byId("light-intensity");
const condition = byId("light-condition");
const unknown = byId("light-unknown");

for (const ball of balls) {
  ball.width = ball.height = BALL_PX;
  drawOutline(context2d(ball));
}

/** Draw `light` as seen by the camera of `worldFromCamera` (row-major 4x4). */
export function showLight(light: Light, worldFromCamera: readonly number[]): void {
  const arriving = flatten(light.sh);
  const exposure = exposureOf(arriving);
  const towards = toCamera(worldFromCamera, light.dominant_direction);
  const hasDirection = Math.hypot(...towards) > 1e-6;
  [arriving, toMatt(arriving)].forEach((flat, i) => {
    const context = context2d(balls[i]!);
    context.putImageData(new ImageData(paintBall(flat, worldFromCamera, exposure), BALL_PX), 0, 0);
    if (!light.valid) drawHatch(context);
    if (hasDirection) drawDirection(context, towards);
  });
  showNumbers(light, describeDirection(towards));
  showColor(arriving, light.dominant_direction);
}

function showNumbers(light: Light, where: string): void {
  setText(summary, describeCertainty(light));
  showUnknown(unknownPlaces(light));
  summary.dataset["valid"] = String(light.valid);
  setText(direction, where);
  setText(intensity, number(light.dominant_intensity));
  setText(condition, light.condition === null ? "∞" : number(light.condition));
  const shown = `Dominant light ${where}, intensity ${number(light.dominant_intensity)}${light.valid ? "" : ", not reliable"}`;
  balls[0].setAttribute("aria-label", `Light arriving from every direction. ${shown}`);
  balls[1].setAttribute("aria-label", `A matt white ball in this light. ${shown}`);
}

let shownUnknown = "";

/** What is not known of the light at places; replaced only where it changes, for screen readers. */
function showUnknown(lines: readonly string[]): void {
  const key = lines.join("\n");
  if (key === shownUnknown) return;
  shownUnknown = key;
  unknown.replaceChildren(...lines.map((line) => make("li", "", line)));
}

const rgb = new Float64Array(3);

/** The colour of the light in its dominant direction, at full brightness. */
function showColor(flat: Float64Array, [x, y, z]: readonly [number, number, number]): void {
  evaluate(flat, x, y, z, rgb);
  const brightest = Math.max(...rgb, 1e-9);
  const srgb = [...rgb].map((value) => Math.round(255 * Math.max(0, value / brightest) ** (1 / 2.2)));
  swatch.style.backgroundColor = `rgb(${srgb.join(" ")})`;
}

// The estimated light: as it arrives, as a matt white ball would look in it, and in numbers.

import { BALL_PX, drawDirection, drawHatch, drawOutline, exposureOf, paintBall } from "./ball";
import { byId, context2d, make, setText } from "./dom";
import { describeCertainty, placeShown, unknownPlaces } from "./lighting";
import type { ArrivingLight, Light } from "./protocol";
import { evaluate, flatten, toCamera, toMatt } from "./sh";
import { whence } from "./whence";
import { describeDirection, number } from "./words";

const balls = [byId<HTMLCanvasElement>("ball-arriving"), byId<HTMLCanvasElement>("ball-matt")] as const;
const summary = byId("light-validity");
const swatch = byId("light-swatch");
const direction = byId("light-direction");
const intensity = byId("light-intensity");
const condition = byId("light-condition");
const unknown = byId("light-unknown");
const where = byId("light-where");
const words = byId("light-words");

for (const ball of balls) {
  ball.width = ball.height = BALL_PX;
  drawOutline(context2d(ball));
}

/** Draw `light` as seen by the camera of `worldFromCamera` (row-major 4x4). */
export function showLight(light: Light, worldFromCamera: readonly number[]): void {
  const place = placeShown(light);
  const arriving = flatten(place.light.sh);
  const exposure = exposureOf(arriving);
  const towards = toCamera(worldFromCamera, place.light.dominant_direction);
  const hasDirection = Math.hypot(...towards) > 1e-6;
  [arriving, toMatt(arriving)].forEach((flat, i) => {
    const context = context2d(balls[i]!);
    context.putImageData(new ImageData(paintBall(flat, worldFromCamera, exposure), BALL_PX), 0, 0);
    if (!place.light.valid) drawHatch(context);
    if (hasDirection) drawDirection(context, towards);
  });
  setText(where, place.name);
  const from = whence([...place.light.dominant_direction], [...(light.up ?? upOf(worldFromCamera))], worldFromCamera)?.text;
  setText(words, from === undefined ? "It comes evenly from all sides." : `Most of it comes ${from}.`);
  words.title = summary.title = `${describeDirection(towards)}; intensity ${number(place.light.dominant_intensity)}`;
  showUnknown(unknownPlaces(light));
  showNumbers(place.light, light.condition, describeDirection(towards));
  showColor(arriving, place.light.dominant_direction);
}

/** Where no up direction is known: the camera's own. */
const upOf = (pose: readonly number[]): [number, number, number] => [-pose[1]!, -pose[5]!, -pose[9]!];

function showNumbers(light: Light | ArrivingLight, conditionNumber: number | null, from: string): void {
  setText(summary, describeCertainty(light));
  summary.dataset["valid"] = String(light.valid);
  setText(direction, from);
  setText(intensity, number(light.dominant_intensity));
  setText(condition, conditionNumber === null ? "∞" : number(conditionNumber));
  const shown = `Dominant light ${from}, intensity ${number(light.dominant_intensity)}${light.valid ? "" : ", not reliable"}`;
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

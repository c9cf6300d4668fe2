// The light at each place: a matt white ball as the camera would see it, and all directions as a panorama, with words.

import { BALL_PX, drawDirection, drawHatch, exposureOf, paintBall, toneMap } from "../ball";
import { byId, context2d, make, setText } from "../dom";
import { evaluate, toCamera, toMatt, type Vector3 } from "../sh";
import { number } from "../words";
import type { LightRow, RunData } from "./data";
import { certainty, horizontal, placeName, whence } from "./words";

const WIDTH = 144;
const HEIGHT = 72;

interface Shown {
  part: HTMLElement;
  where: HTMLElement;
  words: HTMLElement;
  sure: HTMLElement;
  ball: HTMLCanvasElement;
  panorama: HTMLCanvasElement;
}

export class Lights {
  private readonly shown = new Map<number, Shown>();
  private readonly parent = byId("places");

  /** `firstPose`: the middle column of panoramas is along its view, as in those that `--panorama-out` writes. */
  constructor(
    private readonly data: RunData,
    private readonly firstPose: readonly number[],
  ) {
    const { places } = data.tables;
    const order = ["object", "place", "view", "beyond"];
    const sorted = places.map((_, i) => i).sort((a, b) => order.indexOf(places[a]![0]) - order.indexOf(places[b]![0]));
    for (const place of sorted) this.add(place);
  }

  /** Show the lights of a frame, as seen by the camera of `pose` (3x4). */
  show(lights: readonly LightRow[], pose: readonly number[]): void {
    for (const [place, shown] of this.shown) {
      const light = lights.find((each) => each.place === place);
      shown.part.hidden = light === undefined;
      if (light) this.showOne(shown, light, pose);
    }
  }

  private add(place: number): void {
    const kind = this.data.tables.places[place]!;
    const name = placeName(kind, this.data.objects);
    const part = make("article", "place");
    const title = make("h3", "", name);
    const where = make("span", "place-where");
    title.append(" ", where);
    const [words, sure] = [make("p", "words"), make("p", "sure")];
    const [ball, panorama] = [make("canvas", "ball"), make("canvas", "panorama")];
    ball.width = ball.height = BALL_PX;
    [panorama.width, panorama.height] = [WIDTH, HEIGHT];
    for (const canvas of [ball, panorama]) canvas.setAttribute("role", "img");
    const pictures = make("div", "pictures");
    pictures.append(ball, panorama);
    part.append(title, words, sure, pictures);
    this.parent.append(part);
    this.shown.set(place, { part, where, words, sure, ball, panorama });
  }

  private showOne(shown: Shown, light: LightRow, pose: readonly number[]): void {
    const { up } = this.data;
    const found = whence(light.towards, up, pose);
    const text = found === null ? "The same from everywhere" : `Mostly ${found.text}`;
    setText(shown.where, light.at === null ? "" : `at ${light.at.map((value) => value.toFixed(2)).join(", ")} m`);
    const lamps = light.lamps ? `; lamps in the room: ${light.lamps}` : "";
    const angles = found === null ? "" : ` (${height(found.elevation_deg)}, ${side(found.azimuth_deg)})`;
    setText(shown.words, `${text}${angles}, strength ${number(light.intensity)}${lamps}`);
    setText(shown.sure, certainty(light));
    shown.sure.dataset["valid"] = String(light.valid && light.seen !== 0);
    const flat = Float64Array.from(light.sh);
    const exposure = exposureOf(flat);
    paintMatt(shown.ball, flat, exposure, light, pose);
    shown.ball.setAttribute("aria-label", `A matt white ball in this light. ${text}`);
    paintPanorama(shown.panorama, smoothed(flat), exposure, up, this.firstPose, light.towards);
    shown.panorama.setAttribute("aria-label", `The light from all directions, up at the top, the first view in the middle. ${text}`);
  }
}

const height = (elevation: number): string => `${Math.round(Math.abs(elevation))}° ${elevation < 0 ? "down" : "up"}`;

function side(azimuth: number): string {
  const rounded = Math.round(Math.abs(azimuth));
  return rounded === 0 ? "straight ahead" : `${rounded}° ${azimuth > 0 ? "right" : "left"}`;
}

function paintMatt(canvas: HTMLCanvasElement, flat: Float64Array, exposure: number, light: LightRow, pose: readonly number[]): void {
  const context = context2d(canvas);
  context.putImageData(new ImageData(paintBall(toMatt(flat), pose, exposure), BALL_PX), 0, 0);
  if (!light.valid) drawHatch(context);
  const towards = toCamera(pose, light.towards);
  if (Math.hypot(...towards) > 1e-6) drawDirection(context, towards);
}

/** Lanczos' factors of the bands: without them the few bands ring, and what is dark beside a lamp looks black. */
const SMOOTHING = [1, 0.9, 0.637, 0.3];

const smoothed = (flat: Float64Array): Float64Array => flat.map((value, i) => value * SMOOTHING[Math.floor(Math.sqrt(Math.floor(i / 3)))]!);

const rgb = new Float64Array(3);

function paintPanorama(canvas: HTMLCanvasElement, flat: Float64Array, exposure: number, up: Vector3, pose: readonly number[], towards: Vector3): void {
  const context = context2d(canvas);
  const [ahead, right] = horizontal(up, pose);
  const pixels = new ImageData(WIDTH, HEIGHT);
  for (let row = 0, at = 0; row < HEIGHT; row++) {
    const elevation = Math.PI * (0.5 - (row + 0.5) / HEIGHT);
    const [high, flatwards] = [Math.sin(elevation), Math.cos(elevation)];
    for (let column = 0; column < WIDTH; column++, at += 4) {
      const azimuth = 2 * Math.PI * ((column + 0.5) / WIDTH - 0.5);
      const [a, r] = [flatwards * Math.cos(azimuth), flatwards * Math.sin(azimuth)];
      evaluate(flat, a * ahead[0] + r * right[0] + high * up[0], a * ahead[1] + r * right[1] + high * up[1], a * ahead[2] + r * right[2] + high * up[2], rgb);
      for (let channel = 0; channel < 3; channel++) pixels.data[at + channel] = toneMap(rgb[channel]!, exposure);
      pixels.data[at + 3] = 255;
    }
  }
  context.putImageData(pixels, 0, 0);
  mark(context, whence(towards, up, pose));
}

function mark(context: CanvasRenderingContext2D, found: ReturnType<typeof whence>): void {
  if (found === null) return;
  const [x, y] = [WIDTH * (0.5 + found.azimuth_deg / 360), HEIGHT * (0.5 - found.elevation_deg / 180)];
  for (const [color, width] of [["#101318", 3.5], ["#ffb454", 1.6]] as const) {
    context.beginPath();
    context.arc(x, y, 3.5, 0, 2 * Math.PI);
    context.strokeStyle = color;
    context.lineWidth = width;
    context.stroke();
  }
}

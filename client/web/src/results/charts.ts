// Time of each stage over all frames as stacked bars, and over which frames each effect ran.

import { byId, context2d, make, setText } from "../dom";
import { milliseconds, plain } from "../words";
import type { DrawnRow, RunData } from "./data";

/** Bars of more medians than this are cut: frames that compile kernels take a hundred times as long. */
const CUT = 3;
const HEADROOM = 1.15;
/** Pixels: left and below, for numbers. */
const [LEFT, BELOW, ABOVE] = [44, 18, 6];
const TICKS = 4;

export class Charts {
  private readonly bars = byId<HTMLCanvasElement>("bars");
  private readonly stages: string[];
  private readonly stacks: (Float64Array | null)[];
  private readonly top: number;
  private readonly cells = new Map<number, { now: HTMLElement }>();
  private readonly strips: { canvas: HTMLCanvasElement; runs: Uint8Array }[] = [];
  private index = 0;
  private chart: ImageBitmap | HTMLCanvasElement | null = null;

  /** `onPick`: called with the frame that a person points at. */
  constructor(
    private readonly data: RunData,
    onPick: (index: number) => void,
  ) {
    this.stages = data.tables.stages;
    this.stacks = data.frames.map(({ drawn }) => (drawn === null ? null : stackOf(drawn)));
    const sums = this.stacks.flatMap((stack) => (stack === null ? [] : [sumOf(stack)]));
    const tallest = sums.reduce((a, b) => Math.max(a, b), 0);
    this.top = HEADROOM * topOf(sums);
    this.noteCut(tallest);
    this.addRows();
    this.addStrips();
    new ResizeObserver(() => this.layout()).observe(byId("times"));
    const pick = (event: PointerEvent): void => {
      const { left, width } = this.bars.getBoundingClientRect();
      const share = (event.clientX - left - LEFT) / Math.max(1, width - LEFT);
      onPick(Math.max(0, Math.min(data.frames.length - 1, Math.floor(share * data.frames.length))));
    };
    this.bars.addEventListener("pointerdown", (event) => {
      this.bars.setPointerCapture(event.pointerId);
      pick(event);
    });
    this.bars.addEventListener("pointermove", (event) => {
      if (this.bars.hasPointerCapture(event.pointerId)) pick(event);
    });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.layout());
  }

  /** Show a frame's numbers, and where it is. */
  show(index: number): void {
    this.index = index;
    const stack = this.stacks[index];
    this.stages.forEach((_, i) => setText(this.cells.get(i)!.now, stack ? milliseconds(stack[i]!) : "–"));
    const { drawn } = this.data.frames[index]!;
    setText(this.cells.get(-1)!.now, drawn === null ? "–" : milliseconds(drawn.total));
    const label = drawn === null ? "no times" : `${milliseconds(drawn.total)} ms in all`;
    this.bars.setAttribute("aria-label", `Milliseconds of each stage over ${this.data.frames.length} frames, stacked; this frame: ${label}`);
    this.place();
  }

  private noteCut(tallest: number): void {
    const cut = this.stacks.flatMap((stack, i) => (stack !== null && sumOf(stack) > this.top ? [i] : []));
    if (cut.length === 0) return;
    const which = cut.length === 1 ? `Frame ${this.data.frames[cut[0]!]!.frame} goes` : `${cut.length} frames go`;
    const why = cut[0]! < 3 ? "; the first frames prepare kernels and memory" : "";
    setText(byId("bars-note"), `${which} beyond the chart, up to ${milliseconds(tallest)} ms${why}.`);
  }

  private addRows(): void {
    const body = byId("stages");
    const add = (i: number, name: string, median: number): void => {
      const row = make("tr", i < 0 ? "total" : `stage-${i}`);
      const head = make("th", "", name);
      head.setAttribute("scope", "row");
      if (i >= 0) head.prepend(make("span", "swatch"));
      const [now, usual] = [make("td", "number", "–"), make("td", "number", milliseconds(median))];
      row.append(head, now, usual);
      body.append(row);
      this.cells.set(i, { now });
    };
    this.stages.forEach((name, i) => add(i, plain(name), medianOf(this.stacks.map((stack) => stack?.[i] ?? null))));
    add(-1, "Total (wall)", medianOf(this.data.frames.map(({ drawn }) => drawn?.total ?? null)));
  }

  /** One line for each effect that ran or could have. */
  private addStrips(): void {
    const { frames, tables } = this.data;
    const names = new Map<string, Uint8Array>();
    frames.forEach(({ drawn }, frame) => {
      for (const effect of drawn?.run ?? []) mark(names, tables.effects[effect]!, frames.length, frame, 2);
      for (const left of drawn?.out ?? []) mark(names, tables.left_out[left]![0], frames.length, frame, 1);
    });
    for (const [name, runs] of names) {
      const item = make("li");
      const canvas = make("canvas");
      const count = runs.filter((each) => each === 2).length;
      canvas.setAttribute("role", "img");
      canvas.setAttribute("aria-label", `ran in ${count} of ${frames.length} frames`);
      item.append(make("span", "", plain(name)), canvas);
      item.title = `${plain(name)}: ran in ${count} of ${frames.length} frames`;
      byId("strips").append(item);
      this.strips.push({ canvas, runs });
    }
  }

  private layout(): void {
    this.drawBars();
    const color = style("--accent");
    const line = style("--line");
    for (const { canvas, runs } of this.strips) {
      const [context, width, height] = fitted(canvas);
      context.fillStyle = line;
      context.fillRect(0, 0, width, height);
      context.fillStyle = color;
      let from = -1;
      for (let i = 0; i <= runs.length; i++) {
        const ran = runs[i] === 2;
        if (ran && from < 0) from = i;
        if (ran || from < 0) continue;
        context.fillRect((from / runs.length) * width, 0, Math.max(1, ((i - from) / runs.length) * width), height);
        from = -1;
      }
    }
    this.place();
  }

  private drawBars(): void {
    const canvas = document.createElement("canvas");
    const { clientWidth, clientHeight } = this.bars;
    if (clientWidth === 0) return;
    const ratio = devicePixelRatio;
    [this.bars.width, this.bars.height] = [Math.round(clientWidth * ratio), Math.round(clientHeight * ratio)];
    [canvas.width, canvas.height] = [this.bars.width, this.bars.height];
    const context = context2d(canvas);
    context.scale(ratio, ratio);
    this.drawAxis(context, clientWidth, clientHeight);
    const [width, height] = [clientWidth - LEFT, clientHeight - BELOW - ABOVE];
    const colors = this.stages.map((_, i) => stageColor(i));
    const step = width / this.stacks.length;
    const columns = Math.max(1, Math.min(this.stacks.length, Math.floor(width)));
    for (let column = 0; column < columns; column++) {
      const stack = tallestOf(this.stacks, Math.floor((column / columns) * this.stacks.length), Math.floor(((column + 1) / columns) * this.stacks.length));
      if (stack === null) continue;
      const each = width / columns;
      let y = height + ABOVE;
      for (let i = 0; i < stack.length; i++) {
        const tall = Math.min(y - ABOVE, (stack[i]! / this.top) * height);
        context.fillStyle = colors[i]!;
        context.fillRect(LEFT + column * each, y - tall, Math.max(0.7, each - (step > 4 ? 1 : 0)), tall);
        y -= tall;
      }
    }
    this.chart = canvas;
  }

  private drawAxis(context: CanvasRenderingContext2D, width: number, height: number): void {
    const tick = niceStep(this.top / TICKS);
    context.font = `11px ${getComputedStyle(document.body).fontFamily}`;
    context.fillStyle = style("--quiet");
    context.strokeStyle = style("--line");
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (let value = 0; value <= this.top; value += tick) {
      const y = ABOVE + (height - BELOW - ABOVE) * (1 - value / this.top);
      context.beginPath();
      context.moveTo(LEFT, y);
      context.lineTo(width, y);
      context.stroke();
      context.fillText(String(Number(value.toPrecision(6))), LEFT - 6, y);
    }
    context.textBaseline = "bottom";
    context.textAlign = "left";
    context.fillText(`frame ${this.data.frames[0]!.frame}`, LEFT, height);
    context.textAlign = "right";
    context.fillText(String(this.data.frames.at(-1)!.frame), width, height);
  }

  /** The chart with a line at the frame that is shown. */
  private place(): void {
    if (this.chart === null) return;
    const context = context2d(this.bars);
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, this.bars.width, this.bars.height);
    context.drawImage(this.chart, 0, 0);
    const ratio = devicePixelRatio;
    context.scale(ratio, ratio);
    const step = (this.bars.clientWidth - LEFT) / this.stacks.length;
    context.strokeStyle = style("--text");
    context.lineWidth = 1.5;
    context.strokeRect(LEFT + this.index * step - 0.5, 1, Math.max(1, step), this.bars.clientHeight - BELOW);
  }
}

/** The tallest bar that is not cut. */
export function topOf(sums: readonly number[]): number {
  const most = CUT * medianOf(sums);
  return sums.filter((sum) => sum <= most).reduce((a, b) => Math.max(a, b), 0) || 1;
}

/** Milliseconds by stage, and what is left of the wall time. */
function stackOf({ ms }: DrawnRow): Float64Array {
  return Float64Array.from(ms);
}

const sumOf = (stack: Float64Array): number => stack.reduce((a, b) => a + b, 0);

function tallestOf(stacks: readonly (Float64Array | null)[], from: number, to: number): Float64Array | null {
  let [found, most]: [Float64Array | null, number] = [null, -1];
  for (const stack of stacks.slice(from, Math.max(from + 1, to))) {
    const sum = stack === null ? -1 : sumOf(stack);
    if (sum > most) [found, most] = [stack!, sum];
  }
  return found;
}

function medianOf(values: readonly (number | null)[]): number {
  const sorted = values.filter((value) => value !== null).sort((a, b) => a - b);
  return sorted[Math.floor(sorted.length / 2)] ?? 0;
}

function mark(names: Map<string, Uint8Array>, name: string, count: number, frame: number, value: number): void {
  if (!names.has(name)) names.set(name, new Uint8Array(count));
  names.get(name)![frame] = value;
}

/** 1, 2 or 5 times a power of ten, at least `value`. */
export function niceStep(value: number): number {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].map((each) => each * power).find((each) => each >= value * 0.999)!;
}

function fitted(canvas: HTMLCanvasElement): [CanvasRenderingContext2D, number, number] {
  const [width, height] = [Math.max(1, canvas.clientWidth), Math.max(1, canvas.clientHeight)];
  [canvas.width, canvas.height] = [Math.round(width * devicePixelRatio), Math.round(height * devicePixelRatio)];
  const context = context2d(canvas);
  context.scale(devicePixelRatio, devicePixelRatio);
  return [context, width, height];
}

const style = (name: string, element: Element = document.documentElement): string => getComputedStyle(element).getPropertyValue(name).trim();

function stageColor(i: number): string {
  const element = document.querySelector(`#stages .stage-${i}`);
  return element === null ? "#888" : style("--stage", element);
}

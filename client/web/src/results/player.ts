// Which frame is shown: by time while it plays, by the scrubber, the buttons and the keys.

import { byId, make } from "../dom";
import { flip, show, showNone } from "./compare";
import { frameAt, lastDuration, showTimes } from "./clock";
import { cameraFile, compositeFile, type FrameRow, type RunData } from "./data";
import { type Picture, Pictures } from "./pictures";
import { clock } from "./words";

const scrub = byId<HTMLInputElement>("scrub");
const play = byId<HTMLButtonElement>("play");
const where = byId("where");
const said = byId("picture-said");
const speed = byId<HTMLSelectElement>("speed");

/** Milliseconds that the clock waits for a picture before it goes on without. */
const PATIENCE = 2000;
/** Frames that page keys and shift with an arrow key step. */
const FAR = 10;

export class Player {
  private readonly frames: readonly FrameRow[];
  private readonly times: readonly number[];
  private readonly end: number;
  private readonly pictures: Pictures;
  private index = 0;
  private isPlaying = false;
  /** Time of the run that is shown, seconds, and when the page was asked for it, milliseconds. */
  private at = 0;
  private asked = 0;
  private waitingSince = 0;

  /** `onFrame`: called for each frame that is shown, and where playing stops. */
  constructor(
    data: RunData,
    private readonly onFrame: (index: number, isPlaying: boolean) => void,
  ) {
    this.frames = data.frames;
    this.times = showTimes(data.frames.map(({ time }) => time), data.fps);
    this.end = this.times.at(-1)! + lastDuration(this.times, data.fps);
    this.pictures = new Pictures(data.camera.width, data.camera.height);
    scrub.max = String(this.frames.length - 1);
    scrub.addEventListener("input", () => this.seek(Number(scrub.value)));
    play.addEventListener("click", () => this.toggle());
    byId("previous").addEventListener("click", () => this.seek(this.index - 1));
    byId("next").addEventListener("click", () => this.seek(this.index + 1));
    document.addEventListener("keydown", (event) => this.onKey(event));
  }

  /** Show a frame, and stop. */
  seek(index: number): void {
    this.setPlaying(false);
    this.go(Math.max(0, Math.min(this.frames.length - 1, index)));
  }

  toggle(): void {
    if (this.frames.length < 2) return;
    if (!this.isPlaying && this.index === this.frames.length - 1) this.go(0);
    this.setPlaying(!this.isPlaying);
  }

  private setPlaying(isPlaying: boolean): void {
    if (isPlaying === this.isPlaying) return;
    this.isPlaying = isPlaying;
    play.classList.toggle("playing", isPlaying);
    play.setAttribute("aria-label", isPlaying ? "Pause" : "Play");
    if (!isPlaying) return this.onFrame(this.index, false);
    this.at = this.times[this.index]!;
    this.asked = performance.now();
    requestAnimationFrame(this.tick);
  }

  private readonly tick = (now: number): void => {
    if (!this.isPlaying) return;
    const passed = (Math.max(0, now - this.asked) / 1000) * Number(speed.value);
    this.asked = now;
    if (this.isReady(this.index, now)) this.at += passed;
    if (this.at >= this.end) this.at = 0; // and again
    const due = frameAt(this.times, this.at);
    if (due !== this.index) this.go(due);
    requestAnimationFrame(this.tick);
  };

  /** Whether a frame's pictures are there, or were waited for long enough. */
  private isReady(index: number, now: number): boolean {
    const isThere = this.filesOf(index).every((file) => this.pictures.now(file) !== null);
    if (isThere || now - this.waitingSince > PATIENCE) {
      this.waitingSince = now;
      return true;
    }
    return false;
  }

  private go(index: number): void {
    this.index = index;
    scrub.value = String(index);
    const frame = this.frames[index]!;
    const text = `Frame ${frame.frame}, ${index + 1} of ${this.frames.length}`;
    scrub.setAttribute("aria-valuetext", text);
    const time = make("span", "", `${clock(this.times[index]!)} / ${clock(this.end)}`);
    where.replaceChildren(make("strong", "", `Frame ${frame.frame}`), " ", make("span", "", `${index + 1} of ${this.frames.length}`), " ", time);
    this.onFrame(index, this.isPlaying);
    void this.draw(index);
    for (let next = 1; next <= this.pictures.ahead; next++) {
      for (const file of this.filesOf((index + next) % this.frames.length)) void this.pictures.load(file);
    }
  }

  private filesOf(index: number): string[] {
    const frame = this.frames[index]!;
    if (frame.drawn === null) return [];
    return frame.drawn.picture === 2 ? [compositeFile(frame), cameraFile(frame)] : [compositeFile(frame)];
  }

  private async draw(index: number): Promise<void> {
    const files = this.filesOf(index);
    const pictures = files.map((file) => this.pictures.now(file));
    const [composite, own] = pictures.every((each) => each !== null) ? pictures : await Promise.all(files.map((file) => this.pictures.load(file)));
    if (index !== this.index) return;
    this.say(index, composite, own);
    if (composite === undefined || composite === null || composite === "missing") return showNone();
    show(composite, own instanceof HTMLImageElement ? own : null);
  }

  private say(index: number, composite: Picture | null | undefined, own: Picture | null | undefined): void {
    const { drawn } = this.frames[index]!;
    const [first, second] = this.filesOf(index);
    let text = "";
    if (drawn === null) text = "This run kept the light alone, without pictures";
    else if (composite === "missing") text = `${first} is missing: keep this page beside its folders`;
    else if (own === "missing") text = `${second} is missing: keep this page beside its folders`;
    else if (drawn.tracking === "lost") text = "The camera is lost in this frame";
    if (said.textContent !== text) said.replaceChildren(...(text === "" ? [] : [make("span", "", text)]));
  }

  private onKey(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const target = event.target as HTMLElement;
    const step = event.shiftKey ? FAR : 1;
    if (event.key === " " && !["BUTTON", "SELECT"].includes(target.tagName)) this.toggle();
    else if ((event.key === "b" || event.key === "B") && target.tagName !== "SELECT") flip();
    else if (["INPUT", "SELECT"].includes(target.tagName) || target.id === "view") return; // these have arrow keys of their own
    else if (event.key === "ArrowLeft") this.seek(this.index - step);
    else if (event.key === "ArrowRight") this.seek(this.index + step);
    else if (event.key === "Home") this.seek(0);
    else if (event.key === "End") this.seek(this.frames.length - 1);
    else return;
    event.preventDefault();
  }
}

// Plays a recording as a camera: its frames unchanged, in real time, from a local file.

import type { CameraModel, PlaceObject, Wishes } from "../protocol";
import { pictureOf } from "./recorded_picture";
import { framesOf, type RecordedFrame } from "./recording";
import { now_ms, type Packed, reasonOf, type Sink, type Source, SourceError } from "./source";

/** Polling interval for frames that are due or requested. */
const LOOK_MS = 4;
/** Frame interval of a recording with one frame. */
const STILL_STEP_S = 1 / 15;
/** Largest delay that playback catches up with after the page was suspended. */
const LATEST_MS = 200;
/** Longer pauses in a recording are shortened to this. */
const LONGEST_STEP_S = 5;

/** The newest image, for display before the server has answered. Closed when the next one arrives. */
export interface Shown {
  bitmap: ImageBitmap;
  camera: CameraModel;
  /** Row-major. */
  world_from_camera: number[] | null;
}

/** Play `file` in a loop, or once and hold the last frame. Throws SourceError. */
export async function startRecorded(file: File, loops: boolean, sink: Sink, onShown: ((shown: Shown) => void) | null = null): Promise<Source> {
  const first = (await framesOf(file, () => undefined).next()).value ?? null;
  if (first === null) throw new SourceError(`${file.name} holds no frames: choose a file that probeless stream SOURCE --record FILE has made.`);
  return new RecordedSource(file, first, loops, sink, onShown);
}

export class RecordedSource implements Source {
  readonly wishes: Wishes;
  readonly objects: readonly PlaceObject[];
  private hasEnded = false;
  private shown: Shown | null = null;
  private isShowing = false;
  /** Time of the frame that is due now, in seconds since the beginning. */
  private time_s = 0;

  constructor(
    private readonly file: File,
    first: RecordedFrame,
    private readonly loops: boolean,
    private readonly sink: Sink,
    private readonly onShown: ((shown: Shown) => void) | null,
  ) {
    this.wishes = wishesOf(first);
    this.objects = first.objects;
    void this.play(first).catch((error: unknown) => this.end(error instanceof SourceError ? error.message : `The recording cannot be played: ${reasonOf(error)}`));
  }

  stop(): Promise<void> {
    this.hasEnded = true;
    this.shown?.bitmap.close();
    this.shown = null;
    return Promise.resolve();
  }

  private end(reason: string): void {
    if (this.hasEnded) return;
    void this.stop();
    this.sink.ended(reason);
  }

  private async play(first: RecordedFrame): Promise<void> {
    await this.announce(first);
    let due_ms = performance.now();
    let now: RecordedFrame | null = null;
    let isSent = true;
    for await (const { next, step_s } of this.paced()) {
      due_ms = Math.max(due_ms + 1000 * step_s, performance.now() - LATEST_MS);
      do {
        if (now !== null && !isSent) isSent = this.send(now);
        await pause(LOOK_MS); // also if late, so that the page stays responsive
      } while (!this.hasEnded && performance.now() < due_ms);
      this.time_s += step_s;
      if (this.hasEnded) return;
      now = next;
      void this.show(next);
      isSent = this.send(next);
    }
  }

  /** The first frame defines the session's camera and is not sent. */
  private async announce(first: RecordedFrame): Promise<void> {
    while (!this.sink.wantsFrame()) {
      if (this.hasEnded) return;
      await pause(LOOK_MS);
    }
    this.send(first);
    while (!this.hasEnded && !this.sink.wantsFrame()) await pause(LOOK_MS);
  }

  /** Endless sequence of frames, each with the time since the previous one. */
  private async *paced(): AsyncGenerator<{ next: RecordedFrame; step_s: number }> {
    let last: RecordedFrame | null = null;
    let usual_s = STILL_STEP_S;
    do {
      let before: RecordedFrame | null = null;
      for await (const next of framesOf(this.file, (text) => this.sayOnce(text))) {
        const step_s: number = before === null ? (last === null ? 0 : usual_s) : next.frame.timestamp_s - before.frame.timestamp_s;
        if (before !== null && step_s > 0) usual_s = Math.min(step_s, LONGEST_STEP_S);
        yield { next, step_s: Math.min(Math.max(step_s, 0), LONGEST_STEP_S) };
        before = last = next;
      }
    } while (this.loops && last !== null);
    this.sink.say("The recording has come to its end: its last picture stands.");
    while (last !== null) yield { next: last, step_s: usual_s };
  }

  private hasSaid = false;

  private sayOnce(text: string): void {
    if (!this.hasSaid) this.sink.say(text);
    this.hasSaid = true;
  }

  /** Whether the frame is sent; the server may be busy. */
  private send({ camera, frame }: RecordedFrame): boolean {
    if (this.hasEnded || !this.sink.wantsFrame()) return false;
    const { world_from_camera, color = null, depth = null, exposure = null } = frame;
    const packed: Packed["packed"] = { color, depth, exposure };
    this.sink.take({ timestamp_s: this.time_s, captured_ms: now_ms(), camera, world_from_camera, packed });
    return true;
  }

  /** Decode the image for display; skipped while another one is being decoded. */
  private async show({ camera, frame }: RecordedFrame): Promise<void> {
    if (this.onShown === null || this.isShowing || !frame.color) return;
    this.isShowing = true;
    try {
      const shown = { bitmap: await pictureOf(frame.color), camera, world_from_camera: frame.world_from_camera };
      if (this.hasEnded) return shown.bitmap.close();
      this.shown?.bitmap.close();
      this.shown = shown;
      this.onShown(shown);
    } catch (error) {
      this.sayOnce(`A picture of the recording cannot be shown: ${reasonOf(error)}`);
    } finally {
      this.isShowing = false;
    }
  }
}

/** Wishes of the session: geometry and exposure as recorded, and what is up if the recording says it. */
function wishesOf({ wishes, frame }: RecordedFrame): Wishes {
  const { poses, volume_m, voxel_m, exposure, denoise, lamps } = wishes;
  const asked: Wishes = { up: wishes.up ?? null, poses: poses ?? (frame.world_from_camera === null ? "track" : "given") };
  for (const [name, value] of Object.entries({ volume_m, voxel_m, exposure, denoise, lamps })) {
    if (value !== undefined) Object.assign(asked, { [name]: value });
  }
  return asked;
}

const pause = (milliseconds: number): Promise<void> => new Promise((resolve) => setTimeout(resolve, milliseconds));

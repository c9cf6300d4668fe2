// A capturing session of this page, from the form's button to its end.

import { worldFromCamera } from "./capture/axes";
import { startCamera } from "./capture/camera_source";
import { type Shown, startRecorded } from "./capture/recorded_source";
import { type Captured, type Packed, reasonOf, type Shot, type Sink, type Source, SourceError } from "./capture/source";
import { type Draw, startXr } from "./capture/xr_source";
import { byId } from "./dom";
import { type Choice, setupOf } from "./form";
import { scaled, type Seen, Y_UP } from "./objects/picking";
import type { PlaceObject } from "./protocol";
import type { Remote } from "./remote";
import type { Vector3 } from "./sh";

/** Number of frames in flight whose depth is kept for picking. */
const KEPT = 8;

export interface CapturingHooks {
  /** A message for the user; `isEnd`: the session has ended. */
  say(text: string, isEnd: boolean): void;
  /** The image on the screen is the device's newest, taken from this pose (row-major). */
  look(worldFromCamera: readonly number[]): void;
}

/** The local renderer, if there is one. */
export interface Screen {
  /** In a WebXR session. */
  readonly draw: Draw;
  /** Images that the page displays by itself. */
  readonly show?: (shown: Shown) => void;
}

export class Capturing implements Sink {
  private source: Source | null = null;
  private up: Vector3 = Y_UP;
  private readonly seen = new Map<number, Pick<Seen, "camera" | "depth"> & Pick<Shot, "world_from_camera">>();
  private readonly shots = new Map<number, Shot>();

  constructor(
    private readonly remote: Remote,
    private readonly hooks: CapturingHooks,
    private readonly screen: Screen | null,
  ) {}

  /** Start; must be called from a user gesture. Throws SourceError. */
  async start(choice: Choice, stage: Element, url: string): Promise<void> {
    try {
      this.source = await this.open(choice, stage);
    } catch (error) {
      throw error instanceof SourceError ? error : new SourceError(`The camera cannot be started (${reasonOf(error)}).`);
    }
    const setup = setupOf(choice);
    const wishes = { ...setup.wishes, ...this.source.wishes };
    const up = wishes.up ?? Y_UP;
    this.up = scaled(up, 1 / Math.hypot(...up));
    this.remote.capture(url, { ...setup, wishes }, choice.color === "h264", choice.adapts);
  }

  /** What the source brings along. */
  get objects(): readonly PlaceObject[] {
    return this.source?.objects ?? [];
  }

  private open({ source, file, loops, view_deg }: Choice, stage: Element): Promise<Source> {
    const { hooks, screen } = this;
    if (source === "camera") return startCamera(view_deg, byId<HTMLVideoElement>("viewfinder"), this);
    if (source === "xr") {
      const draw: Draw = (view, ...others) => {
        hooks.look(worldFromCamera(view.transform.matrix));
        screen!.draw(view, ...others);
      };
      return startXr(stage, this, screen === null ? null : draw);
    }
    const show = (shown: Shown): void => {
      if (shown.world_from_camera !== null) hooks.look(shown.world_from_camera);
      screen?.show?.(shown);
    };
    return startRecorded(file!, loops, this, screen?.show === undefined ? null : show);
  }

  /** Lens and pose of a recent frame. */
  shotOf(frame: number): Shot | null {
    return this.shots.get(frame) ?? null;
  }

  /** The frame with this number, if its depth is still available. `answered`: its pose according to the server. */
  seenIn(frame: number, answered: readonly number[] | null): Seen | null {
    const seen = this.seen.get(frame);
    const world_from_camera = seen?.world_from_camera ?? answered;
    return seen === undefined || world_from_camera === null ? null : { ...seen, up: this.up, world_from_camera };
  }

  /** Up direction that the server tells, in the axes of this session: given, found, or that of a room. */
  noteUp(up: Vector3): void {
    this.up = up;
  }

  async stop(): Promise<void> {
    await this.source?.stop();
    this.source = null;
  }

  wantsFrame(): boolean {
    return this.remote.wantsFrame;
  }

  take(frame: Captured | Packed): void {
    const { camera, world_from_camera, timestamp_s, captured_ms } = frame;
    const depth = "packed" in frame ? (frame.packed.depth ?? null) : (frame.depth?.slice() ?? null); // the frame's own goes to the worker
    const number = this.remote.send(frame);
    keep(this.shots, number, { camera, world_from_camera, timestamp_s, captured_ms });
    if (depth !== null) keep(this.seen, number, { camera, world_from_camera, depth });
  }

  say(text: string): void {
    this.hooks.say(text, false);
  }

  ended(reason: string): void {
    this.hooks.say(reason, true);
  }
}

function keep<T>(kept: Map<number, T>, number: number, value: T): void {
  kept.set(number, value);
  const oldest = kept.keys().next().value;
  if (kept.size > KEPT && oldest !== undefined) kept.delete(oldest);
}

// A session of this page's own: from the form's button to its end.

import { startCamera } from "./capture/camera_source";
import { type Captured, reasonOf, type Sink, type Source, SourceError } from "./capture/source";
import { type Draw, startXr } from "./capture/xr_source";
import { type Choice, setupOf } from "./form";
import type { Seen } from "./objects/picking";
import type { Remote } from "./remote";

/** Frames on the way whose depth a finger may still need. */
const KEPT = 8;

export interface CapturingHooks {
  /** Something that the person should know; `isEnd`: the session is over with it. */
  say(text: string, isEnd: boolean): void;
}

export class Capturing implements Sink {
  private source: Source | null = null;
  private readonly seen = new Map<number, Seen>();

  constructor(
    private readonly remote: Remote,
    private readonly hooks: CapturingHooks,
    private readonly draw: Draw | null,
  ) {}

  /** Begin, to be called by a tap. Throws SourceError. */
  async start(choice: Choice, stage: Element, url: string): Promise<void> {
    try {
      this.source = choice.source === "xr" ? await startXr(stage, this, this.draw) : await startCamera(choice.view_deg, this);
    } catch (error) {
      throw error instanceof SourceError ? error : new SourceError(`The camera cannot be started (${reasonOf(error)}).`);
    }
    this.remote.capture(url, setupOf(choice));
  }

  /** The frame of a number, as far as its depth is still here. */
  seenIn(frame: number): Seen | null {
    return this.seen.get(frame) ?? null;
  }

  async stop(): Promise<void> {
    await this.source?.stop();
    this.source = null;
  }

  wantsFrame(): boolean {
    return this.remote.wantsFrame;
  }

  take(frame: Captured): void {
    const { camera, world_from_camera, depth } = frame;
    const kept = depth === null ? null : depth.slice(); // the frame's own goes to the worker
    const number = this.remote.send(frame);
    if (kept === null || world_from_camera === null) return;
    this.seen.set(number, { camera, world_from_camera, depth: kept });
    const oldest = this.seen.keys().next().value;
    if (this.seen.size > KEPT && oldest !== undefined) this.seen.delete(oldest);
  }

  say(text: string): void {
    this.hooks.say(text, false);
  }

  ended(reason: string): void {
    this.hooks.say(reason, true);
  }
}

// What a camera of this page gives, whichever it is.

import type { CameraModel, Frame, Wishes } from "../protocol";

/** Milliseconds that page and worker count alike. */
export const now_ms = (): number => performance.timeOrigin + performance.now();

/** Where and when a frame was taken. */
export interface Shot {
  timestamp_s: number;
  /** When it was in this page's hands. */
  captured_ms: number;
  camera: CameraModel;
  /** Row-major; null where the device does not say where it is. */
  world_from_camera: number[] | null;
}

export interface Captured extends Shot {
  /** RGBA of the camera's size, or the picture itself. */
  color: Uint8ClampedArray<ArrayBuffer> | ImageBitmap;
  /** uint16 of the camera's depth lens. */
  depth: Uint16Array<ArrayBuffer> | null;
}

/** A frame whose pictures are packed already; they are sent as they are. */
export interface Packed extends Shot {
  packed: Pick<Frame, "color" | "depth" | "exposure">;
}

/** Where frames go. */
export interface Sink {
  /** Whether a frame that is captured now would be sent now. */
  wantsFrame(): boolean;
  take(frame: Captured | Packed): void;
  /** Something that the person should know. */
  say(text: string): void;
  /** The source has ended by itself; why, in one sentence. */
  ended(reason: string): void;
}

export interface Source {
  /** What it asks of its session besides what the person chose. */
  readonly wishes?: Wishes;
  stop(): Promise<void>;
}

/** A source cannot be started: one sentence that says what is missing and what to do. */
export class SourceError extends Error {}

export const reasonOf = (error: unknown): string =>
  error instanceof Error ? error.message || error.name : String(error);

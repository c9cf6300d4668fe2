// What a camera of this page gives, whichever it is.

import type { CameraModel } from "../protocol";

/** Milliseconds that page and worker count alike. */
export const now_ms = (): number => performance.timeOrigin + performance.now();

export interface Captured {
  timestamp_s: number;
  /** When it was in this page's hands. */
  captured_ms: number;
  camera: CameraModel;
  /** Row-major; null where the device does not say where it is. */
  world_from_camera: number[] | null;
  /** RGBA of the camera's size, or the picture itself. */
  color: Uint8ClampedArray<ArrayBuffer> | ImageBitmap;
  /** uint16 of the camera's depth lens. */
  depth: Uint16Array<ArrayBuffer> | null;
}

/** Where frames go. */
export interface Sink {
  /** Whether a frame that is captured now would be sent now. */
  wantsFrame(): boolean;
  take(frame: Captured): void;
  /** Something that the person should know. */
  say(text: string): void;
  /** The source has ended by itself; why, in one sentence. */
  ended(reason: string): void;
}

export interface Source {
  stop(): Promise<void>;
}

/** A source cannot be started: one sentence that says what is missing and what to do. */
export class SourceError extends Error {}

export const reasonOf = (error: unknown): string =>
  error instanceof Error ? error.message || error.name : String(error);

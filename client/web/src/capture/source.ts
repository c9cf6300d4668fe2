// Common interface of the page's cameras.

import type { CameraModel, Frame, PlaceObject, Wishes } from "../protocol";

/** Milliseconds on a clock that page and worker share. */
export const now_ms = (): number => performance.timeOrigin + performance.now();

/** Pose and time of a frame. */
export interface Shot {
  timestamp_s: number;
  /** Time of arrival in this page. */
  captured_ms: number;
  camera: CameraModel;
  /** Row-major; null if the device has no pose. */
  world_from_camera: number[] | null;
}

export interface Captured extends Shot {
  /** RGBA of the camera's size, or the picture itself. */
  color: Uint8ClampedArray<ArrayBuffer> | ImageBitmap;
  /** uint16 of the camera's depth lens. */
  depth: Uint16Array<ArrayBuffer> | null;
}

/** A frame whose images are encoded already and are sent unchanged. */
export interface Packed extends Shot {
  packed: Pick<Frame, "color" | "depth" | "exposure">;
}

/** Receiver of frames. */
export interface Sink {
  /** Whether a frame captured now would be sent now. */
  wantsFrame(): boolean;
  take(frame: Captured | Packed): void;
  /** A message for the user. */
  say(text: string): void;
  /** The source has ended; the reason in one sentence. */
  ended(reason: string): void;
}

export interface Source {
  /** Wishes of the source in addition to the user's. */
  readonly wishes?: Wishes;
  /** What was placed when it was recorded. */
  readonly objects?: readonly PlaceObject[];
  stop(): Promise<void>;
}

/** A source cannot be started: one sentence with what is missing and what to do. */
export class SourceError extends Error {}

export const reasonOf = (error: unknown): string =>
  error instanceof Error ? error.message || error.name : String(error);

// Messages between the page and its worker.

import type { Sending } from "./capture/encode";
import type { Numbered, Times } from "./capture/stream";
import type { ConnectionState } from "./connection";
import type { LayerParts } from "./local/layer_parts";
import type { Composite, Layer, ServerMessage, Watch } from "./protocol";
import type { Request, Setup } from "./session";

export type ToWorker =
  /** `run`: number of the watching or capturing run; messages of an earlier run are ignored. */
  | { kind: "watch"; run: number; url: string; watch: Watch }
  /** `video`: send colour as H.264 if possible. `adapts`: quality, size and rate follow the link. */
  | { kind: "capture"; run: number; url: string; setup: Setup; video: boolean; adapts: boolean }
  | { kind: "frame"; frame: Numbered }
  | { kind: "request"; request: Request }
  | { kind: "retry" }
  | { kind: "stop"; reason: string };

export type News =
  | { kind: "state"; state: ConnectionState }
  /** Every server message; composites and layers without their image data. */
  | { kind: "message"; message: ServerMessage }
  /** A decoded composite; some are skipped if they arrive too fast. */
  | { kind: "picture"; composite: Composite; bitmap: ImageBitmap; times: Times | null }
  /** A decoded layer, likewise. */
  | { kind: "layer"; layer: Layer; parts: LayerParts; times: Times | null }
  | { kind: "wanted" }
  /** A frame is being sent. */
  | { kind: "sending"; sending: Sending }
  | { kind: "say"; text: string };

export type FromWorker = News & { run: number };

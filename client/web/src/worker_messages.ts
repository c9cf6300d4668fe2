// What the page and its worker say to each other.

import type { Sending } from "./capture/encode";
import type { Numbered, Times } from "./capture/stream";
import type { ConnectionState } from "./connection";
import type { LayerParts } from "./local/layer_parts";
import type { Composite, Layer, ServerMessage, Watch } from "./protocol";
import type { Request, Setup } from "./session";

export type ToWorker =
  /** `run`: of watching or capturing; what is left of an earlier one is not heard. */
  | { kind: "watch"; run: number; url: string; watch: Watch }
  /** `video`: colour is to go as H.264, where that can be. `adapts`: quality, size and rate follow the link. */
  | { kind: "capture"; run: number; url: string; setup: Setup; video: boolean; adapts: boolean }
  | { kind: "frame"; frame: Numbered }
  | { kind: "request"; request: Request }
  | { kind: "retry" }
  | { kind: "stop"; reason: string };

export type News =
  | { kind: "state"; state: ConnectionState }
  /** Every message of the server's; a composite and a layer without the bytes of their pictures. */
  | { kind: "message"; message: ServerMessage }
  /** A composite's picture, decoded; of those that come too fast, some are left out. */
  | { kind: "picture"; composite: Composite; bitmap: ImageBitmap; times: Times | null }
  /** A layer, likewise. */
  | { kind: "layer"; layer: Layer; parts: LayerParts; times: Times | null }
  | { kind: "wanted" }
  /** A frame goes to the server. */
  | { kind: "sending"; sending: Sending }
  | { kind: "say"; text: string };

export type FromWorker = News & { run: number };

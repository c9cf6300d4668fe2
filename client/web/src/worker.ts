// The Web Worker: socket, encoding and decoding, off the main thread.

import { Adaptive, LADDER } from "./capture/adaptive";
import { FrameEncoder } from "./capture/encode";
import { measureDelay_s } from "./capture/link";
import { reasonOf } from "./capture/source";
import { CaptureStream, type Times } from "./capture/stream";
import { Connection } from "./connection";
import { closeParts, decodeLayer, transferOf } from "./local/layer_parts";
import { type Composite, type Layer, type LayerPatch, type ServerMessage } from "./protocol";
import type { FromWorker, News, ToWorker } from "./worker_messages";

/** Quality is reduced until the link carries this frame interval, or the rate that the server computes. */
const WANTED_INTERVAL_S = 1 / 15;

let watching: Connection | null = null;
let stream: CaptureStream | null = null;
let encoder: FrameEncoder | null = null;
/** An answer whose images are decoded here. */
let waiting: { answer: Composite | Layer; times: Times | null } | null = null;
let isDecoding = false;

let run = 0;

const post = (news: News, transfer: Transferable[] = []): void =>
  self.postMessage({ ...news, run } satisfies FromWorker, { transfer });
const say = (text: string): void => post({ kind: "say", text });

self.onmessage = ({ data }: MessageEvent<ToWorker>): void => {
  switch (data.kind) {
    case "watch":
      begin(data.run);
      watching = new Connection(data.url, {
        greeting: () => data.watch,
        onState: (state) => post({ kind: "state", state }),
        onMessage: (message) => tell(message, null),
      });
      watching.open();
      return;
    case "capture":
      begin(data.run);
      beginStream(data);
      return;
    case "frame":
      stream?.offer(data.frame).catch((error: unknown) => say(`a frame cannot be packed: ${reasonOf(error)}`));
      return;
    case "request":
      stream?.request(data.request);
      watching?.send(data.request);
      return;
    case "retry":
      watching?.open();
      stream?.retry();
      return;
    case "stop":
      stop(data.reason);
      return;
    default:
      data satisfies never;
  }
};

function begin(next: number): void {
  stop("");
  run = next;
}

function beginStream({ url, setup, video, adapts }: Extract<ToWorker, { kind: "capture" }>): void {
  // A light alone lacks the server's times.
  const pace = adapts && setup.wishes?.answer !== "light" ? new Adaptive(WANTED_INTERVAL_S) : null;
  if (pace !== null) void measureDelay_s(url).then((delay_s) => (pace.delay_s = delay_s));
  const frames = new FrameEncoder(video, say, () => pace?.coding ?? LADDER[0]!, (sending) => post({ kind: "sending", sending }));
  encoder = frames;
  stream = new CaptureStream(url, setup, (frame) => frames.encode(frame), {
    onWanted: () => post({ kind: "wanted" }),
    onState: (state) => post({ kind: "state", state }),
    onMessage: (message, times) => {
      tell(message, times); // a welcome clears the notes
      void frames.hear(message);
    },
    say,
  }, pace);
  stream.start();
}

function stop(reason: string): void {
  watching?.stop(reason);
  stream?.stop(reason);
  encoder?.close();
  watching = stream = encoder = waiting = null;
}

function tell(message: ServerMessage, times: Times | null): void {
  if (message.type !== "composite" && message.type !== "layer") return post({ kind: "message", message });
  post({ kind: "message", message: message.type === "composite" ? withoutBytes(message) : bare(message) });
  waiting = { answer: message, times };
  void decodeWaiting();
}

const withoutData = <T extends { data: Uint8Array }>(image: T): T => ({ ...image, data: new Uint8Array() });
const withoutBytes = (composite: Composite): Composite => ({ ...composite, color: withoutData(composite.color) });
const bare = (layer: Layer): Layer => ({ ...layer, virtual: barePatch(layer.virtual), ratio: barePatch(layer.ratio) });
const barePatch = (patch: LayerPatch | null): LayerPatch | null =>
  patch === null ? null : { ...patch, color: withoutData(patch.color), depth: withoutData(patch.depth) };

/** Latest-wins decoder: a newer image replaces one that waits while another is being decoded. */
async function decodeWaiting(): Promise<void> {
  if (isDecoding) return;
  isDecoding = true;
  while (waiting !== null) {
    const { answer, times }: NonNullable<typeof waiting> = waiting;
    waiting = null;
    try {
      await (answer.type === "composite" ? decodePicture(answer, times) : decodeParts(answer, times));
    } catch (error) {
      say(`picture ${answer.frame} cannot be shown: ${reasonOf(error)}`);
    }
  }
  isDecoding = false;
}

async function decodePicture(composite: Composite, times: Times | null): Promise<void> {
  const { color } = composite;
  if (color.codec === "raw") throw new Error("it is raw, which this page does not show");
  const begun = run;
  const bitmap = await createImageBitmap(new Blob([new Uint8Array(color.data)], { type: `image/${color.codec}` }));
  if (begun === run) post({ kind: "picture", composite: withoutBytes(composite), bitmap, times }, [bitmap]);
}

async function decodeParts(layer: Layer, times: Times | null): Promise<void> {
  const begun = run;
  const parts = await decodeLayer(layer);
  if (begun !== run) return closeParts(parts);
  post({ kind: "layer", layer: bare(layer), parts, times }, transferOf(parts));
}

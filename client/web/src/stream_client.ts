// One capturing session for programs, in a browser or in Node.js: sends frames, receives light and images.

import { CaptureStream, type Numbered } from "./capture/stream";
import { type ConnectionState, streamUrl } from "./connection";
import { encodeDepth } from "./depth";
import type { Acknowledged, CameraModel, ColorImage, Composite, DepthImage, Dropped, Frame, Layer, Light, Panorama, ServerMessage, Welcome } from "./protocol";
import type { Asked, Request, Setup } from "./session";

/** Options of a session; see protocol/README.md. */
export interface SessionOptions extends Setup {
  camera: CameraModel;
  /** How long to wait for a server that stops answering. */
  patience_s?: number;
  /** Receives notices, each one sentence. */
  onNote?(text: string): void;
}

/** A frame to be sent. */
export interface Shot {
  timestamp_s: number;
  /** Row-major rigid 4x4, metres, camera axes x right, y down, z forward; null: the server tracks. */
  world_from_camera: number[] | null;
  color: ColorImage | null;
  /** Units of `camera.depth_scale_m`, rows from the top, 0: no measurement; or packed already. */
  depth: Uint16Array | DepthImage | null;
  exposure?: number | null;
}

/** The server's result for a frame; with an image or a layer according to `wishes.answer`. */
export interface Answer {
  type: "answer";
  light: Light;
  composite: Composite | null;
  layer: Layer | null;
}

const PATIENCE_S = 60;

interface Waiting<T> {
  resolve(value: T): void;
  reject(error: Error): void;
}

export class StreamClient {
  private readonly stream: CaptureStream;
  private readonly answers = new Map<number, Waiting<Answer | Dropped>>();
  private readonly requests = new Map<number, Waiting<Acknowledged>>();
  private readonly lights = new Map<number, Light>();
  private readonly panoramas = new Map<number, Panorama>();
  private readonly sending: Waiting<void>[] = [];
  private welcomed: Waiting<StreamClient> | null = null;
  private isWanted = false;
  private failure: Error | null = null;
  private count = 0;
  private giveUp: ReturnType<typeof setTimeout> | undefined;
  /** The server's last welcome. */
  welcome!: Welcome;

  /** Open a session at the URL that the server prints. Rejects with one sentence if there is no server or it refuses. */
  static connect(url: string, options: SessionOptions): Promise<StreamClient> {
    return new Promise((resolve, reject) => {
      const client = new StreamClient(url, options);
      client.welcomed = { resolve, reject };
      client.stream.start(options.camera);
    });
  }

  private constructor(
    url: string,
    private readonly options: SessionOptions,
  ) {
    const { camera: _camera, patience_s: _patience, onNote: _onNote, ...setup } = options;
    this.stream = new CaptureStream(streamUrl(new URL(url)), setup, messageOf, {
      onWanted: () => this.noteWanted(),
      onState: (state) => this.noteState(state),
      onMessage: (message) => this.receive(message),
      say: (text) => this.options.onNote?.(text),
    });
  }

  /** Resolves when a frame would be sent at once; take a live camera's newest frame then. */
  ready(): Promise<void> {
    if (this.failure !== null) return Promise.reject(this.failure);
    if (this.isWanted) return Promise.resolve();
    return new Promise((resolve, reject) => this.sending.push({ resolve, reject }));
  }

  /** Send a frame as soon as the window allows; resolves with its answer, or with the reason why there is none. */
  async send(shot: Shot): Promise<Answer | Dropped> {
    const { width } = this.options.camera.depth ?? this.options.camera;
    const depth = shot.depth instanceof Uint16Array ? await encodeDepth(shot.depth, width) : shot.depth;
    while (!this.isWanted) await this.ready();
    this.isWanted = false;
    const number = this.count++;
    const { timestamp_s, world_from_camera, color, exposure = null } = shot;
    const answer = new Promise<Answer | Dropped>((resolve, reject) => this.answers.set(number, { resolve, reject }));
    const { camera } = this.options;
    const frame = { number, timestamp_s, captured_ms: 0, camera, world_from_camera, packed: { color, depth, exposure } };
    if (!(await this.stream.offer(frame))) this.answer(number, { type: "dropped", frame: number, reason: "the connection was lost before it was sent" });
    return answer;
  }

  /** Send a request: place_object, move_object, remove_object, quality. A refusal is in `error`. */
  request(asked: Asked): Promise<Acknowledged> {
    if (this.failure !== null) return Promise.reject(this.failure);
    const request = this.count++;
    const answer = new Promise<Acknowledged>((resolve, reject) => this.requests.set(request, { resolve, reject }));
    this.stream.request({ ...asked, request } as Request);
    return answer;
  }

  /**
   * The light that arrives at a place as a lat-long file, after the frames sent so far. `position_m`: world; null: the
   * first object's place, else the middle of what the last frame sees. Rejects with the reason if there is no light yet.
   */
  async panorama(format: Panorama["format"], position_m: Panorama["position_m"] | null = null): Promise<Panorama> {
    const { request, error } = await this.request({ type: "request_panorama", format, position_m });
    const found = this.panoramas.get(request);
    this.panoramas.delete(request);
    if (error !== null || found === undefined) throw new Error(error ?? "the server acknowledged a panorama and sent none");
    return found;
  }

  /** Close the session; pending promises are rejected. */
  close(reason = ""): void {
    this.fail(new Error("the session was closed"));
    this.stream.stop(reason);
  }

  private noteWanted(): void {
    this.isWanted = true;
    this.sending.shift()?.resolve();
  }

  private noteState(state: ConnectionState): void {
    if (state.kind === "open") this.stopWaiting();
    if (state.kind === "refused" || (state.kind === "lost" && this.welcomed !== null)) {
      this.fail(new Error(state.reason));
      this.stream.stop("");
    } else if (state.kind === "lost") {
      this.options.onNote?.(`the connection was lost (${state.reason}); it is tried again`);
    }
    if (state.kind !== "open" && this.failure === null) this.giveUpLater();
  }

  private stopWaiting(): void {
    clearTimeout(this.giveUp);
    this.giveUp = undefined;
  }

  private giveUpLater(): void {
    if (this.giveUp !== undefined) return;
    const patience_s = this.options.patience_s ?? PATIENCE_S;
    this.giveUp = setTimeout(() => {
      this.fail(new Error(`the server did not answer for ${patience_s} s`));
      this.stream.stop("");
    }, 1000 * patience_s);
  }

  private receive(message: ServerMessage): void {
    switch (message.type) {
      case "welcome":
        this.welcome = message;
        this.welcomed?.resolve(this);
        this.welcomed = null;
        return;
      case "light":
        if (this.options.wishes?.answer === "light") this.answer(message.frame, { type: "answer", light: message, composite: null, layer: null });
        else this.lights.set(message.frame, message);
        return;
      case "composite":
        return this.answerWith(message.frame, message, null);
      case "layer":
        return this.answerWith(message.frame, null, message);
      case "dropped":
        return this.answer(message.frame, message);
      case "acknowledged":
        this.requests.get(message.request)?.resolve(message);
        this.requests.delete(message.request);
        return;
      case "error":
      case "bye":
        this.options.onNote?.(message.reason ?? "");
        return;
      case "panorama":
        if (this.requests.has(message.request)) this.panoramas.set(message.request, message);
        return;
      case "mesh_part":
        return;
      default:
        message satisfies never;
    }
  }

  private answerWith(frame: number, composite: Composite | null, layer: Layer | null): void {
    const light = this.lights.get(frame);
    if (light !== undefined) this.answer(frame, { type: "answer", light, composite, layer });
  }

  private answer(frame: number, answer: Answer | Dropped): void {
    this.lights.delete(frame);
    this.answers.get(frame)?.resolve(answer);
    this.answers.delete(frame);
  }

  private fail(error: Error): void {
    if (this.failure !== null) return;
    this.failure = error;
    this.stopWaiting();
    const { welcomed } = this;
    this.welcomed = null;
    welcomed?.reject(error);
    for (const waiting of [...this.answers.values(), ...this.requests.values(), ...this.sending]) waiting.reject(error);
    this.answers.clear();
    this.requests.clear();
    this.sending.length = 0;
  }
}

function messageOf(frame: Numbered): Promise<Frame> {
  if (!("packed" in frame)) return Promise.reject(new Error("a program packs its pictures itself"));
  const { number, timestamp_s, world_from_camera, packed } = frame;
  return Promise.resolve({ type: "frame", frame: number, timestamp_s, world_from_camera, ...packed });
}

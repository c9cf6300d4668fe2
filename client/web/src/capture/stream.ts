// One capturing session: hello, frames within the server's window, requests until they are answered, and resumption
// after a lost connection (protocol/README.md).

import { CAPTURING, Connection, type ConnectionState, REFUSED_CAPTURE } from "../connection";
import { type CameraModel, type Composite, type Frame, type Layer, type Light, MOST_INFLIGHT, type ServerMessage } from "../protocol";
import type { Request, Setup } from "../session";
import { type Adaptive, SMOOTHING } from "./adaptive";
import { isSameCamera } from "./axes";
import { bytesOf, measuredOf } from "./link";
import { type Captured, now_ms, type Packed } from "./source";

export type Numbered = (Captured | Packed) & { number: number };

/** Times of a frame's stages, in milliseconds on a clock that page and worker share. */
export interface Times {
  captured_ms: number;
  sent_ms: number;
  answered_ms: number;
}

export interface StreamHooks {
  /** A frame captured now would be sent at once. */
  onWanted(): void;
  onState(state: ConnectionState): void;
  /** `times`: only for an answer to a frame. */
  onMessage(message: ServerMessage, times: Times | null): void;
  say(text: string): void;
}

const GONE = 4410;
const LOST = "the connection was lost while it was on its way";

export class CaptureStream {
  private connection: Connection | null = null;
  private camera: CameraModel | null = null;
  private key: string | null = null;
  private isWelcome = false;
  private maxInflight = 1;
  private wasAsked = false;
  private isEncoding = false;
  private readonly unanswered = new Map<number, { captured_ms: number; sent_ms: number; bytes: number }>();
  private lastSent_ms = -Infinity;
  /** To encode a frame, which is not on its way before. */
  private encoding_ms = 0;
  private timer: ReturnType<typeof setTimeout> | undefined;
  private readonly requests = new Map<number, Request>();
  /** With a pace, how many are under way is its matter. */
  private readonly asked: Partial<Setup>;
  /** Number of the connection: work begun on an earlier one is not sent on this one. */
  private epoch = 0;

  /**
   * `encodeFrame`: to what goes over the wire; picture and depth are its to dispose of. `pace`: what the link carries; null:
   * a frame is sent whenever the server has room.
   */
  constructor(
    private readonly url: string,
    private readonly setup: Setup,
    private readonly encodeFrame: (frame: Numbered) => Promise<Frame>,
    private readonly hooks: StreamHooks,
    private readonly pace: Adaptive | null = null,
  ) {
    this.asked = pace === null ? {} : { max_inflight: MOST_INFLIGHT };
  }

  /** Start with a camera; if it is not known yet, the first frame defines it and is not sent. */
  start(camera: CameraModel | null = null): void {
    if (camera !== null) this.openFor(camera);
    else this.askForFrame();
  }

  /** Send a requested frame; returns whether it was sent. */
  async offer(frame: Numbered): Promise<boolean> {
    this.wasAsked = false;
    const isOther = this.camera === null || !isSameCamera(this.camera, frame.camera);
    if (isOther || !this.hasRoom()) release(frame);
    if (isOther) this.openFor(frame.camera);
    if (isOther || !this.hasRoom()) return false;
    const { epoch } = this;
    this.isEncoding = true;
    const begun_ms = now_ms();
    try {
      const message = await this.encodeFrame(frame);
      if (epoch !== this.epoch) return false;
      this.lastSent_ms = now_ms();
      this.encoding_ms += SMOOTHING * (this.lastSent_ms - begun_ms - this.encoding_ms);
      this.unanswered.set(frame.number, { captured_ms: frame.captured_ms, sent_ms: this.lastSent_ms, bytes: bytesOf(message) });
      this.connection?.send(message);
      return true;
    } finally {
      if (epoch === this.epoch) this.isEncoding = false;
      this.askForFrame();
    }
  }

  /** Send a request that is applied exactly once, even if the connection is lost. */
  request(message: Request): void {
    this.requests.set(message.request, message);
    if (this.isWelcome) this.connection?.send(message);
  }

  /** Try to reconnect now. */
  retry(): void {
    this.connection?.open();
  }

  stop(reason: string): void {
    this.connection?.stop(reason);
    this.connection = null;
    this.leave();
  }

  /** A session has one camera; another camera, for example after rotating a tablet, needs a new session. */
  private openFor(camera: CameraModel): void {
    if (this.camera !== null) this.hooks.say("the camera’s picture has another shape now: the session begins anew");
    this.connection?.stop("another camera");
    this.camera = camera;
    this.key = null;
    this.leave();
    this.connection = new Connection(
      this.url,
      {
        greeting: () => ({ type: "hello", ...this.setup, ...this.asked, camera, resume: this.key }),
        onState: (state) => this.hooks.onState(state),
        onMessage: (message) => this.receive(message),
        onClosed: (code) => {
          if (code === GONE) this.key = null;
          if (this.isWelcome) this.pace?.noteLost();
          this.leave();
        },
      },
      CAPTURING,
      REFUSED_CAPTURE,
    );
    this.connection.open();
  }

  private leave(): void {
    this.epoch++;
    clearTimeout(this.timer);
    this.isWelcome = this.isEncoding = false;
    for (const number of this.unanswered.keys()) this.hooks.onMessage({ type: "dropped", frame: number, reason: LOST }, null);
    this.unanswered.clear();
  }

  private hasRoom(): boolean {
    return this.isWelcome && !this.isEncoding && this.unanswered.size < this.maxInflight;
  }

  private askForFrame(): void {
    clearTimeout(this.timer);
    if (this.wasAsked || !(this.camera === null || this.hasRoom())) return;
    const wait_ms = this.wait_ms();
    if (wait_ms > 0) {
      if (wait_ms < Infinity) this.timer = setTimeout(() => this.askForFrame(), wait_ms); // else the next answer does it
      return;
    }
    this.wasAsked = true;
    this.hooks.onWanted();
  }

  /** Time until a frame that is encoded from then on will not wait behind another. */
  private wait_ms(): number {
    return 1000 * (this.pace?.wait_s((now_ms() + this.encoding_ms) / 1000, this.lastSent_ms / 1000, this.unanswered.size) ?? 0);
  }

  private receive(message: ServerMessage): void {
    const times = this.note(message);
    this.hooks.onMessage(message, times);
    this.askForFrame();
  }

  private note(message: ServerMessage): Times | null {
    switch (message.type) {
      case "welcome":
        this.key = message.key ?? null;
        this.maxInflight = message.max_inflight;
        this.isWelcome = true;
        for (const request of this.requests.values()) this.connection?.send(request);
        return null;
      case "acknowledged":
        this.requests.delete(message.request);
        return null;
      case "light":
        return this.setup.wishes?.answer === "light" ? this.answered(message) : null;
      case "composite":
      case "layer":
      case "dropped":
        return this.answered(message);
      default:
        return null;
    }
  }

  private answered(message: { frame: number } & (Composite | Layer | Light | { type: "dropped" })): Times | null {
    const sent = this.unanswered.get(message.frame);
    this.unanswered.delete(message.frame);
    if (sent === undefined) return null;
    const { captured_ms, sent_ms, bytes } = sent;
    const answered_ms = now_ms();
    if (message.type === "composite" || message.type === "layer") this.pace?.note(measuredOf(message, bytes, sent_ms, answered_ms));
    return { captured_ms, sent_ms, answered_ms };
  }
}

function release(frame: Numbered): void {
  if ("color" in frame && "close" in frame.color) frame.color.close();
}

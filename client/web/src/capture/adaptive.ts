// Adapts image quality, size and rate to the link, from the round trips of answered frames. Same rules as
// client/adaptive.py, which explains them. Pure logic; times of one clock, in seconds.

/** Coding of a frame's colour. Depth is lossless on every rung. */
export interface Coding {
  /** JPEG's, 0 to 100. */
  readonly quality: number;
  /** The image is sent at 1/divisor of its width and height; the server enlarges it. */
  readonly divisor: number;
  /** Share of the best video's bit rate; used by video instead of quality and divisor. */
  readonly videoShare: number;
}

/** From best to cheapest. */
export const LADDER: readonly Coding[] = [
  { quality: 90, divisor: 1, videoShare: 1 },
  { quality: 80, divisor: 1, videoShare: 0.7 },
  { quality: 65, divisor: 1, videoShare: 0.5 },
  { quality: 50, divisor: 1, videoShare: 0.35 },
  { quality: 75, divisor: 2, videoShare: 0.2 },
  { quality: 50, divisor: 2, videoShare: 0.12 },
];
/** Share of the frame interval that the busier direction may take. */
const SHARE = 0.9;
/** If the server is even slower, quality costs only latency: a direction may take at most a share of this interval. */
const LONGEST_TRANSFER_S = 0.2;
/** Weight of the newest measurement. */
export const SMOOTHING = 0.25;
/** Number of consecutive slow frames before one rung down. */
const BAD_ANSWERS = 2;
/** Number of consecutive fast frames before one rung up; doubled after each failed try. */
const GOOD_ANSWERS = 8;
const MOST_GOOD_ANSWERS = 128;
/** A rung up is tried if transfer takes less than this share of its limit. */
const SPARE = 0.8;
const WINDOW = 32;

/** One answered frame. */
export interface Measured {
  /** Before its first byte went. */
  sent_s: number;
  answered_s: number;
  /** Part of it in the server's pipeline. */
  computed_s: number;
  bytes_up: number;
  bytes_down: number;
  /** Waiting time at the server before processing; null: not reported. */
  waited_s: number | null;
}

/** Receives answers; returns the coding of the next frame and when to send it. */
export class Adaptive {
  private place = 0;
  private readonly ways_s: number[] = [];
  private lastAnswer_s = -Infinity;
  private lastComputed_s = 0;
  private computed_s = 0;
  private way_s = 0;
  private turn_s = 0;
  private transfer_s = 0;
  private bytesUp = 0;
  private bytesDown = 0;
  private bad = 0;
  private good = 0;
  private patience = GOOD_ANSWERS;
  private hasClimbed = false;
  private told = 0;
  private stepped_s = -Infinity;

  /** `wantedInterval_s`: target frame interval. `delay_s`: round trip of an empty message, if measured. */
  constructor(
    private readonly wantedInterval_s: number,
    public delay_s = Infinity,
  ) {}

  /** Position in `LADDER`. */
  get rung(): number {
    return this.place;
  }

  /** Coding of the next frame. */
  get coding(): Coding {
    return LADDER[this.place]!;
  }

  /**
   * Duration of a frame's slowest stage, where the next one would wait. Stages overlap, so durations do not add up; computing
   * has the turn of others before it.
   */
  get busy_s(): number {
    return Math.max(this.computed_s + this.turn_s, this.transfer_s * greaterShare(this.bytesUp, this.bytesDown));
  }

  /** Frames under way while one is computed and answered, if each is sent in its turn; a late answer is no reason for more. */
  get mostInFlight(): number {
    return Math.max(2, Math.ceil((this.way_s + this.busy_s) / Math.max(this.wantedInterval_s, this.busy_s)));
  }

  /** How long a frame sent now would wait for others; Infinity: an answer must come first. */
  wait_s(now_s: number, lastSent_s: number, unanswered: number): number {
    if (unanswered === 0) return 0;
    if (unanswered >= this.mostInFlight) return Infinity;
    // Processing of the last frame began when it was sent, or when those before it were done, one after another, since the
    // last answer left the server.
    const begun_s = Math.max(lastSent_s, this.lastAnswer_s - this.way_s + (unanswered - 1) * this.busy_s);
    return Math.max(this.busy_s - (now_s - begun_s), 0);
  }

  /** Whether a frame sent now would not have to wait. */
  maySend(now_s: number, lastSent_s: number, unanswered: number): boolean {
    return this.wait_s(now_s, lastSent_s, unanswered) === 0;
  }

  /** A frame was answered. */
  note(frame: Measured): void {
    const { sent_s, answered_s, computed_s, bytes_up, bytes_down } = frame;
    // Time in which the frame before, unanswered when this one was sent, was being processed.
    const waited_s = frame.waited_s ?? Math.min(Math.max(this.lastAnswer_s - sent_s, 0), this.lastComputed_s);
    const way_s = Math.max(answered_s - sent_s - computed_s - waited_s, 0);
    const behind_s = Math.max(this.lastAnswer_s - this.way_s - sent_s, 0); // frames of its own
    const turn_s = frame.waited_s === null ? 0 : Math.max(frame.waited_s - behind_s, 0);
    [this.lastAnswer_s, this.lastComputed_s] = [answered_s, computed_s];
    this.ways_s.push(way_s);
    if (this.ways_s.length > WINDOW) this.ways_s.shift();
    const transfer_s = Math.max(way_s - Math.min(this.delay_s, ...this.ways_s), 0);
    const weight = Math.max(SMOOTHING, 1 / ++this.told);
    this.way_s += weight * (way_s - this.way_s);
    this.computed_s += weight * (computed_s - this.computed_s);
    this.turn_s += weight * (turn_s - this.turn_s);
    this.transfer_s += weight * (transfer_s - this.transfer_s);
    this.bytesUp += weight * (bytes_up - this.bytesUp);
    this.bytesDown += weight * (bytes_down - this.bytesDown);
    // Frames in flight during a step were coded with the previous rung.
    if (sent_s >= this.stepped_s) this.choose(transfer_s * greaterShare(bytes_up, bytes_down), answered_s);
  }

  /** After a reconnect: discard earlier measurements and go one rung down. */
  noteLost(): void {
    this.ways_s.length = 0;
    this.lastAnswer_s = -Infinity;
    this.step(+1, -Infinity);
  }

  private choose(oneWay_s: number, now_s: number): void {
    const wanted_s = this.wantedInterval_s;
    const most_s = SHARE * Math.min(Math.max(wanted_s, this.computed_s), Math.max(wanted_s, LONGEST_TRANSFER_S));
    this.bad = oneWay_s > most_s ? this.bad + 1 : 0;
    this.good = oneWay_s < SPARE * most_s ? this.good + 1 : 0;
    if (this.bad >= BAD_ANSWERS) {
      if (this.hasClimbed) this.patience = Math.min(2 * this.patience, MOST_GOOD_ANSWERS);
      this.step(+1, now_s);
    } else if (this.good >= this.patience) {
      if (this.hasClimbed) this.patience = GOOD_ANSWERS; // the last step up has held
      this.step(-1, now_s);
      this.hasClimbed = true;
    }
  }

  private step(down: number, now_s: number): void {
    this.place = Math.min(Math.max(this.place + down, 0), LADDER.length - 1);
    this.bad = this.good = 0;
    this.hasClimbed = false;
    this.stepped_s = now_s;
  }
}

/** Bytes of the busier direction: both directions transfer at the same time. */
const greaterShare = (up: number, down: number): number => Math.max(up, down) / Math.max(up + down, 1);

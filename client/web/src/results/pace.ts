// What is slow to draw is drawn a few times a second while frames are played, and at once where they stand.

/** Milliseconds; a share of the time is left for the pictures, however slow the machine is. */
const LEAST_INTERVAL = 150;
const SHARE = 4;

export class Pace {
  private asked: number | null = null;
  private timer: ReturnType<typeof setTimeout> | null = null;
  private drawing = 0;
  private nextAt = 0;

  /** `draw`: draws a frame, and resolves when that is done. */
  constructor(
    private readonly draw: (index: number) => Promise<void> | void,
    private readonly now: () => number = () => performance.now(),
  ) {}

  /** Draw a frame: at once, or, while frames are played, the newest one when it is time. */
  ask(index: number, isPlaying: boolean): void {
    this.asked = index;
    if (isPlaying) this.schedule();
    else this.drawAsked();
  }

  private schedule(): void {
    if (this.drawing > 0 || this.timer !== null) return;
    const wait = this.nextAt - this.now();
    if (wait <= 0) this.drawAsked();
    else this.timer = setTimeout(() => this.drawAsked(), wait);
  }

  private drawAsked(): void {
    if (this.timer !== null) clearTimeout(this.timer);
    this.timer = null;
    if (this.asked === null) return;
    const index = this.asked;
    this.asked = null;
    this.drawing++;
    const began = this.now();
    void Promise.resolve(this.draw(index)).finally(() => {
      this.drawing--;
      const now = this.now();
      this.nextAt = now + Math.max(LEAST_INTERVAL, SHARE * (now - began));
      if (this.asked !== null) this.schedule();
    });
  }
}

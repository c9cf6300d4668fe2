/** Frames per second over the last few seconds of arrivals. */
export class FrameRate {
  private times_ms: number[] = [];

  constructor(private readonly window_ms = 4000) {}

  add(now_ms: number): void {
    this.times_ms.push(now_ms);
    this.forget(now_ms);
  }

  /** null until there are two frames in the window. */
  value(now_ms: number): number | null {
    this.forget(now_ms);
    const first = this.times_ms[0];
    const last = this.times_ms.at(-1);
    if (first === undefined || last === undefined || last === first) return null;
    return ((this.times_ms.length - 1) * 1000) / (last - first);
  }

  clear(): void {
    this.times_ms = [];
  }

  private forget(now_ms: number): void {
    const kept = this.times_ms.findIndex((time) => now_ms - time <= this.window_ms);
    this.times_ms = kept < 0 ? [] : this.times_ms.slice(kept);
  }
}

// When each frame is shown: the times at which frames were taken, with long pauses shortened.

/** Seconds; a longer pause between two frames is shown as this. */
const LONGEST_PAUSE = 1;

/** Seconds from the first frame to each one; `fps`: where time stands still or goes back. */
export function showTimes(taken: readonly number[], fps: number): number[] {
  const step = fps > 0 ? 1 / fps : 1 / 30;
  let at = 0;
  return taken.map((time, i) => {
    if (i === 0) return 0;
    const passed = time - taken[i - 1]!;
    return (at += passed > 0 ? Math.min(passed, LONGEST_PAUSE) : step);
  });
}

/** The last frame that is due at a time; 0 before the first. */
export function frameAt(times: readonly number[], at: number): number {
  let [low, high] = [0, times.length - 1];
  while (low < high) {
    const middle = Math.ceil((low + high) / 2);
    if (times[middle]! <= at) low = middle;
    else high = middle - 1;
  }
  return low;
}

/** How long the last frame is shown: as long as usual. */
export function lastDuration(times: readonly number[], fps: number): number {
  if (times.length < 2) return fps > 0 ? 1 / fps : 1 / 30;
  return times.at(-1)! / (times.length - 1);
}

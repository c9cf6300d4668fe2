// Keeps the screen on while there is a live picture.

interface Lock {
  release(): Promise<void>;
}

let wanted = false;
let lock: Lock | null = null;

/** Browsers take the lock away while the page is hidden; `stayAwake` is called again when it is shown. */
export function stayAwake(isLive: boolean): void {
  if (isLive === wanted && (lock !== null) === wanted) return;
  wanted = isLive;
  void (isLive ? hold() : letGo());
}

async function hold(): Promise<void> {
  const { wakeLock } = navigator as { wakeLock?: { request(type: "screen"): Promise<Lock & EventTarget> } };
  if (wakeLock === undefined || document.visibilityState !== "visible" || isAsking) return;
  isAsking = true;
  try {
    const held = await wakeLock.request("screen");
    held.addEventListener("release", () => (lock = null));
    lock = held;
    if (!wanted) await letGo();
  } catch {
    lock = null; // the battery is low: the browser decides
  } finally {
    isAsking = false;
  }
}

let isAsking = false;

async function letGo(): Promise<void> {
  const held = lock;
  lock = null;
  await held?.release();
}

// What the page can do on a device whose browser lacks something, told before anything fails.

import type { Support } from "./capture/support";

export type Device = "iphone" | "quest" | "other";

/** `touchPoints`: an iPad says that it is a Mac, which has no touch screen. */
export function deviceOf(userAgent: string, touchPoints: number): Device {
  if (/OculusBrowser|Quest/.test(userAgent)) return "quest";
  if (/iPhone|iPad|iPod/.test(userAgent) || (/Macintosh/.test(userAgent) && touchPoints > 1)) return "iphone";
  return "other";
}

const JOIN = "join a room that others scan as a plain camera, by a marker that both cameras see";

/** Null: nothing needs to be said. */
export function hintFor(device: Device, support: Support): string | null {
  const camera = support.camera === null ? `, or ${JOIN}` : "";
  switch (device) {
    case "iphone":
      return `Browsers on iPhone and iPad measure no depth. Here you can try the sample, watch a room that others scan and place objects in it${camera}.`;
    case "quest":
      if (support.xr === null) return "This headset scans with its own cameras where its browser gives them to the page. If it does not, watch a room that others scan, and place objects in it.";
      return `The browser of this headset gives pages no pictures of its cameras. Here you can try the sample, watch a room that others scan and place objects in it${camera}.`;
    case "other":
      return null;
  }
}

// Capabilities of this browser, and messages about what it lacks.

import { reasonOf } from "./source";
import { xrSystem } from "./xr";

/** For each source: null if it can be used, else the reason and what to do. */
export interface Support {
  xr: string | null;
  camera: string | null;
}

const NOT_SECURE =
  "Browsers let a page use the camera only over https or on the server’s own machine: start the server with --tls and open the address that it prints.";

export async function findSupport(): Promise<Support> {
  if (!globalThis.isSecureContext) return { xr: NOT_SECURE, camera: NOT_SECURE };
  return { xr: await findXr(), camera: findCamera() };
}

async function findXr(): Promise<string | null> {
  const xr = xrSystem();
  if (xr === null) {
    return "This browser has no WebXR, which says where the device is and how far things are. Chrome on an Android device with ARCore has it.";
  }
  try {
    if (await xr.isSessionSupported("immersive-ar")) return null;
  } catch (error) {
    return `The browser forbids augmented reality here (${reasonOf(error)}).`;
  }
  return "This device offers the browser no augmented reality. Chrome on an Android device with ARCore does.";
}

function findCamera(): string | null {
  const media = (navigator as { mediaDevices?: MediaDevices }).mediaDevices;
  if (media === undefined) return "This browser gives pages no camera.";
  const isRecent = "requestVideoFrameCallback" in HTMLVideoElement.prototype;
  return isRecent ? null : "This browser is too old to read its camera picture by picture.";
}

// A camera without depth and pose: it joins a room that others scan, and is located by a marker.

import type { CameraModel } from "../protocol";
import { fitted, type Size } from "./readback";
import { now_ms, reasonOf, type Sink, type Source, SourceError } from "./source";

const LONGEST_PX = 640;

/** Start the rear camera; `video` plays what it sees. `view_deg`: field of view along the longer side. Throws SourceError. */
export async function startCamera(view_deg: number, video: HTMLVideoElement, sink: Sink): Promise<Source> {
  let stream: MediaStream;
  try {
    stream = await navigator.mediaDevices.getUserMedia({
      video: { facingMode: { ideal: "environment" }, width: { ideal: 1280 }, height: { ideal: 720 } },
      audio: false,
    });
  } catch (error) {
    throw new SourceError(refusal(error));
  }
  video.srcObject = stream;
  await video.play();
  return new CameraSource(stream, video, view_deg, sink);
}

function refusal(error: unknown): string {
  const name = error instanceof Error ? error.name : "";
  if (name === "NotAllowedError") return "The browser was not allowed to use the camera: allow it for this page and start again.";
  if (name === "NotFoundError") return "This device has no camera.";
  return `The camera cannot be used (${reasonOf(error)}).`;
}

/** A lens without distortion with field of view `view_deg` along the longer side. */
export function lensOfView({ width, height }: Size, view_deg: number): CameraModel {
  const focal = Math.max(width, height) / 2 / Math.tan((view_deg * Math.PI) / 360);
  return { width, height, fx: focal, fy: focal, cx: (width - 1) / 2, cy: (height - 1) / 2 };
}

class CameraSource implements Source {
  private hasEnded = false;
  private isTaking = false;

  constructor(
    private readonly stream: MediaStream,
    private readonly video: HTMLVideoElement,
    private readonly view_deg: number,
    private readonly sink: Sink,
  ) {
    stream.getVideoTracks()[0]?.addEventListener("ended", () => this.end());
    video.requestVideoFrameCallback(this.onFrame);
  }

  stop(): Promise<void> {
    this.hasEnded = true;
    for (const track of this.stream.getTracks()) track.stop();
    this.video.srcObject = null;
    return Promise.resolve();
  }

  private end(): void {
    if (!this.hasEnded) this.sink.ended("The camera has gone.");
    void this.stop();
  }

  private readonly onFrame = (time_ms: number): void => {
    if (this.hasEnded) return;
    this.video.requestVideoFrameCallback(this.onFrame);
    if (this.isTaking || !this.sink.wantsFrame()) return;
    this.isTaking = true;
    this.capture(time_ms)
      .catch((error: unknown) => this.sink.say(`A picture of the camera was lost: ${reasonOf(error)}`))
      .finally(() => (this.isTaking = false));
  };

  private async capture(time_ms: number): Promise<void> {
    const captured_ms = now_ms();
    const size = fitted({ width: this.video.videoWidth, height: this.video.videoHeight }, LONGEST_PX);
    const color = await createImageBitmap(this.video, {
      resizeWidth: size.width,
      resizeHeight: size.height,
      resizeQuality: "medium",
    });
    if (this.hasEnded) return color.close();
    const camera = lensOfView(size, this.view_deg);
    this.sink.take({ timestamp_s: time_ms / 1000, captured_ms, camera, world_from_camera: null, color, depth: null });
  }
}

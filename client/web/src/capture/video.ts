// Colour as H.264 video, if this browser has an encoder: no delay, and key pictures only when needed.

import type { ColorImage } from "../protocol";
import { reasonOf } from "./source";

/** Constrained Baseline, level 3.1: no B pictures, so no reordering delay. */
const CODEC = "avc1.42E01F";
/** Bit rate at 15 pictures a second; quality similar to the JPEG that it replaces. */
const BITS_PER_PIXEL = 0.55;
const FRAMES_PER_S = 15;

export interface Picture {
  /** RGBA, the top row first. */
  rgba: Uint8ClampedArray;
  width: number;
  height: number;
}

const configOf = (width: number, height: number, share = 1): VideoEncoderConfig => ({
  codec: CODEC,
  width,
  height,
  avc: { format: "annexb" },
  latencyMode: "realtime",
  framerate: FRAMES_PER_S,
  bitrate: Math.round(share * BITS_PER_PIXEL * width * height * FRAMES_PER_S),
});

/** Why colour cannot be sent as video, in one sentence; null if it can. */
export async function videoLack(): Promise<string | null> {
  if (!("VideoEncoder" in globalThis)) return "This browser lets pages write no video: colour is sent as JPEG.";
  const { supported } = await VideoEncoder.isConfigSupported(configOf(640, 480)).catch(() => ({ supported: false }));
  return supported === true ? null : "This browser writes no H.264: colour is sent as JPEG.";
}

/** 4:2:0 requires even sides. */
export const canBeVideo = (width: number, height: number): boolean => width % 2 === 0 && height % 2 === 0;

/** Video encoder of one session. Call `encode` for one picture at a time. */
export class VideoStream {
  private encoder: VideoEncoder | null = null;
  private size = "";
  private share = 1;
  private chunks: Uint8Array[] = [];
  private failure: string | null = null;
  private isKeyNeeded = true;
  private count = 0;

  /** A picture was lost: make the next one a key picture. */
  needKey(): void {
    this.isKeyNeeded = true;
  }

  /** Encode the next picture with a share of the best bit rate. Throws Error if the browser's encoder fails. */
  async encode(picture: Picture, share = 1): Promise<ColorImage> {
    const { width, height } = picture;
    const encoder = this.encoderOf(width, height, share);
    const frame = new VideoFrame(planesOf(picture), {
      format: "I420",
      codedWidth: width,
      codedHeight: height,
      timestamp: Math.round((this.count++ * 1e6) / FRAMES_PER_S),
      colorSpace: { matrix: "smpte170m", fullRange: true, primaries: "bt709", transfer: "iec61966-2-1" },
    });
    this.chunks = [];
    try {
      encoder.encode(frame, { keyFrame: this.isKeyNeeded });
      this.isKeyNeeded = false;
      await encoder.flush();
    } catch (error) {
      throw new Error(this.failure ?? reasonOf(error));
    } finally {
      frame.close();
    }
    const data = this.chunks[0];
    if (this.chunks.length !== 1 || data === undefined) throw new Error("the browser’s encoder left a picture out");
    return { width, height, codec: "h264", data };
  }

  close(): void {
    if (this.encoder !== null && this.encoder.state !== "closed") this.encoder.close();
    this.encoder = null;
    this.isKeyNeeded = true;
  }

  private encoderOf(width: number, height: number, share: number): VideoEncoder {
    const size = `${width}x${height}`;
    if (this.encoder !== null && this.size === size && this.encoder.state === "configured") {
      if (share !== this.share) this.encoder.configure(configOf(width, height, share)); // without a new key picture
      this.share = share;
      return this.encoder;
    }
    this.close();
    [this.size, this.share] = [size, share];
    this.encoder = new VideoEncoder({
      output: (chunk) => {
        const data = new Uint8Array(chunk.byteLength);
        chunk.copyTo(data);
        this.chunks.push(data);
      },
      error: (error) => (this.failure = error.message),
    });
    this.encoder.configure(configOf(width, height, share));
    return this.encoder;
  }
}

/** Planes Y, Cb and Cr, BT.601 full range as in JPEG, 4:2:0. */
export function planesOf({ rgba, width, height }: Picture): Uint8Array<ArrayBuffer> {
  const halfWidth = width / 2;
  const count = width * height;
  const planes = new Uint8Array(count + count / 2);
  const chroma = planes.subarray(count);
  for (let y = 0; y < height; y += 2) {
    for (let x = 0; x < width; x += 2) {
      let red = 0;
      let green = 0;
      let blue = 0;
      for (const pixel of [y * width + x, y * width + x + 1, (y + 1) * width + x, (y + 1) * width + x + 1]) {
        const r = rgba[4 * pixel]!;
        const g = rgba[4 * pixel + 1]!;
        const b = rgba[4 * pixel + 2]!;
        planes[pixel] = 0.299 * r + 0.587 * g + 0.114 * b + 0.5;
        red += r;
        green += g;
        blue += b;
      }
      const at = (y / 2) * halfWidth + x / 2;
      chroma[at] = Math.min(255, 128.5 + (-0.168736 * red - 0.331264 * green + 0.5 * blue) / 4);
      chroma[at + count / 4] = Math.min(255, 128.5 + (0.5 * red - 0.418688 * green - 0.081312 * blue) / 4);
    }
  }
  return planes;
}

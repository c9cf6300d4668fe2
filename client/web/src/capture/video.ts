// Colour as H.264 video, where this browser has an encoder: each picture at once, key pictures only where they are needed.

import type { ColorImage } from "../protocol";
import { reasonOf } from "./source";

/** Constrained Baseline, level 3.1: no pictures that wait for later ones. */
const CODEC = "avc1.42E01F";
/** Of a stream of 15 pictures a second: about as good as the JPEG that it takes the place of. */
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

/** Why colour cannot be sent as video here, in one sentence; null: it can. */
export async function videoLack(): Promise<string | null> {
  if (!("VideoEncoder" in globalThis)) return "This browser lets pages write no video: colour is sent as JPEG.";
  const { supported } = await VideoEncoder.isConfigSupported(configOf(640, 480)).catch(() => ({ supported: false }));
  return supported === true ? null : "This browser writes no H.264: colour is sent as JPEG.";
}

/** 4:2:0 has pictures of even sides only. */
export const canBeVideo = (width: number, height: number): boolean => width % 2 === 0 && height % 2 === 0;

/** One session's video. `encode` is called for one picture after the other. */
export class VideoStream {
  private encoder: VideoEncoder | null = null;
  private size = "";
  private share = 1;
  private chunks: Uint8Array[] = [];
  private failure: string | null = null;
  private isKeyNeeded = true;
  private count = 0;

  /** A picture was lost on the way: the next one shall rest on none before it. */
  needKey(): void {
    this.isKeyNeeded = true;
  }

  /** The next picture, of a share of the best one's bits. Throws Error where the browser's encoder fails. */
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
      if (share !== this.share) this.encoder.configure(configOf(width, height, share)); // the video goes on
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

/** Y, Cb and Cr one after the other, BT.601 of full range, as in JPEG; chroma of 2 by 2 pixels. */
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

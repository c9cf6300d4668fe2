// Captured frames as they go over the wire.

import { encodeDepth } from "../depth";
import type { ColorImage, Frame, ServerMessage } from "../protocol";
import { type Captured, reasonOf } from "./source";
import type { Numbered } from "./stream";
import { canBeVideo, videoLack, VideoStream } from "./video";

const JPEG_QUALITY = 0.85;

/** Of one session; one frame after the other. Told of what the server says, on which video depends. */
export class FrameEncoder {
  private readonly video = new VideoStream();
  private isVideo = false;

  /** `wantsVideo`: colour as H.264, where server and browser can; `say`: why it is not. */
  constructor(
    private readonly wantsVideo: boolean,
    private readonly say: (text: string) => void,
  ) {}

  /** What the server said; `dropped` and a new connection break the video. */
  async hear(message: ServerMessage): Promise<void> {
    if (message.type === "dropped") this.video.needKey();
    if (message.type !== "welcome") return;
    this.video.needKey();
    if (!this.wantsVideo) return;
    const isRead = message.codecs?.includes("h264") === true; // older servers say nothing of it
    const lack = isRead ? await videoLack() : "This server reads no video: colour is sent as JPEG.";
    this.isVideo = lack === null;
    if (lack !== null) this.say(lack);
  }

  async encode(frame: Numbered): Promise<Frame> {
    const { number, timestamp_s, world_from_camera } = frame;
    const pictures = "packed" in frame ? frame.packed : await this.packed(frame);
    return { type: "frame", frame: number, timestamp_s, world_from_camera, ...pictures };
  }

  close(): void {
    this.video.close();
  }

  private async packed(frame: Captured): Promise<Pick<Frame, "color" | "depth">> {
    const { camera, depth } = frame;
    const lens = camera.depth ?? camera;
    const [color, coded] = await Promise.all([this.encodeColor(frame), depth === null ? null : encodeDepth(depth, lens.width)]);
    return { color, depth: coded };
  }

  private async encodeColor(frame: Captured): Promise<ColorImage> {
    const { width, height } = frame.camera;
    if (!this.isVideo || !canBeVideo(width, height)) return encodeJpeg(frame);
    const rgba = "close" in frame.color ? pixelsOf(frame) : frame.color;
    try {
      return await this.video.encode({ rgba, width, height });
    } catch (error) {
      this.isVideo = false;
      this.say(`The browser’s video encoder failed (${reasonOf(error)}): colour is sent as JPEG.`);
      return encodeJpeg({ ...frame, color: new Uint8ClampedArray(rgba) });
    }
  }
}

async function encodeJpeg(frame: Captured): Promise<ColorImage> {
  const { width, height } = frame.camera;
  const blob = await drawn(frame).canvas.convertToBlob({ type: "image/jpeg", quality: JPEG_QUALITY });
  return { width, height, codec: "jpeg", data: new Uint8Array(await blob.arrayBuffer()) };
}

function pixelsOf(frame: Captured): Uint8ClampedArray {
  const { width, height } = frame.camera;
  return drawn(frame).getImageData(0, 0, width, height).data;
}

/** The picture on a canvas; a bitmap is disposed of. */
function drawn({ color, camera: { width, height } }: Captured): OffscreenCanvasRenderingContext2D {
  const context = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  if (context === null) throw new Error("this browser gives no 2D canvas to a worker");
  if ("close" in color) {
    context.drawImage(color, 0, 0);
    color.close();
  } else {
    context.putImageData(new ImageData(color, width, height), 0, 0);
  }
  return context;
}

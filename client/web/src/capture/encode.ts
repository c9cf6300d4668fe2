// Encodes captured frames for the wire.

import { encodeDepth } from "../depth";
import type { ColorImage, Frame, ServerMessage } from "../protocol";
import { type Coding, LADDER } from "./adaptive";
import { type Captured, reasonOf } from "./source";
import type { Numbered } from "./stream";
import { canBeVideo, videoLack, VideoStream } from "./video";

/** Coding that was used for a frame. */
export type Sending = { as: "jpeg" | "video"; coding: Coding } | { as: "recorded" };

/** Encoder of one session, one frame after the other. Receives the server's messages, on which video depends. */
export class FrameEncoder {
  private readonly video = new VideoStream();
  private isVideo = false;
  private depthCodec: "zdelta" | "zranks" = "zdelta";

  /** `wantsVideo`: colour as H.264 if server and browser support it; `say`: receives the reason if not. */
  constructor(
    private readonly wantsVideo: boolean,
    private readonly say: (text: string) => void,
    private readonly codingOf: () => Coding = () => LADDER[0]!,
    private readonly onSending: (sending: Sending) => void = () => undefined,
  ) {}

  /** Handle a server message; `dropped` and a new connection require a key picture. */
  async hear(message: ServerMessage): Promise<void> {
    if (message.type === "dropped") this.video.needKey();
    if (message.type !== "welcome") return;
    this.video.needKey();
    this.depthCodec = message.depth_codecs?.includes("zranks") === true ? "zranks" : "zdelta";
    if (!this.wantsVideo) return;
    const isRead = message.codecs?.includes("h264") === true; // older servers do not send codecs
    const lack = isRead ? await videoLack() : "This server reads no video: colour is sent as JPEG.";
    this.isVideo = lack === null;
    if (lack !== null) this.say(lack);
  }

  async encode(frame: Numbered): Promise<Frame> {
    const { number, timestamp_s, world_from_camera } = frame;
    if ("packed" in frame) this.onSending({ as: "recorded" });
    const pictures = "packed" in frame ? frame.packed : await this.packed(frame);
    return { type: "frame", frame: number, timestamp_s, world_from_camera, ...pictures };
  }

  close(): void {
    this.video.close();
  }

  private async packed(frame: Captured): Promise<Pick<Frame, "color" | "depth">> {
    const { camera, depth } = frame;
    const lens = camera.depth ?? camera;
    const [color, coded] = await Promise.all([this.encodeColor(frame), depth === null ? null : encodeDepth(depth, lens.width, this.depthCodec)]);
    return { color, depth: coded };
  }

  private async encodeColor(frame: Captured): Promise<ColorImage> {
    const { width, height } = frame.camera;
    const coding = this.codingOf();
    if (!this.isVideo || !canBeVideo(width, height)) return this.encodeJpeg(frame, coding);
    const rgba = "close" in frame.color ? pixelsOf(frame) : frame.color;
    try {
      const image = await this.video.encode({ rgba, width, height }, coding.videoShare);
      this.onSending({ as: "video", coding });
      return image;
    } catch (error) {
      this.isVideo = false;
      this.say(`The browser’s video encoder failed (${reasonOf(error)}): colour is sent as JPEG.`);
      return this.encodeJpeg({ ...frame, color: new Uint8ClampedArray(rgba) }, coding);
    }
  }

  private async encodeJpeg(frame: Captured, coding: Coding): Promise<ColorImage> {
    this.onSending({ as: "jpeg", coding });
    const { canvas } = reduced(drawn(frame), coding.divisor);
    const blob = await canvas.convertToBlob({ type: "image/jpeg", quality: coding.quality / 100 });
    return { width: canvas.width, height: canvas.height, codec: "jpeg", data: new Uint8Array(await blob.arrayBuffer()) };
  }
}

function pixelsOf(frame: Captured): Uint8ClampedArray {
  const { width, height } = frame.camera;
  return drawn(frame).getImageData(0, 0, width, height).data;
}

/** The image on a canvas; closes a bitmap. */
function drawn({ color, camera: { width, height } }: Captured): OffscreenCanvasRenderingContext2D {
  const context = canvasOf(width, height);
  if ("close" in color) {
    context.drawImage(color, 0, 0);
    color.close();
  } else {
    context.putImageData(new ImageData(color, width, height), 0, 0);
  }
  return context;
}

/** The image at 1/divisor of its width and height; the server enlarges it. */
function reduced(full: OffscreenCanvasRenderingContext2D, divisor: number): OffscreenCanvasRenderingContext2D {
  if (divisor === 1) return full;
  const { width, height } = full.canvas;
  const context = canvasOf(Math.ceil(width / divisor), Math.ceil(height / divisor));
  context.imageSmoothingQuality = "medium"; // averages pixels; "low" skips pixels
  context.drawImage(full.canvas, 0, 0, context.canvas.width, context.canvas.height);
  return context;
}

function canvasOf(width: number, height: number): OffscreenCanvasRenderingContext2D {
  const context = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  if (context === null) throw new Error("this browser gives no 2D canvas to a worker");
  return context;
}

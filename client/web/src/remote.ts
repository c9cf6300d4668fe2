// The page's end of the worker.

import type { Captured, Packed } from "./capture/source";
import type { FromWorker, News, ToWorker } from "./worker_messages";
import type { Watch } from "./protocol";
import type { Asked, Request, Setup } from "./session";

export class Remote {
  private readonly worker = new Worker("worker.js", { type: "module" });
  private frames = 0;
  private requests = 0;
  private isWanted = false;
  private run = 0;

  constructor(onNews: (news: News) => void, onFailure: (reason: string) => void) {
    this.worker.onmessage = ({ data }: MessageEvent<FromWorker>) => {
      if (data.run !== this.run) return;
      if (data.kind === "wanted") this.isWanted = true;
      else onNews(data);
    };
    this.worker.onerror = (event) => onFailure(event.message || "its worker could not be loaded");
  }

  watch(url: string, watch: Watch): void {
    this.isWanted = false;
    this.post({ kind: "watch", run: ++this.run, url, watch });
  }

  capture(url: string, setup: Setup, video: boolean, adapts: boolean): void {
    this.isWanted = false;
    this.post({ kind: "capture", run: ++this.run, url, setup, video, adapts });
  }

  /** Whether a frame would be sent at once. */
  get wantsFrame(): boolean {
    return this.isWanted;
  }

  /** Hand a frame over, picture and depth with it; its number. */
  send(taken: Captured | Packed): number {
    this.isWanted = false;
    const number = this.frames++;
    this.post({ kind: "frame", frame: { ...taken, number } }, "packed" in taken ? [] : picturesOf(taken));
    return number;
  }

  /** Ask the server for something; the number by which it answers. */
  request(asked: Asked): number {
    const request = this.requests++;
    this.post({ kind: "request", request: { ...asked, request } as Request });
    return request;
  }

  retry(): void {
    this.post({ kind: "retry" });
  }

  stop(reason: string): void {
    this.isWanted = false;
    this.run++;
    this.post({ kind: "stop", reason });
  }

  private post(message: ToWorker, transfer: Transferable[] = []): void {
    this.worker.postMessage(message, transfer);
  }
}

function picturesOf({ color, depth }: Captured): Transferable[] {
  return ["close" in color ? color : color.buffer, ...(depth === null ? [] : [depth.buffer])];
}

// The page's side of layer mode: what the server has drawn comes apart from the picture, and goes over this device's newest.

import type { Shown } from "./capture/recorded_source";
import { now_ms } from "./capture/source";
import type { Times } from "./capture/stream";
import type { Draw } from "./capture/xr_source";
import { type Ages, noteShown } from "./latency";
import { closeParts } from "./local/layer_parts";
import { type CameraPicture, LayerView, type PosedLayer, type Target } from "./local/layer_view";
import { OwnDisplay } from "./local/own_display";
import { STANDING, type View, viewOf } from "./local/view_matrix";
import { drawPicture } from "./picture";
import type { Layer } from "./protocol";

interface Received {
  layer: Layer;
  posed: PosedLayer;
  times: Times | null;
}

export class LayerMode {
  private view: LayerView | null = null;
  /** Where the session has no display of its own. */
  private own: OwnDisplay | null = null;
  private next: Received | null = null;
  private onScreen: Received | null = null;
  private picture_frames = 0;

  setLayer(layer: Layer, posed: PosedLayer, times: Times | null): void {
    if (this.next !== null) closeParts(this.next.posed.parts);
    this.next = { layer, posed, times };
  }

  /** For each display frame of a WebXR session. */
  readonly draw: Draw = (view, { framebuffer, framebufferWidth: width, framebufferHeight: height }, gl, camera) => {
    const texture = camera();
    this.picture_frames = texture === null ? this.picture_frames + 1 : 0;
    if (texture !== null) this.fill(gl, { texture, isTopRowFirst: false, distorted: null }, view, { framebuffer, width, height });
  };

  /** The newest picture of a source that the page itself displays. */
  readonly show = (shown: Shown): void => {
    this.own ??= new OwnDisplay((own, isNew) => this.display(own, isNew));
    this.view ??= new LayerView(this.own.gl); // what is wrong with it is told by who shows a picture
    this.own.take(shown);
  };

  get ages(): Ages {
    const times = this.onScreen?.times ?? null;
    return { picture_frames: this.picture_frames, layer_ms: times === null ? null : now_ms() - times.captured_ms };
  }

  stop(): void {
    this.own?.stop();
    if (this.next !== null) closeParts(this.next.posed.parts);
    this.next = null;
  }

  private display({ gl, picture, lens, pose }: OwnDisplay, isNew: boolean): void {
    this.picture_frames = isNew ? 0 : this.picture_frames + 1;
    if (!isNew && this.next === null) return;
    this.fill(gl, picture, viewOf(lens, pose ?? STANDING), { framebuffer: null, width: lens.width, height: lens.height });
    drawPicture(gl.canvas as HTMLCanvasElement);
  }

  private fill(gl: WebGL2RenderingContext, picture: CameraPicture, view: View, target: Target): void {
    this.view ??= new LayerView(gl);
    const { next } = this;
    if (next !== null) {
      this.view.setLayer(next.posed);
      if (next.times !== null) noteShown(next.times, next.layer.timings);
      this.onScreen = next;
      this.next = null;
    }
    this.view.draw(picture, view, target);
  }
}

// A canvas of the page's own for pictures that no WebXR session displays, drawn as often as the browser draws.

import type { Shown } from "../capture/recorded_source";
import type { CameraModel } from "../protocol";
import type { CameraPicture } from "./layer_view";

export class OwnDisplay {
  readonly gl: WebGL2RenderingContext;
  private readonly texture: WebGLTexture;
  lens: CameraModel = { width: 1, height: 1, fx: 1, fy: 1, cx: 0, cy: 0 };
  /** Row-major. */
  pose: readonly number[] | null = null;
  private isThere = false;
  private isNew = false;
  private handle = 0;

  /** `draw`: called for each frame of the display once there is a picture. Throws Error without WebGL 2. */
  constructor(private readonly draw: (own: OwnDisplay, isNew: boolean) => void) {
    const gl = document.createElement("canvas").getContext("webgl2", { alpha: false, antialias: false, depth: false });
    if (gl === null) throw new Error("this browser gives no WebGL 2, by which objects are put over the picture");
    this.gl = gl;
    this.texture = gl.createTexture();
    this.handle = requestAnimationFrame(this.onFrame);
  }

  take({ bitmap, camera, world_from_camera }: Shown): void {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, bitmap);
    gl.bindTexture(gl.TEXTURE_2D, null);
    if (gl.canvas.width !== camera.width || gl.canvas.height !== camera.height) [gl.canvas.width, gl.canvas.height] = [camera.width, camera.height];
    this.lens = camera;
    this.pose = world_from_camera;
    this.isThere = this.isNew = true;
  }

  get picture(): CameraPicture {
    const { lens, texture } = this;
    const distortion = lens.distortion ?? [];
    return { texture, isTopRowFirst: true, distorted: distortion.some((value) => value !== 0) ? { ...lens, distortion } : null };
  }

  stop(): void {
    cancelAnimationFrame(this.handle);
    this.gl.getExtension("WEBGL_lose_context")?.loseContext(); // a page may hold a few only
  }

  private readonly onFrame = (): void => {
    this.handle = requestAnimationFrame(this.onFrame);
    if (this.isThere) this.draw(this, this.isNew);
    this.isNew = false;
  };
}

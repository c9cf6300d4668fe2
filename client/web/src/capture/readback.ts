// Reads a camera texture as bytes, scaled down on the GPU, top row first.

export interface Size {
  width: number;
  height: number;
}

interface Step extends Size {
  framebuffer: WebGLFramebuffer;
  buffer: WebGLRenderbuffer;
}

/** Reads textures of one WebGL context and restores its bindings. */
export class Readback {
  private readonly source: WebGLFramebuffer;
  private readonly steps: Step[] = [];

  constructor(private readonly gl: WebGL2RenderingContext) {
    this.source = gl.createFramebuffer()!;
  }

  /** RGBA of `texture`, whose bottom row is the first as WebGL has it, at another size. Throws Error. */
  read(texture: WebGLTexture, from: Size, to: Size): Uint8ClampedArray<ArrayBuffer> {
    const { gl } = this;
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.source);
    gl.framebufferTexture2D(gl.READ_FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    if (gl.checkFramebufferStatus(gl.READ_FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE) throw new Error("its texture cannot be read");
    let held = from;
    halvings(from, to).forEach((size, i) => {
      const filter = size.width === held.width && size.height === held.height ? gl.NEAREST : gl.LINEAR;
      const framebuffer = this.step(i, size);
      const [bottom, top] = i === 0 ? [size.height, 0] : [0, size.height]; // turned over once
      gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, framebuffer);
      gl.blitFramebuffer(0, 0, held.width, held.height, 0, bottom, size.width, top, gl.COLOR_BUFFER_BIT, filter);
      gl.bindFramebuffer(gl.READ_FRAMEBUFFER, framebuffer);
      held = size;
    });
    const rgba = new Uint8ClampedArray(4 * to.width * to.height);
    gl.readPixels(0, 0, to.width, to.height, gl.RGBA, gl.UNSIGNED_BYTE, rgba);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return rgba;
  }

  private step(index: number, { width, height }: Size): WebGLFramebuffer {
    const { gl } = this;
    const known = this.steps[index];
    if (known?.width === width && known.height === height) return known.framebuffer;
    const framebuffer = known?.framebuffer ?? gl.createFramebuffer()!;
    const buffer = known?.buffer ?? gl.createRenderbuffer()!;
    gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA8, width, height);
    gl.bindRenderbuffer(gl.RENDERBUFFER, null);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, framebuffer);
    gl.framebufferRenderbuffer(gl.DRAW_FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, buffer);
    this.steps[index] = { width, height, framebuffer, buffer };
    return framebuffer;
  }
}

/** Sizes on the way down, the last `to`: linear filtering sees two pixels, so none is less than half of the one before. */
export function halvings(from: Size, to: Size): Size[] {
  const sizes: Size[] = [];
  let { width, height } = from;
  while (width > 2 * to.width || height > 2 * to.height) {
    width = Math.max(to.width, Math.ceil(width / 2));
    height = Math.max(to.height, Math.ceil(height / 2));
    sizes.push({ width, height });
  }
  return [...sizes, { width: to.width, height: to.height }];
}

/** A size of the same shape of which no side is longer than `longest_px`; never larger than it was. */
export function fitted({ width, height }: Size, longest_px: number): Size {
  const scale = Math.min(1, longest_px / Math.max(width, height));
  return { width: Math.max(8, Math.round(width * scale)), height: Math.max(8, Math.round(height * scale)) };
}

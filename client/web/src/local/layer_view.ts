// Layer mode: what is virtual, which the server has drawn for an earlier frame, over the camera's newest picture.
//
// Both parts of a layer are moved, by their depth, from where their frame's camera stood to where the picture's stands; then
// all is mixed: picture = coverage * virtual + (1 - coverage) * ratio * camera, in linear light (protocol/README.md).

import type { Lens } from "../capture/axes";
import { keepingState, makeProgram, uniformsOf } from "./gl";
import type { LayerParts } from "./layer_parts";
import { Surface } from "./surface";
import { clipFromCamera, STANDING, type View, viewOf } from "./view_matrix";

/** A layer, and the camera whose picture it was made for. */
export interface PosedLayer {
  parts: LayerParts;
  lens: Lens;
  /** Row-major, in the axes of the views; null: not known, and the layer stays where it is in the picture. */
  world_from_camera: readonly number[] | null;
}

/** A camera's picture, sRGB codes, that fills the view. */
export interface CameraPicture {
  texture: WebGLTexture;
  /** WebXR and WebGL have the bottom row first. */
  isTopRowFirst: boolean;
  /** Of a lens that distorts; null: it does not. */
  distorted: (Lens & { distortion: readonly number[] }) | null;
}

export interface Target {
  framebuffer: WebGLFramebuffer | null;
  width: number;
  height: number;
}

const UNTOUCHED = 128 / 255;

const VERTEX = `#version 300 es
out vec2 at;
void main() {
  at = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0;
  gl_Position = vec4(2.0 * at - 1.0, 0.0, 1.0);
}`;

const MIX = `#version 300 es
precision highp float;
uniform highp sampler2D camera, things, ratios;
uniform bool is_top_first, is_distorted;
uniform vec4 lens;  // fx, fy, cx, cy, of the picture's width and height as 1
uniform float distortion[5];  // k1, k2, p1, p2, k3 as OpenCV has them
in vec2 at;
out vec4 color;
vec2 distorted(vec2 place) {
  vec2 p = (place - lens.zw) / lens.xy;
  float r2 = dot(p, p);
  float radial = 1.0 + r2 * (distortion[0] + r2 * (distortion[1] + r2 * distortion[4]));
  vec2 tangential = 2.0 * p.x * p.y * vec2(distortion[2], distortion[3]) + (r2 + 2.0 * p * p) * vec2(distortion[3], distortion[2]);
  return (p * radial + tangential) * lens.xy + lens.zw;
}
vec3 linear(vec3 code) { return mix(code / 12.92, pow((code + 0.055) / 1.055, vec3(2.4)), step(0.04045, code)); }
vec3 coded(vec3 value) { return mix(value * 12.92, 1.055 * pow(value, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, value)); }
void main() {
  vec2 place = vec2(at.x, 1.0 - at.y);
  if (is_distorted) place = distorted(place);
  vec3 real = linear(texture(camera, is_top_first ? place : vec2(place.x, 1.0 - place.y)).rgb);
  if (any(lessThan(place, vec2(0.0))) || any(greaterThan(place, vec2(1.0)))) real = vec3(0.0);
  vec4 thing = texture(things, at);
  vec3 root = texture(ratios, at).rgb * (255.0 / 128.0);
  vec3 ratio = root * root;
  color = vec4(coded(clamp(thing.rgb + (1.0 - thing.a) * ratio * real, 0.0, 1.0)), 1.0);
}`;

export class LayerView {
  private readonly virtual: Surface;
  private readonly ratio: Surface;
  private readonly mix: WebGLProgram;
  private readonly at: (name: string) => WebGLUniformLocation | null;
  private readonly linear: WebGLSampler;
  private readonly things: Canvas;
  private readonly ratios: Canvas;
  private layer: PosedLayer | null = null;

  /** Throws Error where the browser does not take the shaders. */
  constructor(private readonly gl: WebGL2RenderingContext) {
    this.virtual = new Surface(gl, "virtual");
    this.ratio = new Surface(gl, "ratio");
    this.mix = makeProgram(gl, VERTEX, MIX);
    this.at = uniformsOf(gl, this.mix);
    this.linear = gl.createSampler()!;
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.samplerParameteri(this.linear, name, gl.LINEAR);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.samplerParameteri(this.linear, name, gl.CLAMP_TO_EDGE);
    this.things = new Canvas(gl, gl.SRGB8_ALPHA8); // what is drawn in it is linear, and finer where it is dark
    this.ratios = new Canvas(gl, gl.RGBA8);
    keepingState(gl, 3, () => {
      gl.useProgram(this.mix);
      ["camera", "things", "ratios"].forEach((name, unit) => gl.uniform1i(this.at(name), unit));
    });
  }

  /** From the next picture on; its bitmaps are closed. */
  setLayer(layer: PosedLayer): void {
    this.layer = layer;
    keepingState(this.gl, 1, () => {
      this.virtual.load(layer.parts.virtual);
      this.ratio.load(layer.parts.ratio);
    });
  }

  /** Fill the target with the camera's picture and what is virtual in it, both seen from `view`. */
  draw(camera: CameraPicture, view: View, target: Target): void {
    keepingState(this.gl, 3, () => {
      this.drawLayer(view, target);
      this.drawMix(camera, target);
    });
  }

  private drawLayer(view: View, target: Target): void {
    const { gl, layer } = this;
    gl.enable(gl.DEPTH_TEST);
    gl.bindSampler(0, this.linear);
    for (const [canvas, surface, empty] of [
      [this.things, this.virtual, [0, 0, 0, 0]],
      [this.ratios, this.ratio, [UNTOUCHED, UNTOUCHED, UNTOUCHED, 1]],
    ] as const) {
      canvas.begin(target, empty);
      if (layer !== null) surface.draw(moved(layer, view), layer.lens);
    }
    gl.disable(gl.DEPTH_TEST);
  }

  private drawMix(camera: CameraPicture, { framebuffer, width, height }: Target): void {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.viewport(0, 0, width, height);
    gl.useProgram(this.mix);
    this.setCamera(camera);
    [camera.texture, this.things.texture, this.ratios.texture].forEach((texture, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.bindSampler(unit, this.linear);
    });
    gl.bindVertexArray(null);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  private setCamera({ isTopRowFirst, distorted }: CameraPicture): void {
    const { gl, at } = this;
    gl.uniform1i(at("is_top_first"), Number(isTopRowFirst));
    gl.uniform1i(at("is_distorted"), Number(distorted !== null));
    if (distorted === null) return;
    const { width, height, fx, fy, cx, cy, distortion } = distorted;
    gl.uniform4f(at("lens"), fx / width, fy / height, (cx + 0.5) / width, (cy + 0.5) / height);
    gl.uniform1fv(at("distortion"), distortion);
  }
}

/** From the camera of a layer to where it is drawn. */
function moved({ lens, world_from_camera: pose }: PosedLayer, view: View): Float32Array {
  return pose === null ? clipFromCamera(viewOf(lens, STANDING), STANDING) : clipFromCamera(view, pose);
}

/** A texture that is drawn into, with depth. */
class Canvas {
  readonly texture: WebGLTexture;
  private readonly framebuffer: WebGLFramebuffer;
  private readonly depth: WebGLRenderbuffer;
  private width = 0;
  private height = 0;

  constructor(
    private readonly gl: WebGL2RenderingContext,
    private readonly format: number,
  ) {
    this.texture = gl.createTexture();
    this.framebuffer = gl.createFramebuffer();
    this.depth = gl.createRenderbuffer();
  }

  /** Bind it, empty and of the target's size. */
  begin({ width, height }: Target, empty: readonly number[]): void {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    if (this.width !== width || this.height !== height) this.resize(width, height);
    gl.viewport(0, 0, width, height);
    gl.clearBufferfv(gl.COLOR, 0, empty);
    gl.clearBufferfv(gl.DEPTH, 0, [1]);
  }

  private resize(width: number, height: number): void {
    const { gl } = this;
    [this.width, this.height] = [width, height];
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, this.format, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.texture, 0);
    gl.bindRenderbuffer(gl.RENDERBUFFER, this.depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, this.depth);
  }
}

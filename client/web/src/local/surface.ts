// A part of a layer on the GPU: its picture, and the surface that it lies on, drawn as another camera sees them.

import type { Lens } from "../capture/axes";
import { makeProgram, uniformsOf } from "./gl";
import type { LayerPart } from "./layer_parts";

const VERTEX = `#version 300 es
uniform mat4 clip_from_camera;
uniform vec4 lens;  // fx, fy, cx, cy
layout(location = 0) in vec3 corner;  // column, row, metres
out highp vec3 place;  // column and row times metres, metres: linear on a plane
void main() {
  place = vec3(corner.xy * corner.z, corner.z);
  gl_Position = clip_from_camera * vec4((corner.xy - lens.zw) / lens.xy * corner.z, corner.z, 1.0);
}`;

/** Of colour that is not multiplied by its coverage, linear by its texture's format: mixed by coverage, and multiplied by it. */
const VIRTUAL = `#version 300 es
precision highp float;
uniform highp sampler2D part;
uniform vec2 first;
in highp vec3 place;
out vec4 color;
vec4 covered(ivec2 pixel) {
  vec4 texel = texelFetch(part, clamp(pixel, ivec2(0), textureSize(part, 0) - 1), 0);
  return vec4(texel.rgb * texel.a, texel.a);
}
void main() {
  vec2 at = place.xy / place.z - first;
  ivec2 pixel = ivec2(floor(at));
  vec2 share = at - vec2(pixel);
  vec4 above = mix(covered(pixel), covered(pixel + ivec2(1, 0)), share.x);
  vec4 below = mix(covered(pixel + ivec2(0, 1)), covered(pixel + ivec2(1, 1)), share.x);
  color = mix(above, below, share.y);
  if (color.a < 0.5 / 255.0) discard;
}`;

const RATIO = `#version 300 es
precision highp float;
uniform highp sampler2D part;
uniform vec2 first;
in highp vec3 place;
out vec4 color;
void main() {
  color = texture(part, (place.xy / place.z - first + 0.5) / vec2(textureSize(part, 0)));
}`;

export class Surface {
  private readonly program: WebGLProgram;
  private readonly vertexArray: WebGLVertexArrayObject;
  private readonly vertices: WebGLBuffer;
  private readonly indices: WebGLBuffer;
  private readonly texture: WebGLTexture;
  private readonly at: (name: string) => WebGLUniformLocation | null;
  private first: readonly [number, number] = [0, 0];
  private count = 0;

  constructor(
    private readonly gl: WebGL2RenderingContext,
    private readonly kind: keyof typeof FRAGMENTS,
  ) {
    this.program = makeProgram(gl, VERTEX, FRAGMENTS[kind]);
    this.at = uniformsOf(gl, this.program);
    this.vertexArray = gl.createVertexArray();
    this.vertices = gl.createBuffer();
    this.indices = gl.createBuffer();
    this.texture = gl.createTexture();
  }

  /** Take another part, whose picture is closed; null: there is none. */
  load(part: LayerPart | null): void {
    const { gl } = this;
    this.count = part?.mesh.indices.length ?? 0;
    if (part === null) return;
    this.first = [part.x, part.y];
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, this.kind === "virtual" ? gl.SRGB8_ALPHA8 : gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, part.bitmap);
    part.bitmap.close();
    gl.bindVertexArray(this.vertexArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.vertices);
    gl.bufferData(gl.ARRAY_BUFFER, part.mesh.vertices, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.indices);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, part.mesh.indices, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
  }

  /** Draw, with depth, into the framebuffer that is bound; `sampler` at texture unit 0 is linear. */
  draw(clipFromCamera: Float32Array, { fx, fy, cx, cy }: Lens): void {
    if (this.count === 0) return;
    const { gl, at } = this;
    gl.useProgram(this.program);
    gl.uniformMatrix4fv(at("clip_from_camera"), false, clipFromCamera);
    gl.uniform4f(at("lens"), fx, fy, cx, cy);
    gl.uniform2f(at("first"), ...this.first);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.bindVertexArray(this.vertexArray);
    gl.drawElements(gl.TRIANGLES, this.count, gl.UNSIGNED_INT, 0);
    gl.bindVertexArray(null);
  }
}

const FRAGMENTS = { virtual: VIRTUAL, ratio: RATIO } as const;

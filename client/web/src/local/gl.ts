// What WebGL 2 asks of everybody who draws with it.

/** Throws Error with what the browser says of the shaders. */
export function makeProgram(gl: WebGL2RenderingContext, vertex: string, fragment: string): WebGLProgram {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]] as const) {
    const shader = gl.createShader(kind)!;
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    gl.deleteShader(shader);
    const log = gl.getShaderInfoLog(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(`this browser does not take a shader: ${log}`);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(`this browser does not take a program: ${gl.getProgramInfoLog(program)}`);
  return program;
}

/** Where each uniform of a program is, looked up once. */
export function uniformsOf(gl: WebGL2RenderingContext, program: WebGLProgram): (name: string) => WebGLUniformLocation | null {
  const known = new Map<string, WebGLUniformLocation | null>();
  return (name) => {
    if (!known.has(name)) known.set(name, gl.getUniformLocation(program, name));
    return known.get(name)!;
  };
}

/** Draw with a context that belongs to others too: what they have set is as it was afterwards. `units`: textures used. */
export function keepingState(gl: WebGL2RenderingContext, units: number, draw: () => void): void {
  const get = <T>(name: number): T => gl.getParameter(name) as T;
  const drawn = get<WebGLFramebuffer | null>(gl.DRAW_FRAMEBUFFER_BINDING);
  const read = get<WebGLFramebuffer | null>(gl.READ_FRAMEBUFFER_BINDING);
  const renderbuffer = get<WebGLRenderbuffer | null>(gl.RENDERBUFFER_BINDING);
  const program = get<WebGLProgram | null>(gl.CURRENT_PROGRAM);
  const vertexArray = get<WebGLVertexArrayObject | null>(gl.VERTEX_ARRAY_BINDING);
  const buffer = get<WebGLBuffer | null>(gl.ARRAY_BUFFER_BINDING);
  const viewport = get<Int32Array>(gl.VIEWPORT);
  const colorMask = get<boolean[]>(gl.COLOR_WRITEMASK);
  const depthMask = get<boolean>(gl.DEPTH_WRITEMASK);
  const depthFunc = get<number>(gl.DEPTH_FUNC);
  const switches = [gl.BLEND, gl.CULL_FACE, gl.DEPTH_TEST, gl.SCISSOR_TEST, gl.STENCIL_TEST];
  const abilities = switches.map((name) => [name, gl.isEnabled(name)] as const);
  const settings = [gl.UNPACK_FLIP_Y_WEBGL, gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, gl.UNPACK_COLORSPACE_CONVERSION_WEBGL];
  const storage = settings.map((name) => [name, get<number>(name)] as const);
  const active = get<number>(gl.ACTIVE_TEXTURE);
  const textures = Array.from({ length: units }, (_, unit) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    return [get<WebGLTexture | null>(gl.TEXTURE_BINDING_2D), get<WebGLSampler | null>(gl.SAMPLER_BINDING)] as const;
  });
  try {
    for (const [name] of abilities) gl.disable(name);
    gl.colorMask(true, true, true, true);
    gl.depthMask(true);
    gl.depthFunc(gl.LESS);
    gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, false);
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    draw();
  } finally {
    textures.forEach(([texture, sampler], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.bindSampler(unit, sampler);
    });
    gl.activeTexture(active);
    for (const [name, value] of storage) gl.pixelStorei(name, value);
    for (const [name, isOn] of abilities) isOn ? gl.enable(name) : gl.disable(name);
    gl.depthFunc(depthFunc);
    gl.depthMask(depthMask);
    gl.colorMask(colorMask[0]!, colorMask[1]!, colorMask[2]!, colorMask[3]!);
    gl.viewport(viewport[0]!, viewport[1]!, viewport[2]!, viewport[3]!);
    gl.bindRenderbuffer(gl.RENDERBUFFER, renderbuffer);
    gl.bindVertexArray(vertexArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.useProgram(program);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, drawn);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, read);
  }
}

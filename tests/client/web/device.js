// A device of augmented reality for tests, at the API that the page uses: it shows frames that it was given, each once; or,
// with `fps`, as time goes by, forwards and backwards. Then it numbers the pictures, and keeps what was displayed.
(() => {
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const transform = (matrix) => ({ matrix: new Float32Array(matrix) });
  const device = { frames: [], at: 0, isRead: false, loops: false, fps: null, count: 0, displayed: [], keeps: 0, scale: 1, changed: [] };
  /** Side in pixels of the square in the upper left corner that says a picture's number. */
  const NUMBER_PX = 8;

  /** `frames`: matrix of the view's transform, `color` (RGBA, top row first) and `depth`, both base64. */
  device.load = ({ frames, ...rest }) => {
    const read = (frame) => ({ matrix: frame.matrix, color: bytes(frame.color), depth: bytes(frame.depth) });
    Object.assign(device, rest, { frames: frames.map(read), at: 0, isRead: false });
  };
  device.next = () => {
    device.count++;
    if (device.fps !== null) {
      const last = device.frames.length - 1;
      const step = Math.floor((performance.now() * device.fps) / 1000) % Math.max(1, 2 * last);
      device.at = last - Math.abs(step - last);
      return;
    }
    if (device.isRead) device.at = device.loops ? (device.at + 1) % device.frames.length : device.at + 1;
    device.isRead = false;
  };

  /** The frame's colour, with the number of this display frame in its corner. */
  device.color = () => {
    const { color } = device.frames[device.at];
    if (device.fps === null) return color;
    const numbered = color.slice();
    for (let i = 0; i < NUMBER_PX * NUMBER_PX; i++) {
      const pixel = 4 * (Math.floor(i / NUMBER_PX) * device.width + (i % NUMBER_PX));
      numbered.set([0, device.count & 255, device.count >> 8, 255], pixel);
    }
    return numbered;
  };
  device.keep = () => {
    if (device.keeps === 0) return;
    const { at, count, seen } = device;
    device.displayed.push({ at, count, seen, time_ms: performance.now(), caption: document.getElementById("picture-caption").textContent });
    if (device.displayed.length > device.keeps) device.displayed.shift();
  };

  /** WebGL's state, for tests that whoever draws leaves it as it was found, which is not as it begins. */
  const SETTINGS = ["VIEWPORT", "DEPTH_FUNC", "DEPTH_WRITEMASK", "COLOR_WRITEMASK", "BLEND", "CULL_FACE", "ACTIVE_TEXTURE", "TEXTURE_BINDING_2D", "SAMPLER_BINDING", "CURRENT_PROGRAM", "VERTEX_ARRAY_BINDING", "ARRAY_BUFFER_BINDING", "FRAMEBUFFER_BINDING", "RENDERBUFFER_BINDING", "UNPACK_PREMULTIPLY_ALPHA_WEBGL"];
  const isSame = (a, b) => a === b || ((ArrayBuffer.isView(a) || Array.isArray(a)) && String(a) === String(b));
  const stateOf = (gl) => Object.fromEntries(SETTINGS.map((name) => [name, gl.getParameter(gl[name])]));
  const upset = (gl) => {
    gl.viewport(1, 2, 3, 4);
    gl.depthFunc(gl.GREATER);
    gl.depthMask(false);
    gl.colorMask(true, false, true, false);
    gl.enable(gl.BLEND);
    gl.enable(gl.CULL_FACE);
    gl.activeTexture(gl.TEXTURE2);
    gl.bindTexture(gl.TEXTURE_2D, (device.other ??= gl.createTexture()));
    gl.bindBuffer(gl.ARRAY_BUFFER, (device.buffer ??= gl.createBuffer()));
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, true);
  };
  const calm = (gl) => {
    gl.colorMask(true, true, true, true);
    gl.depthMask(true);
    gl.activeTexture(gl.TEXTURE0);
  };

  class Session extends EventTarget {
    constructor(options) {
      super();
      this.enabledFeatures = [...options.requiredFeatures, ...options.optionalFeatures];
      this.depthDataFormat = device.format;
    }
    updateRenderState() {}
    async requestReferenceSpace() {
      return new EventTarget();
    }
    requestAnimationFrame(callback) {
      return requestAnimationFrame((time_ms) => {
        if (this.hasEnded) return;
        device.next();
        const { gl } = device.layer ?? {};
        if (device.isOdd) upset(gl);
        const before = device.isOdd ? stateOf(gl) : null;
        callback(time_ms, new Frame());
        if (device.isOdd) {
          const after = stateOf(gl);
          device.changed = SETTINGS.filter((name) => !isSame(before[name], after[name]));
          calm(gl);
        }
        device.seen = device.layer?.read();
        device.keep();
      });
    }
    async end() {
      this.hasEnded = true;
      this.dispatchEvent(new Event("end"));
    }
  }

  class Frame {
    getViewerPose() {
      const frame = device.frames[device.at];
      if (frame === undefined) return null;
      const { width, height, projection } = device;
      const camera = { width, height };
      return { views: [{ projectionMatrix: new Float32Array(projection), transform: transform(frame.matrix), camera }], emulatedPosition: false };
    }
    getDepthInformation() {
      const { depth_width, depth_height, depth_scale_m, norm_depth_from_norm_view } = device;
      return {
        data: device.frames[device.at].depth.slice().buffer,
        width: depth_width,
        height: depth_height,
        rawValueToMeters: depth_scale_m,
        normDepthBufferFromNormView: transform(norm_depth_from_norm_view),
      };
    }
  }

  class Layer {
    constructor(_session, gl) {
      this.gl = gl;
      gl.canvas.width = this.framebufferWidth = device.scale * device.width;
      gl.canvas.height = this.framebufferHeight = device.scale * device.height;
      this.framebuffer = null;
      device.layer = this;
    }
    /** RGBA of what was drawn over the room, the bottom row first. */
    read() {
      const { gl, framebufferWidth, framebufferHeight } = this;
      const pixels = new Uint8Array(4 * framebufferWidth * framebufferHeight);
      gl.readPixels(0, 0, framebufferWidth, framebufferHeight, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
      return pixels;
    }
  }

  class Binding {
    constructor(_session, gl) {
      this.gl = gl;
      this.texture = gl.createTexture();
    }
    getCameraImage() {
      const { gl } = this;
      device.isRead = true;
      const bound = gl.getParameter(gl.TEXTURE_BINDING_2D);
      gl.bindTexture(gl.TEXTURE_2D, this.texture);
      gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, true); // the bottom row first, as WebGL has textures
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, device.width, device.height, 0, gl.RGBA, gl.UNSIGNED_BYTE, device.color());
      gl.bindTexture(gl.TEXTURE_2D, bound);
      return this.texture;
    }
  }

  const xr = { isSessionSupported: async () => true, requestSession: async (_mode, options) => new Session(options) };
  Object.defineProperty(navigator, "xr", { value: xr });
  Object.assign(window, { device, XRWebGLLayer: Layer, XRWebGLBinding: Binding });
})();

// A device of augmented reality for tests, at the API that the page uses: it shows frames that it was given, each once.
(() => {
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const transform = (matrix) => ({ matrix: new Float32Array(matrix) });
  const device = { frames: [], at: 0, isRead: false, loops: false };

  /** `frames`: matrix of the view's transform, `color` (RGBA, top row first) and `depth`, both base64. */
  device.load = ({ frames, ...rest }) => {
    const read = (frame) => ({ matrix: frame.matrix, color: bytes(frame.color), depth: bytes(frame.depth) });
    Object.assign(device, rest, { frames: frames.map(read), at: 0, isRead: false });
  };
  device.next = () => {
    if (device.isRead) device.at = device.loops ? (device.at + 1) % device.frames.length : device.at + 1;
    device.isRead = false;
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
        callback(time_ms, new Frame());
        device.seen = device.layer?.read();
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
      gl.canvas.width = this.framebufferWidth = device.width;
      gl.canvas.height = this.framebufferHeight = device.height;
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
      gl.bindTexture(gl.TEXTURE_2D, this.texture);
      gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, true); // the bottom row first, as WebGL has textures
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, device.width, device.height, 0, gl.RGBA, gl.UNSIGNED_BYTE, device.frames[device.at].color);
      gl.bindTexture(gl.TEXTURE_2D, null);
      return this.texture;
    }
  }

  const xr = { isSessionSupported: async () => true, requestSession: async (_mode, options) => new Session(options) };
  Object.defineProperty(navigator, "xr", { value: xr });
  Object.assign(window, { device, XRWebGLLayer: Layer, XRWebGLBinding: Binding });
})();

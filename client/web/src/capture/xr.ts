// What is used of the WebXR Device API, its depth sensing and its raw camera access: TypeScript's own library has none.

export interface XrSystem {
  isSessionSupported(mode: "immersive-ar"): Promise<boolean>;
  requestSession(mode: "immersive-ar", options: XrSessionInit): Promise<XrSession>;
}

export type XrDepthFormat = "unsigned-short" | "luminance-alpha" | "float32";

export interface XrSessionInit {
  requiredFeatures: string[];
  optionalFeatures: string[];
  domOverlay: { root: Element };
  depthSensing: { usagePreference: "cpu-optimized"[]; dataFormatPreference: XrDepthFormat[]; matchDepthView: boolean };
}

export interface XrSession extends EventTarget {
  readonly enabledFeatures?: readonly string[];
  readonly depthDataFormat: XrDepthFormat;
  updateRenderState(state: { baseLayer: XrLayer }): void;
  requestReferenceSpace(type: "local"): Promise<EventTarget>;
  requestAnimationFrame(callback: (time_ms: number, frame: XrFrame) => void): number;
  end(): Promise<void>;
}

export interface XrLayer {
  readonly framebuffer: WebGLFramebuffer | null;
  readonly framebufferWidth: number;
  readonly framebufferHeight: number;
}

export interface XrFrame {
  getViewerPose(space: EventTarget): { readonly views: readonly XrView[]; readonly emulatedPosition: boolean } | null;
  getDepthInformation?(view: XrView): XrDepth | null;
}

/** `matrix`: 4x4, column-major. */
export interface XrTransform {
  readonly matrix: Float32Array;
}

export interface XrView {
  readonly projectionMatrix: Float32Array;
  readonly transform: XrTransform;
  readonly camera?: XrCamera | null;
}

export interface XrCamera {
  readonly width: number;
  readonly height: number;
}

export interface XrDepth {
  readonly data: ArrayBuffer;
  readonly width: number;
  readonly height: number;
  readonly rawValueToMeters: number;
  readonly normDepthBufferFromNormView: XrTransform;
}

export interface XrBinding {
  getCameraImage(camera: XrCamera): WebGLTexture | null;
}

interface XrGlobals {
  readonly XRWebGLLayer?: new (session: XrSession, gl: WebGL2RenderingContext) => XrLayer;
  readonly XRWebGLBinding?: new (session: XrSession, gl: WebGL2RenderingContext) => XrBinding;
}

export const xrGlobals = (): XrGlobals => globalThis as unknown as XrGlobals;
export const xrSystem = (): XrSystem | null => (navigator as { xr?: XrSystem }).xr ?? null;

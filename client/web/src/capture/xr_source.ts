// Colour, depth and pose of a WebXR session on a tablet or phone.

import { depthLens, depthUnits, lensOf, upright, worldFromCamera } from "./axes";
import { fitted, Readback } from "./readback";
import { type Captured, now_ms, reasonOf, type Sink, type Source, SourceError } from "./source";
import { type XrBinding, type XrDepth, type XrFrame, type XrLayer, type XrSession, type XrView, xrGlobals, xrSystem } from "./xr";

const LONGEST_PX = 640;

/** Draws over what the device shows of the room, each time that the device draws. `camera`: its picture of now, if there is one. */
export type Draw = (view: XrView, layer: XrLayer, gl: WebGL2RenderingContext, camera: CameraImage) => void;
/** The bottom row first; holds only while a frame of the session is drawn. */
type CameraImage = () => WebGLTexture | null;

/** Start a session with overlay `root`. Must be called from a user gesture. Throws SourceError. */
export async function startXr(root: Element, sink: Sink, draw: Draw | null = null): Promise<Source> {
  const { XRWebGLLayer, XRWebGLBinding } = xrGlobals();
  if (XRWebGLLayer === undefined || XRWebGLBinding === undefined) throw new SourceError("This browser has no WebXR.");
  const session = await requestSession(root);
  try {
    const gl = document.createElement("canvas").getContext("webgl2", { xrCompatible: true });
    if (gl === null) throw new SourceError("This browser gives no WebGL 2, by which the camera is read.");
    const layer = new XRWebGLLayer(session, gl);
    session.updateRenderState({ baseLayer: layer });
    const space = await session.requestReferenceSpace("local");
    const onView = draw === null ? null : (view: XrView, camera: CameraImage) => draw(view, layer, gl, camera);
    return new XrSource(session, space, new XRWebGLBinding(session, gl), new Readback(gl), sink, onView);
  } catch (error) {
    await session.end().catch(() => undefined); // report the first error
    throw error;
  }
}

async function requestSession(root: Element): Promise<XrSession> {
  try {
    return await xrSystem()!.requestSession("immersive-ar", {
      requiredFeatures: ["local", "camera-access", "dom-overlay"],
      optionalFeatures: ["depth-sensing"],
      domOverlay: { root },
      depthSensing: {
        usagePreference: ["cpu-optimized"],
        dataFormatPreference: ["unsigned-short", "luminance-alpha", "float32"],
        matchDepthView: true,
      },
    });
  } catch (error) {
    throw new SourceError(`The browser does not start augmented reality with camera access (${reasonOf(error)}).`);
  }
}

class XrSource implements Source {
  private hasEnded = false;
  private readonly told = new Set<string>();

  constructor(
    private readonly session: XrSession,
    private readonly space: EventTarget,
    private readonly binding: XrBinding,
    private readonly readback: Readback,
    private readonly sink: Sink,
    private readonly onView: ((view: XrView, camera: CameraImage) => void) | null,
  ) {
    session.addEventListener("end", () => this.end("The browser has ended augmented reality."));
    space.addEventListener("reset", () => this.end("The device has lost its place in the room: start again."));
    session.requestAnimationFrame(this.onFrame);
  }

  async stop(): Promise<void> {
    if (this.hasEnded) return;
    this.hasEnded = true;
    await this.session.end();
  }

  private end(reason: string): void {
    if (this.hasEnded) return;
    this.hasEnded = true;
    this.session.end().catch(() => undefined); // it may have ended already
    this.sink.ended(reason);
  }

  /** Textures and depth are valid only until this returns. */
  private readonly onFrame = (time_ms: number, frame: XrFrame): void => {
    if (this.hasEnded) return;
    this.session.requestAnimationFrame(this.onFrame);
    try {
      const view = frame.getViewerPose(this.space)?.views[0];
      const camera = this.cameraImage(view);
      if (view !== undefined) this.onView?.(view, camera);
      if (!this.sink.wantsFrame()) return;
      const captured = this.capture(time_ms, frame, camera);
      if (captured !== null) this.sink.take(captured);
    } catch (error) {
      this.end(`The camera cannot be read: ${reasonOf(error)}.`);
    }
  };

  /** Requested at most once per frame. */
  private cameraImage(view: XrView | undefined): CameraImage {
    let image: WebGLTexture | null | undefined;
    return () => (image === undefined ? (image = view?.camera ? this.binding.getCameraImage(view.camera) : null) : image);
  }

  private capture(time_ms: number, frame: XrFrame, camera: CameraImage): Captured | null {
    const pose = frame.getViewerPose(this.space);
    const view = pose?.views[0];
    if (!pose || !view || pose.emulatedPosition) return this.wait("The device does not know yet where it is: move it slowly.");
    const texture = camera();
    if (!view.camera || texture === null) return this.wait("The camera gives no picture yet.");
    const depth = this.depthOf(frame, view);
    if (depth === null) return this.wait("The device measures no depth yet: move it slowly from side to side.");
    const size = fitted(view.camera, LONGEST_PX);
    const color = this.readback.read(texture, view.camera, size);
    const lens = lensOf(view.projectionMatrix, size.width, size.height);
    const { units, scale_m } = depthUnits(depth, this.session.depthDataFormat);
    const inView = upright(units, depth.width, depth.height, depth.normDepthBufferFromNormView.matrix);
    return {
      timestamp_s: time_ms / 1000,
      captured_ms: now_ms(),
      camera: { ...lens, depth_scale_m: scale_m, depth: depthLens(lens, inView) },
      world_from_camera: worldFromCamera(view.transform.matrix),
      color,
      depth: inView.units,
    };
  }

  private depthOf(frame: XrFrame, view: XrView): XrDepth | null {
    if (frame.getDepthInformation === undefined || this.session.enabledFeatures?.includes("depth-sensing") === false) {
      throw new Error("this device measures no depth; as a plain camera it can join a room that others scan");
    }
    return frame.getDepthInformation(view);
  }

  private wait(why: string): null {
    if (!this.told.has(why)) this.sink.say(why);
    this.told.add(why);
    return null;
  }
}

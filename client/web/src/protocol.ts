// Generated from protocol/messages.py by `python -m protocol.typescript`. Do not edit.

export const PROTOCOL_VERSION = 1;
export const SUBPROTOCOL = "probeless-v1";
export const SUBPROTOCOL_PREFIX = "probeless-v";
export const MAX_MESSAGE_BYTES = 16777216;
export const MAX_IMAGE_SIDE_PX = 4096;
export const MAX_IMAGE_PIXELS = 2304000;
export const MAX_MESH_BYTES = 12582912;
export const MAX_MESH_PART_BYTES = 4194304;
export const MAX_SCENE_MESH_BYTES = 268435456;
export const MAX_NAME_CHARS = 64;
export const MAX_REASON_CHARS = 400;
export const MAX_SH_BANDS = 6;

/** The depth picture's own lens, where it is another than the colour picture's; conventions as in `CameraModel`. */
export interface DepthCamera {
  width: number;
  height: number;
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  distortion?: [number, number, number, number, number];
  /** Row-major rigid 4x4, metres: point_in_color_camera = color_from_depth * point_in_depth_camera. */
  color_from_depth?: Array<number>;
}

/**
 * Pinhole camera with polynomial distortion, of the colour picture, and of the depth picture unless `depth` is set.
 *
 * A pixel centre lies at integer coordinates: `u = fx * x / z + cx`. Distortion is OpenCV's
 * `(k1, k2, p1, p2, k3)` on normalised coordinates, all zero for a rectified camera.
 */
export interface CameraModel {
  width: number;
  height: number;
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  /** Metres per unit of the uint16 depth. */
  depth_scale_m?: number;
  distortion?: [number, number, number, number, number];
  color_encoding?: "linear16" | "srgb8";
  /** null: depth is registered to colour, pixel by pixel. */
  depth?: DepthCamera | null;
}

/** What a capturing client asks of its session; the command line's options of the same names. */
export interface Wishes {
  /**
   * `auto`: the server chooses where and how transfer is sampled, and the rays, from what its device was measured to
   * take and to err (`probeless tune`).
   */
  preset?: "art1" | "art4" | "art8" | "auto" | "gr15" | "gr15fast" | "reg4" | "reg8" | "rm";
  /** Of `auto`: a frame shall take no longer. */
  budget_ms?: number | null;
  /** Of `auto`: the fastest point whose dominant direction errs by no more, where the device was measured. */
  max_light_error_deg?: number | null;
  rays?: number;
  /** A1: every how many pixels transfer is sampled; null, as of the four below: what the preset says. */
  stride?: number | null;
  /** A3, A4: a frame traces one of so many subsets of the directions; of presets that trace rays. */
  interleave?: 1 | 2 | 4 | 8 | null;
  /** A5. */
  upsampling?: "bicubic" | "bilateral" | null;
  /** A6: no rays where the volume is known to be open; of presets that trace rays. */
  visibility_state?: boolean | null;
  /** R5, A7: depth pictures from all around that visibility is looked up in; of GR15 and GR15FAST. */
  auxiliary_views?: number | null;
  /** G3: D''', the median of the merged depth; without it, D'' is the last. */
  smooth_depth?: boolean;
  /** null: the whole room. */
  ray_length_m?: number | null;
  bands?: number;
  albedo?: "constant" | "estimated";
  indirect?: "none" | "observed";
  as_thesis?: boolean;
  /** Of the lightness that the light is estimated from; the composite keeps the camera's picture. */
  denoise?: "bilateral" | "none" | "tv_l1";
  /** Of TV-L1. */
  denoise_iterations?: number;
  poses?: "given" | "refine" | "track";
  /** x0, y0, z0, x1, y1, z1 in world metres; null: what the first frame sees. */
  volume_m?: [number, number, number, number, number, number] | null;
  voxel_m?: number | null;
  /** World direction; null: the first camera's -y. */
  up?: [number, number, number] | null;
  /** Radiance SH to render with instead of an estimate: 1, 4, 9 ... coefficients; null: estimate one. */
  light?: Array<[number, number, number]> | null;
  /** Of `light`; `webxr`: up as +y and the first camera's view near -z. */
  light_axes?: "webxr" | "world";
  /** Whether lights inside the room are looked for; `auto`: where distant light does not explain what is seen. */
  lamps?: "auto" | "off" | "on";
  /** `auto`: of each frame as it says, estimated where it does not say; `constant`: the same for all frames. */
  exposure?: "auto" | "constant";
  /** Of virtual things: by how much of a pixel they cover, or by its middle, as in pictures that are point samples. */
  edges?: "hard" | "smooth";
  /**
   * What virtual things' brightness rests on: the light's scale, or the averages of the picture and of its shading;
   * `auto`: the scale of a light that is given, the averages under one that is estimated.
   */
  tone_mapping?: "auto" | "average" | "light";
  /** `white`: as the thesis assumes, the light's luminance without its colours. */
  light_color?: "estimated" | "white";
  /**
   * Measures that light estimation takes (thesis 5.2, 5.4): samples that see little sky are left out; weights by how
   * common a normal is (`normals_printed`: as eq. 5.7 has them); earlier frames count; what fits badly counts less.
   */
  robustness?: Array<"memory" | "normals" | "normals_printed" | "openness" | "outliers">;
  /** `everything`: what would hardly be seen is simulated too, to check the bounds of leaving it out. */
  plan?: "everything" | "needed";
  /**
   * `layer`: what is virtual comes apart from the camera's picture, for clients that put it over their newest one;
   * `light`: a frame is answered by its light alone, for clients that draw virtual things themselves.
   */
  answer?: "layer" | "light" | "picture";
  /** Answers carry PNG pictures, and every frame is answered in order instead of latest-wins. */
  lossless?: boolean;
}

/** A square fiducial marker that all clients of a room may see. */
export interface Marker {
  id: number;
  /** Of the black square. */
  side_m: number;
  dictionary?: "4x4_50" | "5x5_100" | "6x6_250" | "7x7_1000" | "apriltag_36h11";
}

/** First message of a client that captures. */
export interface Hello {
  type: "hello";
  client: string;
  camera: CameraModel;
  wishes?: Wishes;
  /** Clients of one room share volume, light and objects; null: a room of its own. */
  room?: string | null;
  /** Of the room: who opens it sets it, the others have to know it. */
  room_key?: string | null;
  /**
   * Where this client's world lies in the room's, which is that of the client that came first; rigid.
   *
   * null: not known, to be found by `marker`, else by what the room has seen.
   */
  room_from_world?: Array<number> | null;
  /** By which the client's world is laid on the room's, once both have seen it. */
  marker?: Marker | null;
  /** How long the session waits for this client when its connection is lost without a bye; 0: it ends with it. */
  keep_s?: number;
  /** `welcome.key` of a session that waits: it goes on as it was, and nothing else of this message counts. */
  resume?: string | null;
}

/** First message of a client that only looks: it receives what the capturing session produces. */
export interface Watch {
  type: "watch";
  /** null: the session that is streaming, now or next. */
  session?: string | null;
  /** Of `session: null`: only those of this room. */
  room?: string | null;
  /** Without it, nothing is seen of rooms that have one. */
  room_key?: string | null;
}

/**
 * Colour: `jpeg` and `png` are sRGB 8-bit; `raw` is interleaved RGB, little endian, in `encoding`.
 *
 * `h264`, of frames only and where `welcome.codecs` has it: the next picture of a session's video.
 */
export interface ColorImage {
  width: number;
  height: number;
  data: Uint8Array;
  codec: "h264" | "jpeg" | "png" | "raw";
  encoding?: "linear16" | "srgb8";
}

/**
 * uint16 depth, lossless.
 *
 * `zdelta` and `zstd-delta`: horizontal delta, zigzag, byte planes, then raw deflate / zstd.
 * `zranks` and `zstd-ranks`: the same of the values' ranks, two in a byte.
 */
export interface DepthImage {
  width: number;
  height: number;
  data: Uint8Array;
  codec: "raw" | "zdelta" | "zranks" | "zstd-delta" | "zstd-ranks";
  /** What the sender changed before: each depth z (metres) by at most this times z^2; null: nothing. */
  rounded_per_m?: number | null;
}

/** One RGB-D frame; answered by exactly one of composite or layer (with its light before it), dropped or error. */
export interface Frame {
  type: "frame";
  frame: number;
  timestamp_s: number;
  world_from_camera: Array<number> | null;
  /** null, with a pose and no depth: of somebody who only looks at a room that others scan. */
  color?: ColorImage | null;
  /** null: of a camera without a depth sensor, in a room that others scan. */
  depth?: DepthImage | null;
  /**
   * Exposure time times gain of the colour picture, in any unit that stays the same for the session; null: unknown.
   *
   * What cannot be one (not finite, not above 0) is told in the composite's notes and taken as null.
   */
  exposure?: number | null;
}

/** Put a virtual object into the session; acknowledged. */
export interface PlaceObject {
  type: "place_object";
  request: number;
  object: string;
  format: "glb" | "obj" | "ply" | "stl";
  data: Uint8Array;
  /** World position of the bottom centre of the model's box; null: the vertices are world coordinates already. */
  position_m?: [number, number, number] | null;
  scale?: number;
  yaw_deg?: number;
}

/** Move an object that is there; acknowledged. */
export interface MoveObject {
  type: "move_object";
  request: number;
  object: string;
  position_m: [number, number, number];
  scale?: number;
  yaw_deg?: number;
}

/** Take an object away; acknowledged. */
export interface RemoveObject {
  type: "remove_object";
  request: number;
  object: string;
}

/** Change the preset of the running session, or the budget by which it is chosen; acknowledged. */
export interface Quality {
  type: "quality";
  request: number;
  preset: "art1" | "art4" | "art8" | "auto" | "gr15" | "gr15fast" | "reg4" | "reg8" | "rm";
  budget_ms?: number | null;
  max_light_error_deg?: number | null;
}

/** Ask for the surface fused so far, as files; answered by the parts of each and then acknowledged. */
export interface RequestMesh {
  type: "request_mesh";
  request: number;
}

/** Either side says it is leaving, and why. */
export interface Bye {
  type: "bye";
  reason?: string;
}

/** Answer to hello and watch. */
export interface Welcome {
  type: "welcome";
  session: string;
  server: string;
  device: string;
  /** Frames the client may have unanswered. */
  max_inflight: number;
  /** By which the session is resumed (`hello.resume`), where the client asked for it to be kept. A secret. */
  key: string | null;
  /**
   * Frames that were sent before are not answered any more, unless the session is lossless; requests are, if they
   * are sent again.
   */
  resumed: boolean;
  room: string | null;
  /** That frames' colour may have. */
  codecs: Array<"h264" | "jpeg" | "png" | "raw">;
  /** That their depth may have. */
  depth_codecs: Array<"raw" | "zdelta" | "zranks" | "zstd-delta" | "zstd-ranks">;
}

/** Milliseconds under the thesis's row names (table 6.2): device plus host time; total is wall time. */
export interface Timings {
  input: number;
  reconstruct: number;
  surface: number;
  dynamic_geometry: number;
  radiance_transfer: number;
  light_estimation: number;
  rendering: number;
  total: number;
}

/** An effect that did not run, why, and what leaving it out can change at most, in display units (1 is 1/255). */
export interface LeftOut {
  effect: string;
  reason: string;
  error_bound: number | null;
}

/** Where and how finely a frame was sampled, and why. */
export interface OperatingPoint {
  /** As options of the command line. */
  settings: string;
  reason: string;
  /** What a frame was expected to take; of points that were chosen, like the next. */
  expected_ms: number | null;
  /** Error of the dominant direction where the device was measured. */
  light_error_deg: number | null;
}

/** Which effects ran for a frame, in order, which did not, and how finely it was sampled. */
export interface Plan {
  run: Array<string>;
  left_out: Array<LeftOut>;
  /** null: a camera that is lost samples nothing. */
  point: OperatingPoint | null;
}

/** The finished picture of one frame. */
export interface Composite {
  type: "composite";
  frame: number;
  timestamp_s: number;
  world_from_camera: Array<number>;
  tracking: "given" | "lost" | "tracked";
  timings: Timings;
  plan: Plan;
  /** What was wrong with this frame's input, one line each. */
  notes: Array<string>;
  /** From when the frame had arrived until the device began with it: unread, decoded, waiting for its turn. */
  waited_ms: number;
  color: ColorImage;
}

/** A part of the camera's picture, and how far away each of its pixels is. */
export interface LayerPatch {
  /** Column of the camera's picture in which the part begins. */
  x: number;
  y: number;
  /** PNG. */
  color: ColorImage;
  /** Of the same size, along the camera's z; 0: the pixel says nothing. */
  depth: DepthImage;
}

/**
 * What is virtual in one frame (`wishes.answer`), to be put over a camera picture p, of this frame or a later one.
 *
 * All linear: picture = coverage * virtual + (1 - coverage) * ratio * p (thesis 7.2.1).
 */
export interface Layer {
  type: "layer";
  frame: number;
  timestamp_s: number;
  world_from_camera: Array<number>;
  tracking: "given" | "lost" | "tracked";
  timings: Timings;
  plan: Plan;
  /** What was wrong with this frame's input, one line each. */
  notes: Array<string>;
  /** From when the frame had arrived until the device began with it: unread, decoded, waiting for its turn. */
  waited_ms: number;
  /**
   * Colour of four channels: sRGB, not multiplied by coverage, which is the fourth, 255 for all of a pixel.
   *
   * null: nothing is seen of it.
   */
  virtual: LayerPatch | null;
  /**
   * Colour of three channels: 128 times the root of what real surface is multiplied by.
   *
   * null: real surface stays as it is.
   */
  ratio: LayerPatch | null;
  /** Metres of a unit of depth. */
  depth_scale_m: number;
}

/** One of the lights that the room's light is made of, besides an even sky. */
export interface DirectedLight {
  /** World, unit, towards the light. */
  direction: [number, number, number];
  /** Radiance of a white surface that faces it, lit by it alone. */
  irradiance: [number, number, number];
  /** Standard deviation along either axis; 0 for light from one direction. */
  spread_deg: number;
}

/** A light inside the room that shines evenly all around. */
export interface Lamp {
  /** World. */
  position_m: [number, number, number];
  /** One standard deviation along the world's axes. */
  position_std_m: [number, number, number];
  /**
   * Radiant intensity: radiance of the light's units times m^2; d metres away it adds intensity / (pi d^2) to a white
   * surface that faces it.
   */
  intensity: [number, number, number];
  intensity_std: [number, number, number];
  /** Of the light (luminance) that the surfaces seen receive. */
  share: number;
}

/** The room's light as one frame left it; the fields of a line of `light.jsonl`. */
export interface Light {
  type: "light";
  frame: number;
  timestamp_s: number;
  /** 16 x [r, g, b], zeros for bands not estimated. */
  sh: Array<[number, number, number]>;
  /** All coefficients, when there are more than 16. */
  sh_all: Array<[number, number, number]> | null;
  /** One standard deviation of each of `sh`; null where unknown. */
  sh_std: Array<[number | null, number | null, number | null]>;
  /** 27 floats, RGB-interleaved C00 C1-1 C10 C11 ..., in axes with up as +y and the first camera's view near -z. */
  sh_webxr: Array<number>;
  /** World, unit, towards the light, from l = 1 of Rec. 709 luminance; (0, 0, 0) where there is none. */
  dominant_direction: [number, number, number];
  dominant_intensity: number;
  /** Each of the lights, strongest first, where there is more than an even sky. */
  dominant_lights: Array<DirectedLight>;
  /** Lights inside the room, strongest first; their light is not part of `sh`. */
  lamps: Array<Lamp>;
  /**
   * Of this frame relative to the session's first. All radiance here is in units of this frame's picture: over
   * `exposure` it is in those of the first one's, which a room under steady light keeps.
   */
  exposure: number;
  /** World, unit: along it objects stand, as whoever opened the room asked. */
  up: [number, number, number] | null;
  /** Condition number of the unregularised normal equations; null when infinite. */
  condition: number | null;
  valid: boolean;
}

/** This frame was replaced by a newer one before it was read, or refused; nothing else comes for it. */
export interface Dropped {
  type: "dropped";
  frame: number;
  reason: string;
}

/**
 * A piece of a file of the scene's mesh; the pieces of a file come in order, one file after the other.
 *
 * PLY: world axes, metres. GLB: a node turns the world into glTF's axes, +y up. Vertex colours are sRGB.
 */
export interface MeshPart {
  type: "mesh_part";
  request: number;
  format: "glb" | "ply";
  /** Of the whole file. */
  size_bytes: number;
  /** Of this piece's first byte in the file. */
  offset: number;
  data: Uint8Array;
}

/** A control message was applied, or refused with its error. */
export interface Acknowledged {
  type: "acknowledged";
  request: number;
  error: string | null;
  notes: Array<string>;
}

/** Something the client sent is wrong; `fatal` when the server closes the socket after it. */
export interface Error {
  type: "error";
  reason: string;
  fatal: boolean;
}

export type ClientMessage =
  | Hello
  | Watch
  | Frame
  | PlaceObject
  | MoveObject
  | RemoveObject
  | Quality
  | RequestMesh
  | Bye;

export type ServerMessage =
  | Welcome
  | Composite
  | Layer
  | Light
  | Dropped
  | MeshPart
  | Acknowledged
  | Error
  | Bye;

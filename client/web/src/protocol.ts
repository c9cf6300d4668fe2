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
export const MAX_LIGHT_PLACES = 16;
export const FEW_INFLIGHT = 2;
export const MOST_INFLIGHT = 8;
export const VALID_SPREAD_DEG = 25;
export const MAX_PANORAMA_BYTES = 8388608;

/** Lens of the depth image, if it differs from the colour lens; conventions as in `CameraModel`. */
export interface DepthCamera {
  /** Pixels. */
  width: number;
  /** Pixels. */
  height: number;
  /** Focal length in pixels: of the width's direction. */
  fx: number;
  /** Focal length in pixels: of the height's direction. */
  fy: number;
  /** Principal point, pixels; 0 is the centre of the first column. */
  cx: number;
  /** Pixels; 0 is the centre of the first row. */
  cy: number;
  /** OpenCV's k1, k2, p1, p2, k3; all zero for a rectified picture. */
  distortion?: [number, number, number, number, number];
  /** Row-major rigid 4x4, metres: point_in_color_camera = color_from_depth * point_in_depth_camera. */
  color_from_depth?: Array<number>;
}

/**
 * Pinhole camera with polynomial distortion, for the colour image, and for the depth image unless `depth` is set.
 *
 * A pixel centre lies at integer coordinates: `u = fx * x / z + cx`. Distortion is OpenCV's
 * `(k1, k2, p1, p2, k3)` on normalised coordinates, all zero for a rectified camera.
 */
export interface CameraModel {
  /** Pixels. */
  width: number;
  /** Pixels. */
  height: number;
  /** Focal length in pixels: of the width's direction. */
  fx: number;
  /** Focal length in pixels: of the height's direction. */
  fy: number;
  /** Principal point, pixels; 0 is the centre of the first column. */
  cx: number;
  /** Pixels; 0 is the centre of the first row. */
  cy: number;
  /** Metres per unit of the uint16 depth. */
  depth_scale_m?: number;
  /** OpenCV's k1, k2, p1, p2, k3; all zero for a rectified picture. */
  distortion?: [number, number, number, number, number];
  /** What the numbers of every colour picture of the session are. */
  color_encoding?: "linear16" | "srgb8";
  /** null: depth is registered to colour, pixel by pixel. */
  depth?: DepthCamera | null;
}

/** Options of a capturing client's session; the command line has options of the same names. */
export interface Wishes {
  /**
   * `auto`: the server chooses sampling and rays from the times and errors measured on its device (`probeless
   * tune`).
   */
  preset?: "art1" | "art4" | "art8" | "auto" | "gr15" | "gr15fast" | "reg4" | "reg8" | "rm";
  /** With `auto`: time limit of a frame. */
  budget_ms?: number | null;
  /** With `auto`: choose the fastest point whose error of the dominant direction was measured to be no larger. */
  max_light_error_deg?: number | null;
  /** Directions that are traced from a place. */
  rays?: number;
  /** A1: distance between transfer samples in pixels. null here and in the next four fields: the preset's value. */
  stride?: number | null;
  /** A3, A4: number of subsets of the directions, of which a frame traces one; only for presets that trace rays. */
  interleave?: 1 | 2 | 4 | 8 | null;
  /** A5. */
  upsampling?: "bicubic" | "bilateral" | null;
  /** A6: skip rays where the volume is known to be open; only for presets that trace rays. */
  visibility_state?: boolean | null;
  /** R5, A7: depth views around the scene in which visibility is looked up; only for GR15 and GR15FAST. */
  auxiliary_views?: number | null;
  /** G3: D''', the median of the merged depth; without it, D'' is the last. */
  smooth_depth?: boolean;
  /** null: the whole room. */
  ray_length_m?: number | null;
  /** SH bands of the estimated light: 4 are 16 coefficients. */
  bands?: number;
  /** Of real surfaces: the same everywhere, or estimated from the pictures. */
  albedo?: "constant" | "estimated";
  /** Light from one real surface to another: left out, or as photographed. */
  indirect?: "none" | "observed";
  /** Plain least squares with rays of 10 cm; one albedo and no indirect light, whatever the fields above say. */
  as_thesis?: boolean;
  /** Denoising of the lightness used for light estimation; the composite keeps the camera's image. */
  denoise?: "bilateral" | "none" | "tv_l1";
  /** Iterations of TV-L1. */
  denoise_iterations?: number;
  /** `given`: those of the frames; `track`: the server finds them; `refine`: it corrects those of the frames. */
  poses?: "given" | "refine" | "track";
  /** x0, y0, z0, x1, y1, z1 in world metres; null: the view of the first frame. */
  volume_m?: [number, number, number, number, number, number] | null;
  /** Side of a cell of the volume; null: from the size of the volume. */
  voxel_m?: number | null;
  /** World direction; null: found from the scan, else the first camera's -y, as the notes of the answers say. */
  up?: [number, number, number] | null;
  /**
   * Radiance SH to render with instead of an estimate: 1, 4, 9 ... coefficients, in units of the first picture, whose
   * white is 1 (for other units, as most panoramas have, see `tone_mapping`); null: estimate one.
   */
  light?: Array<[number, number, number]> | null;
  /** Axes of `light`; `webxr`: up as +y and the first camera's view near -z. */
  light_axes?: "webxr" | "world";
  /** World positions, metres: places at which the arriving light is told in `light.at`, at most MAX_LIGHT_PLACES. */
  light_at?: Array<[number, number, number]>;
  /**
   * Whether to search for lights inside the room; `auto`: only where one light is estimated for all places (`albedo`
   * constant, no indirect light) and does not explain the image.
   */
  lamps?: "auto" | "off" | "on";
  /** `auto`: the frame's exposure if given, else estimated; `constant`: the same for all frames. */
  exposure?: "auto" | "constant";
  /** Edges of virtual objects: by pixel coverage, or by the pixel centre, for images that are point samples. */
  edges?: "hard" | "smooth";
  /**
   * Brightness of virtual objects follows the light's scale, or the averages of the image and its shading; `auto`:
   * the scale; with `as_thesis`, the averages for an estimated light.
   */
  tone_mapping?: "auto" | "average" | "light";
  /** `white`: only the light's luminance, as the thesis assumes. */
  light_color?: "estimated" | "white";
  /**
   * Robustness measures of light estimation (thesis 5.2, 5.4): `openness` skips samples that see little sky,
   * `normals` weights by frequency of normals (`normals_printed`: as in eq. 5.7), `memory` uses earlier frames,
   * `outliers` reduces the weight of bad fits.
   */
  robustness?: Array<"memory" | "normals" | "normals_printed" | "openness" | "outliers">;
  /** `everything`: also run effects whose change would be invisible, to check the bounds of culling. */
  plan?: "everything" | "needed";
  /** `off`: transfer is computed anew in every frame, to compare with what is kept at places of the world. */
  cache?: "off" | "on";
  /**
   * `layer`: virtual content separate from the camera's image, for clients that compose it with their newest image.
   * `light`: only the light, for clients that render virtual objects themselves.
   */
  answer?: "layer" | "light" | "picture";
  /** Answers use PNG, and every frame is answered in order instead of latest-wins. */
  lossless?: boolean;
}

/** A square fiducial marker that the clients of a room may detect. */
export interface Marker {
  /** Number of the marker in its dictionary. */
  id: number;
  /** Side of the black square. */
  side_m: number;
  /** OpenCV's name of the set of markers. */
  dictionary?: "4x4_50" | "5x5_100" | "6x6_250" | "7x7_1000" | "apriltag_36h11";
}

/** First message of a capturing client. */
export interface Hello {
  type: "hello";
  /** Name of the program, for the server's log. */
  client: string;
  /** Lens and size of the pictures that follow. */
  camera: CameraModel;
  /** Options of the session. */
  wishes?: Wishes;
  /** Clients of one room share volume, light and objects; null: a room of its own. */
  room?: string | null;
  /** Key of the room: set by the client that opens it, required from the others. */
  room_key?: string | null;
  /**
   * Rigid transform from this client's world to the room's, which is the world of its first client.
   *
   * null: unknown; found by `marker` or by relocalisation in the scanned room.
   */
  room_from_world?: Array<number> | null;
  /** Marker that aligns the client's world with the room's once it has been detected in both. */
  marker?: Marker | null;
  /** How long the session survives a connection that is lost without a bye; 0: not at all. */
  keep_s?: number;
  /**
   * Frames that the client would have unanswered at most. The default keeps a server busy that is near.
   *
   * More are for a client that is far and sends no frame before its turn: who fills a larger window sees older pictures.
   */
  max_inflight?: number;
  /** `welcome.key` of a session to resume. It continues unchanged; all other fields of this message are ignored. */
  resume?: string | null;
}

/** First message of a watching client, which receives the output of a capturing session. */
export interface Watch {
  type: "watch";
  /** null: the session that is streaming, or the next one to start. */
  session?: string | null;
  /** With `session: null`: only sessions of this room. */
  room?: string | null;
  /** Required to watch a room that has a key. */
  room_key?: string | null;
}

/**
 * Colour: `jpeg` and `png` are sRGB 8-bit; `raw` is interleaved RGB, little endian, in `encoding`.
 *
 * `h264`, in frames only and if listed in `welcome.codecs`: the next picture of the session's video.
 */
export interface ColorImage {
  /** Pixels. */
  width: number;
  /** Pixels. */
  height: number;
  /** The encoded picture, as its codec says. */
  data: Uint8Array;
  /** How `data` is encoded. */
  codec: "h264" | "jpeg" | "png" | "raw";
  /** What the numbers are; that of the session's camera. */
  encoding?: "linear16" | "srgb8";
}

/**
 * uint16 depth, lossless.
 *
 * `zdelta` and `zstd-delta`: horizontal delta, zigzag, byte planes, then raw deflate / zstd.
 * `zranks` and `zstd-ranks`: the same for the values' ranks, two in a byte.
 */
export interface DepthImage {
  /** Pixels. */
  width: number;
  /** Pixels. */
  height: number;
  /** The encoded picture, as its codec says. */
  data: Uint8Array;
  /** How `data` is encoded. */
  codec: "raw" | "zdelta" | "zranks" | "zstd-delta" | "zstd-ranks";
  /** Rounding by the sender: each depth z (metres) was changed by at most this times z^2; null: no rounding. */
  rounded_per_m?: number | null;
}

/** One RGB-D frame; answered by exactly one of composite or layer (with its light before it), dropped or error. */
export interface Frame {
  type: "frame";
  /** Number by which the frame is answered; a client counts upwards. */
  frame: number;
  /** Seconds of the client's clock, increasing. */
  timestamp_s: number;
  /** Pose of the colour camera; null where the server tracks. */
  world_from_camera: Array<number> | null;
  /** null, with a pose and no depth: the view of a client without a camera, in a room that others scan. */
  color?: ColorImage | null;
  /** null: a camera without a depth sensor, in a room that others scan. */
  depth?: DepthImage | null;
  /**
   * Exposure time times gain of the colour image, in any unit that is constant during the session; null: unknown.
   *
   * An invalid value (not finite, not above 0) is reported in the answer's notes and treated as null.
   */
  exposure?: number | null;
}

/** A place that the server finds in what it sees, in the next frame that shows it. */
export interface Spot {
  /**
   * `pixel`: the surface seen in a pixel; `ray`: the scanned surface that a ray meets first; `floor`; `table`: the
   * largest horizontal surface in view off the floor; `auto`: on a table, else the floor, at a size that fits there.
   */
  on: "auto" | "floor" | "pixel" | "ray" | "table";
  /** u, v of the rectified picture; only with `pixel`. */
  pixel?: [number, number] | null;
  /** The frame of `pixel`, which is still to be sent; null: the next one. */
  frame?: number | null;
  /** World; only with `ray`, like the next field. */
  origin_m?: [number, number, number] | null;
  /** World, of any length. */
  direction?: [number, number, number] | null;
}

/** Place a virtual object; acknowledged. With `spot`, the answer to the frame in which it is found tells where. */
export interface PlaceObject {
  type: "place_object";
  /** Number by which the request is answered, used once in a session. */
  request: number;
  /** Its name; an object that has it is replaced. */
  object: string;
  /** Of the file. */
  format: "glb" | "obj" | "ply" | "stl";
  /** The bytes of the file. */
  data: Uint8Array;
  /**
   * World position of the bottom centre of the model's box; null, without `spot`: the vertices are world coordinates
   * already.
   */
  position_m?: [number, number, number] | null;
  /** Not used on an `auto` spot. */
  scale?: number;
  /** Turn about the up axis. */
  yaw_deg?: number;
  /** In place of `position_m`. */
  spot?: Spot | null;
  /** Height of the placed model, in place of `scale`. */
  height_m?: number | null;
}

/** Move an existing object; acknowledged. */
export interface MoveObject {
  type: "move_object";
  /** Number by which the request is answered, used once in a session. */
  request: number;
  /** Name of the object. */
  object: string;
  /** World position of the bottom centre of the model's box. */
  position_m: [number, number, number];
  /** Factor on the model's size. */
  scale?: number;
  /** Turn about the up axis. */
  yaw_deg?: number;
}

/** Remove an object; acknowledged. */
export interface RemoveObject {
  type: "remove_object";
  /** Number by which the request is answered, used once in a session. */
  request: number;
  /** Name of the object. */
  object: string;
}

/** Change the preset of the running session, or the budget or error limit that chooses it; acknowledged. */
export interface Quality {
  type: "quality";
  /** Number by which the request is answered, used once in a session. */
  request: number;
  /** As in `wishes`. */
  preset: "art1" | "art4" | "art8" | "auto" | "gr15" | "gr15fast" | "reg4" | "reg8" | "rm";
  /** As in `wishes`. */
  budget_ms?: number | null;
  /** As in `wishes`. */
  max_light_error_deg?: number | null;
}

/** Request the scanned surface as mesh files; answered by mesh parts and then acknowledged. */
export interface RequestMesh {
  type: "request_mesh";
  /** Number by which the request is answered, used once in a session. */
  request: number;
}

/** Request the light that arrives at a place as a lat-long picture; answered by a panorama and then acknowledged. */
export interface RequestPanorama {
  type: "request_panorama";
  /** Number by which the request is answered, used once in a session. */
  request: number;
  /** Of the file that is sent back. */
  format: "exr" | "hdr";
  /** World. null: the middle of the first virtual object, or of what the last frame sees if there is none. */
  position_m?: [number, number, number] | null;
}

/** Either side is leaving, with the reason. */
export interface Bye {
  type: "bye";
  /** One line for a person; may be empty. */
  reason?: string;
}

/** Answer to hello and watch. */
export interface Welcome {
  type: "welcome";
  /** Name of the session; `waiting` for a watcher while nobody streams. */
  session: string;
  /** Name and version of the server. */
  server: string;
  /** Name of the device that computes. */
  device: string;
  /** Number of frames that the client may have unanswered; at most as many as it asked for. */
  max_inflight: number;
  /** Secret key to resume the session (`hello.resume`), if the client set `keep_s`. */
  key: string | null;
  /**
   * True after a resume. What was sent over earlier connections is not answered any more; requests, and in a lossless
   * session frames, are answered if they are sent again.
   */
  resumed: boolean;
  /** The room that the session is in; null: one of its own. */
  room: string | null;
  /** Colour codecs that frames may use. */
  codecs: Array<"h264" | "jpeg" | "png" | "raw">;
  /** Depth codecs that frames may use. */
  depth_codecs: Array<"raw" | "zdelta" | "zranks" | "zstd-delta" | "zstd-ranks">;
  /** To a watcher: the lens of the session that it watches, by which it can point at places in the pictures. */
  camera: CameraModel | null;
}

/**
 * What a frame cost: milliseconds under the thesis's row names (table 6.2), which add up to the total, and counts.
 *
 * While a kernel runs, time counts under the row that launched it, else under the row that the host is at.
 */
export interface Timings {
  /** Milliseconds: colour to radiance, depth to points and normals. */
  input: number;
  /** Milliseconds: tracking and fusion into the volume. */
  reconstruct: number;
  /** Milliseconds: ray cast of the volume. */
  surface: number;
  /** Milliseconds: merging the volume with this frame's depth. */
  dynamic_geometry: number;
  /** Milliseconds: visibility and bounced light. */
  radiance_transfer: number;
  /** Milliseconds. */
  light_estimation: number;
  /** Milliseconds: effects and composite. */
  rendering: number;
  /** Wall time. */
  total: number;
  /** Milliseconds of `total` in which no kernel ran: the host's own work. The rows contain it. */
  host: number;
  /** Kernels launched; one that is cut into slices counts once. */
  launches: number;
  /** Times that the host waited for memory of the device. */
  reads: number;
  /** Bytes of those reads. */
  read_bytes: number;
  /** Copies of memory to, from and on the device, waited for or not. */
  copies: number;
}

/** An effect that did not run, the reason, and a bound on the change, in display units (1 is 1/255). */
export interface LeftOut {
  /** Its name. */
  effect: string;
  /** Why it was not needed, in words. */
  reason: string;
  /**
   * In display units; null: no bound is known. Where the reason says that it was measured, it leaves out a thousandth
   * of the pixels.
   */
  error_bound: number | null;
}

/** How a frame was sampled, and why. */
export interface OperatingPoint {
  /** The settings, written as options of the command line. */
  settings: string;
  /** Why these settings, in words. */
  reason: string;
  /** Expected time of a frame; like the next field, only for points that the server chose. */
  expected_ms: number | null;
  /** Error of the dominant direction that was measured on the device. */
  light_error_deg: number | null;
}

/** Effects that ran for a frame, in order, those that were left out, and how the frame was sampled. */
export interface Plan {
  /** Names of the effects, in order. */
  run: Array<string>;
  /** What did not run. */
  left_out: Array<LeftOut>;
  /** null if tracking is lost: nothing was sampled. */
  point: OperatingPoint | null;
}

/** Where an object stands whose spot was found; the fields of `place_object` and `move_object`. */
export interface PlacedObject {
  /** Its name. */
  object: string;
  /** World position of the bottom centre of the model's box. */
  position_m: [number, number, number];
  /** Factor on the model's size. */
  scale: number;
  /** Turn about the up axis. */
  yaw_deg: number;
}

/** The composite image of one frame. */
export interface Composite {
  type: "composite";
  /** The frame it belongs to. */
  frame: number;
  /** That of the frame. */
  timestamp_s: number;
  /** Pose that was used; the last one while tracking is lost. */
  world_from_camera: Array<number>;
  /** Where the pose is from; `lost`: none was found. */
  tracking: "given" | "lost" | "tracked";
  /** What the frame cost. */
  timings: Timings;
  /** Which effects ran. */
  plan: Plan;
  /** Problems with this frame's input, one line each. */
  notes: Array<string>;
  /** Time from the frame's arrival until its processing began: in the queue, decoding, waiting for the device. */
  waited_ms: number;
  /** Objects whose spots were found in this frame. */
  placed: Array<PlacedObject>;
  /** sRGB picture of the camera's size. */
  color: ColorImage;
}

/** A rectangle of the camera's image with the depth of each pixel. */
export interface LayerPatch {
  /** Column of the camera's image at which the rectangle begins. */
  x: number;
  /** Row of the camera's image at which the rectangle begins. */
  y: number;
  /** PNG. */
  color: ColorImage;
  /** Same size, along the camera's z; 0: the pixel is empty. */
  depth: DepthImage;
}

/**
 * Virtual content of one frame (`wishes.answer`), to be composed with a camera image p of this or a later frame.
 *
 * All linear: picture = coverage * virtual + (1 - coverage) * ratio * p (thesis 7.2.1).
 */
export interface Layer {
  type: "layer";
  /** The frame it belongs to. */
  frame: number;
  /** That of the frame. */
  timestamp_s: number;
  /** Pose that was used; the last one while tracking is lost. */
  world_from_camera: Array<number>;
  /** Where the pose is from; `lost`: none was found. */
  tracking: "given" | "lost" | "tracked";
  /** What the frame cost. */
  timings: Timings;
  /** Which effects ran. */
  plan: Plan;
  /** Problems with this frame's input, one line each. */
  notes: Array<string>;
  /** Time from the frame's arrival until its processing began: in the queue, decoding, waiting for the device. */
  waited_ms: number;
  /** Objects whose spots were found in this frame. */
  placed: Array<PlacedObject>;
  /**
   * Four channels: sRGB, not premultiplied, and coverage (255: the whole pixel).
   *
   * null: no virtual object is visible.
   */
  virtual: LayerPatch | null;
  /**
   * Three channels: 128 times the square root of the factor on real surfaces.
   *
   * null: real surfaces are unchanged.
   */
  ratio: LayerPatch | null;
  /** Metres per unit of depth. */
  depth_scale_m: number;
}

/** One directional component of the room's light, in addition to uniform light. */
export interface DirectedLight {
  /** World, unit, towards the light. */
  direction: [number, number, number];
  /** Radiance of a white surface that faces it and receives no other light. */
  irradiance: [number, number, number];
  /** Standard deviation along either axis; 0 for light from one direction. */
  spread_deg: number;
}

/** A light inside the room that emits equally in all directions. */
export interface Lamp {
  /** World. */
  position_m: [number, number, number];
  /** One standard deviation along each world axis. */
  position_std_m: [number, number, number];
  /**
   * Radiant intensity in units of radiance times m^2. At a distance of d metres it adds intensity / (pi d^2) to the
   * radiance of a white surface that faces it.
   */
  intensity: [number, number, number];
  /** One standard deviation. */
  intensity_std: [number, number, number];
  /** Share of the luminance that visible surfaces receive. */
  share: number;
}

/** The light that arrives at a place: from scanned surface where a direction meets it, from beyond it elsewhere. */
export interface ArrivingLight {
  /** `view`: the middle of what the frame sees; `place`: of `wishes.light_at`; `object`: the middle of its box. */
  of: "object" | "place" | "view";
  /** Among the `light_at` or the objects, in their order; 0 for the view. */
  index: number;
  /** World, metres. */
  position: [number, number, number];
  /** This and the fields below as in `light`; 16 x [r, g, b]. */
  sh: Array<[number, number, number]>;
  /** 16 x [r, g, b]. */
  sh_std: Array<[number | null, number | null, number | null]>;
  /** 27 floats. */
  sh_webxr: Array<number>;
  /** World, unit, towards the light. */
  dominant_direction: [number, number, number];
  /** As in `light`. */
  dominant_intensity: number;
  /** As in `light`. */
  spread_deg: number | null;
  /** As in `light`. */
  valid: boolean;
  /** Share of the directions from here in which photographed surface is met, 0 to 1; null where unknown. */
  seen: number | null;
  /** With `of: object`: the object's name. */
  object: string | null;
}

/** The estimate of the room's light after one frame; the fields of a line of `light.jsonl`. */
export interface Light {
  type: "light";
  /** The frame it belongs to. */
  frame: number;
  /** That of the frame. */
  timestamp_s: number;
  /** 16 x [r, g, b], zeros for bands not estimated. */
  sh: Array<[number, number, number]>;
  /** All coefficients, when there are more than 16. */
  sh_all: Array<[number, number, number]> | null;
  /** One standard deviation of each of `sh`; null where unknown. */
  sh_std: Array<[number | null, number | null, number | null]>;
  /** 27 floats, RGB-interleaved C00 C1-1 C10 C11 ..., in axes with up as +y and the first camera's view near -z. */
  sh_webxr: Array<number>;
  /** World, unit, towards the light, from l = 1 of Rec. 709 luminance; (0, 0, 0) if there is none. */
  dominant_direction: [number, number, number];
  /** Luminance of the light from there, as one direction. */
  dominant_intensity: number;
  /** Directional components, strongest first; empty if the light is uniform. */
  dominant_lights: Array<DirectedLight>;
  /** Lights inside the room, strongest first; not included in `sh`. */
  lamps: Array<Lamp>;
  /**
   * Exposure of this frame relative to the session's first. All radiance here is in units of this frame's image.
   * Divided by `exposure` it is in units of the first image, and constant under constant light.
   */
  exposure: number;
  /** World, unit: the up direction, along which objects stand. */
  up: [number, number, number] | null;
  /** Condition number of the unregularised normal equations; null if infinite. */
  condition: number | null;
  /** Whether the dominant direction is known: `spread_deg` is at most 25; where it is null, as the estimator says. */
  valid: boolean;
  /** Angle in degrees that 90 % of the possible dominant directions are within; null where unknown. */
  spread_deg: number | null;
  /**
   * World, metres: the middle of what the frame sees, from where `sh` is meant; it stays until that has moved by a
   * twentieth of its distance from the camera. Null until a frame was placed.
   */
  position: [number, number, number] | null;
  /** Light arriving at places: the view, then `wishes.light_at` in their order, then objects in theirs. */
  at: Array<ArrivingLight>;
}

/** The frame was replaced by a newer one before it was read, or was refused. It gets no other answer. */
export interface Dropped {
  type: "dropped";
  /** Number of the frame. */
  frame: number;
  /** One line for a person. */
  reason: string;
}

/**
 * Part of a mesh file. The parts of a file come in order, one file after the other.
 *
 * PLY: world axes, metres. GLB: a node rotates the world to glTF's axes, +y up. Vertex colours are sRGB.
 */
export interface MeshPart {
  type: "mesh_part";
  /** Number of the request. */
  request: number;
  /** Of the file. */
  format: "glb" | "ply";
  /** Size of the whole file. */
  size_bytes: number;
  /** Offset of this part in the file. */
  offset: number;
  /** The bytes of this part. */
  data: Uint8Array;
}

/**
 * The light that arrives at a place as a lat-long picture of linear radiance, in units of the last frame's image.
 *
 * The top row looks up; the middle column looks along the first camera's view, columns go on to the right.
 */
export interface Panorama {
  type: "panorama";
  /** Number of the request. */
  request: number;
  /** Of the file. */
  format: "exr" | "hdr";
  /** World: where it was made for. */
  position_m: [number, number, number];
  /** The file: Radiance `hdr` or OpenEXR `exr`. */
  data: Uint8Array;
}

/**
 * A control message was applied, or refused with `error`.
 *
 * An `error` that begins with "not saved: ": applied, and lost if the server is killed before it can write its disk.
 */
export interface Acknowledged {
  type: "acknowledged";
  /** Number of the request. */
  request: number;
  /** Why the request was refused; null: it was applied. */
  error: string | null;
  /** What a person should know, one line each. */
  notes: Array<string>;
}

/** The client sent something invalid; `fatal` if the server closes the connection. */
export interface Error {
  type: "error";
  /** One line that names the field or rule and what was wrong. */
  reason: string;
  /** True: the connection is closed next. */
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
  | RequestPanorama
  | Bye;

export type ServerMessage =
  | Welcome
  | Composite
  | Layer
  | Light
  | Dropped
  | MeshPart
  | Panorama
  | Acknowledged
  | Error
  | Bye;

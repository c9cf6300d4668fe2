"""Every message of the wire, as frozen typed structs: one tagged union per direction.

MessagePack maps, tag field `type`. Matrices are row-major lists of 16 floats named `world_from_*`, metres.
SH are radiance coefficients in the real orthonormal basis without Condon-Shortley phase, index l(l+1)+m, world axes.
A struct that decodes is valid: numbers are finite, sizes are within `protocol.limits`.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from msgspec import Meta, Struct

from protocol.frames import CameraModel, ColorEncoding, check_rigid
from protocol.limits import (
    MAX_IMAGE_PIXELS,
    MAX_IMAGE_SIDE_PX,
    MAX_MESH_BYTES,
    MAX_MESH_PART_BYTES,
    MAX_MESSAGE_BYTES,
    MAX_NAME_CHARS,
    MAX_REASON_CHARS,
    MAX_SCENE_MESH_BYTES,
    MAX_SH_BANDS,
)

Side = Annotated[int, Meta(ge=1, le=MAX_IMAGE_SIDE_PX)]
Name = Annotated[str, Meta(min_length=1, max_length=MAX_NAME_CHARS)]
Key = Annotated[str, Meta(min_length=1, max_length=MAX_NAME_CHARS)]
Reason = Annotated[str, Meta(max_length=MAX_REASON_CHARS)]
Bytes = Annotated[bytes, Meta(max_length=MAX_MESSAGE_BYTES)]
Index = Annotated[int, Meta(ge=0, le=2**53)]
Matrix4 = Annotated[tuple[float, ...], Meta(min_length=16, max_length=16, description="row-major 4x4, metres")]
Vector3 = tuple[float, float, float]
Rgb = tuple[float, float, float]
RgbOrNull = tuple[float | None, float | None, float | None]

Preset = Literal["rm", "reg4", "reg8", "art1", "art4", "art8", "gr15", "gr15fast", "auto"]
Robustness = Literal["openness", "normals", "normals_printed", "memory", "outliers"]
Poses = Literal["given", "track", "refine"]
Dictionary = Literal["4x4_50", "5x5_100", "6x6_250", "7x7_1000", "apriltag_36h11"]
Tracking = Literal["given", "tracked", "lost"]
MeshFormat = Literal["ply", "glb"]
ColorCodec = Literal["jpeg", "png", "raw", "h264"]
DepthCodec = Literal["raw", "zdelta", "zranks", "zstd-delta", "zstd-ranks"]


def _require_auto(where: str, preset: str, *chosen_by: float | None) -> None:
    if preset != "auto" and any(value is not None for value in chosen_by):
        raise ValueError(f"{where}: a budget or a greatest light error chooses the preset: it must be auto")


def _require_finite(owner: str, **fields: object) -> None:
    """Raise ValueError naming the field if any number in it is NaN or infinite."""
    for name, value in fields.items():
        numbers = value if isinstance(value, tuple) else (value,)
        if any(isinstance(number, float) and not math.isfinite(number) for number in numbers):
            raise ValueError(f"{owner}.{name} must be finite")


class Payload(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An encoded picture: declared size first, so that it is checked before the bytes are touched."""

    width: Side
    height: Side
    data: Bytes

    def __post_init__(self) -> None:
        if self.width * self.height > MAX_IMAGE_PIXELS:
            raise ValueError(f"picture of {self.width}x{self.height} exceeds {MAX_IMAGE_PIXELS} pixels")


class ColorImage(Payload, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Colour: `jpeg` and `png` are sRGB 8-bit; `raw` is interleaved RGB, little endian, in `encoding`.

    `h264`, of frames only and where `welcome.codecs` has it: the next picture of a session's video.
    """

    codec: ColorCodec
    encoding: ColorEncoding = "srgb8"


class DepthImage(Payload, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """uint16 depth, lossless.

    `zdelta` and `zstd-delta`: horizontal delta, zigzag, byte planes, then raw deflate / zstd.
    `zranks` and `zstd-ranks`: the same of the values' ranks, two in a byte.
    """

    codec: DepthCodec
    rounded_per_m: Annotated[float, Meta(gt=0, le=1)] | None = None
    """What the sender changed before: each depth z (metres) by at most this times z^2; None: nothing."""


BudgetMs = Annotated[float, Meta(gt=0, le=60000)]
LightErrorDeg = Annotated[float, Meta(gt=0, le=180)]


class Wishes(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a capturing client asks of its session; the command line's options of the same names."""

    preset: Preset = "reg4"
    """`auto`: the server chooses where and how transfer is sampled, and the rays, from what its device was measured to
    take and to err (`probeless tune`)."""
    budget_ms: BudgetMs | None = None
    """Of `auto`: a frame shall take no longer."""
    max_light_error_deg: LightErrorDeg | None = None
    """Of `auto`: the fastest point whose dominant direction errs by no more, where the device was measured."""
    rays: Annotated[int, Meta(ge=4, le=1024)] = 81
    stride: Annotated[int, Meta(ge=1, le=16)] | None = None
    """A1: every how many pixels transfer is sampled; None, as of the four below: what the preset says."""
    interleave: Literal[1, 2, 4, 8] | None = None
    """A3, A4: a frame traces one of so many subsets of the directions; of presets that trace rays."""
    upsampling: Literal["bilateral", "bicubic"] | None = None
    """A5."""
    visibility_state: bool | None = None
    """A6: no rays where the volume is known to be open; of presets that trace rays."""
    auxiliary_views: Annotated[int, Meta(ge=16, le=4096)] | None = None
    """R5, A7: depth pictures from all around that visibility is looked up in; of GR15 and GR15FAST."""
    smooth_depth: bool = True
    """G3: D''', the median of the merged depth; without it, D'' is the last."""
    ray_length_m: Annotated[float, Meta(ge=0, le=1000)] | None = None
    """None: the whole room."""
    bands: Annotated[int, Meta(ge=2, le=MAX_SH_BANDS)] = 4
    albedo: Literal["constant", "estimated"] = "constant"
    indirect: Literal["none", "observed"] = "none"
    as_thesis: bool = False
    denoise: Literal["none", "bilateral", "tv_l1"] = "none"
    """Of the lightness that the light is estimated from; the composite keeps the camera's picture."""
    denoise_iterations: Annotated[int, Meta(ge=1, le=1000)] = 20
    """Of TV-L1."""
    poses: Poses = "given"
    volume_m: tuple[float, float, float, float, float, float] | None = None
    """x0, y0, z0, x1, y1, z1 in world metres; None: what the first frame sees."""
    voxel_m: Annotated[float, Meta(gt=0, le=1)] | None = None
    up: Vector3 | None = None
    """World direction; None: the first camera's -y."""
    light: tuple[Rgb, ...] | None = None
    """Radiance SH to render with instead of an estimate: 1, 4, 9 ... coefficients; None: estimate one."""
    light_axes: Literal["world", "webxr"] = "world"
    """Of `light`; `webxr`: up as +y and the first camera's view near -z."""
    lamps: Literal["auto", "on", "off"] = "auto"
    """Whether lights inside the room are looked for; `auto`: where distant light does not explain what is seen."""
    exposure: Literal["auto", "constant"] = "auto"
    """`auto`: of each frame as it says, estimated where it does not say; `constant`: the same for all frames."""
    edges: Literal["smooth", "hard"] = "smooth"
    """Of virtual things: by how much of a pixel they cover, or by its middle, as in pictures that are point samples."""
    tone_mapping: Literal["auto", "light", "average"] = "auto"
    """What virtual things' brightness rests on: the light's scale, or the averages of the picture and of its shading;
    `auto`: the scale of a light that is given, the averages under one that is estimated."""
    light_color: Literal["estimated", "white"] = "estimated"
    """`white`: as the thesis assumes, the light's luminance without its colours."""
    robustness: tuple[Robustness, ...] = ("openness", "memory", "outliers")
    """Measures that light estimation takes (thesis 5.2, 5.4): samples that see little sky are left out; weights by how
    common a normal is (`normals_printed`: as eq. 5.7 has them); earlier frames count; what fits badly counts less."""
    plan: Literal["needed", "everything"] = "needed"
    """`everything`: what would hardly be seen is simulated too, to check the bounds of leaving it out."""
    answer: Literal["picture", "layer", "light"] = "picture"
    """`layer`: what is virtual comes apart from the camera's picture, for clients that put it over their newest one;
    `light`: a frame is answered by its light alone, for clients that draw virtual things themselves."""
    lossless: bool = False
    """Answers carry PNG pictures, and every frame is answered in order instead of latest-wins."""

    def __post_init__(self) -> None:
        _require_finite(
            "wishes", ray_length_m=self.ray_length_m, volume_m=self.volume_m, voxel_m=self.voxel_m, up=self.up
        )
        _require_auto("wishes", self.preset, self.budget_ms, self.max_light_error_deg)
        if self.volume_m is not None and not all(self.volume_m[a] < self.volume_m[a + 3] for a in range(3)):
            raise ValueError("wishes.volume_m must be x0,y0,z0,x1,y1,z1 with each x0 < x1")
        if self.up is not None and math.hypot(*self.up) < 1e-6:
            raise ValueError("wishes.up must not be zero")
        if self.light is not None:
            _require_finite("wishes", light=tuple(value for row in self.light for value in row))
            if len(self.light) not in [bands * bands for bands in range(1, MAX_SH_BANDS + 1)]:
                raise ValueError(f"wishes.light must have 1, 4, 9 ... {MAX_SH_BANDS**2} coefficients")


class Message(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="type"):
    """Base of everything on the socket."""


# ---- client to server --------------------------------------------------------------------------------------------


class Marker(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A square fiducial marker that all clients of a room may see."""

    id: Annotated[int, Meta(ge=0, le=999)]
    side_m: Annotated[float, Meta(gt=0.005, le=5)]
    """Of the black square."""
    dictionary: Dictionary = "4x4_50"


class Hello(Message, frozen=True, kw_only=True, omit_defaults=True, tag="hello"):
    """First message of a client that captures."""

    client: Name
    camera: CameraModel
    wishes: Wishes = Wishes()
    room: Name | None = None
    """Clients of one room share volume, light and objects; None: a room of its own."""
    room_key: Key | None = None
    """Of the room: who opens it sets it, the others have to know it."""
    room_from_world: Matrix4 | None = None
    """Where this client's world lies in the room's, which is that of the client that came first; rigid.

    None: not known, to be found by `marker`, else by what the room has seen."""
    marker: Marker | None = None
    """By which the client's world is laid on the room's, once both have seen it."""
    keep_s: Annotated[float, Meta(ge=0, le=300)] = 0.0
    """How long the session waits for this client when its connection is lost without a bye; 0: it ends with it."""
    resume: Name | None = None
    """`welcome.key` of a session that waits: it goes on as it was, and nothing else of this message counts."""

    def __post_init__(self) -> None:
        if self.room_from_world is not None:
            check_rigid("hello.room_from_world", self.room_from_world)
        if self.room is None and (self.room_from_world, self.marker, self.room_key) != (None, None, None):
            raise ValueError("hello.room_key, room_from_world and marker are of a room: name it in hello.room")


class Watch(Message, frozen=True, kw_only=True, omit_defaults=True, tag="watch"):
    """First message of a client that only looks: it receives what the capturing session produces."""

    session: Name | None = None
    """None: the session that is streaming, now or next."""
    room: Name | None = None
    """Of `session: None`: only those of this room."""
    room_key: Key | None = None
    """Without it, nothing is seen of rooms that have one."""


class Frame(Message, frozen=True, kw_only=True, omit_defaults=True, tag="frame"):
    """One RGB-D frame; answered by exactly one of composite or layer (with its light before it), dropped or error."""

    frame: Index
    timestamp_s: float
    world_from_camera: Matrix4 | None
    color: ColorImage | None = None
    """None, with a pose and no depth: of somebody who only looks at a room that others scan."""
    depth: DepthImage | None = None
    """None: of a camera without a depth sensor, in a room that others scan."""
    exposure: float | None = None
    """Exposure time times gain of the colour picture, in any unit that stays the same for the session; None: unknown.

    What cannot be one (not finite, not above 0) is told in the composite's notes and taken as None.
    """

    def __post_init__(self) -> None:
        _require_finite("frame", timestamp_s=self.timestamp_s, world_from_camera=self.world_from_camera)
        if self.color is None and (self.depth is not None or self.world_from_camera is None):
            raise ValueError("frame.color may be left out only where there is a pose and no depth")


class PlaceObject(Message, frozen=True, kw_only=True, tag="place_object"):
    """Put a virtual object into the session; acknowledged."""

    request: Index
    object: Name
    format: Literal["glb", "obj", "ply", "stl"]
    data: Annotated[bytes, Meta(max_length=MAX_MESH_BYTES)]
    position_m: Vector3 | None = None
    """World position of the bottom centre of the model's box; None: the vertices are world coordinates already."""
    scale: Annotated[float, Meta(gt=0, le=1000)] = 1.0
    yaw_deg: float = 0.0

    def __post_init__(self) -> None:
        _require_finite("place_object", position_m=self.position_m, scale=self.scale, yaw_deg=self.yaw_deg)


class MoveObject(Message, frozen=True, kw_only=True, tag="move_object"):
    """Move an object that is there; acknowledged."""

    request: Index
    object: Name
    position_m: Vector3
    scale: Annotated[float, Meta(gt=0, le=1000)] = 1.0
    yaw_deg: float = 0.0

    def __post_init__(self) -> None:
        _require_finite("move_object", position_m=self.position_m, scale=self.scale, yaw_deg=self.yaw_deg)


class RemoveObject(Message, frozen=True, kw_only=True, tag="remove_object"):
    """Take an object away; acknowledged."""

    request: Index
    object: Name


class Quality(Message, frozen=True, kw_only=True, tag="quality"):
    """Change the preset of the running session, or the budget by which it is chosen; acknowledged."""

    request: Index
    preset: Preset
    budget_ms: BudgetMs | None = None
    max_light_error_deg: LightErrorDeg | None = None

    def __post_init__(self) -> None:
        _require_auto("quality", self.preset, self.budget_ms, self.max_light_error_deg)


class RequestMesh(Message, frozen=True, kw_only=True, tag="request_mesh"):
    """Ask for the surface fused so far, as files; answered by the parts of each and then acknowledged."""

    request: Index


class Bye(Message, frozen=True, kw_only=True, tag="bye"):
    """Either side says it is leaving, and why."""

    reason: Reason = ""


# ---- server to client --------------------------------------------------------------------------------------------


class Welcome(Message, frozen=True, kw_only=True, omit_defaults=True, tag="welcome"):
    """Answer to hello and watch."""

    session: Name
    server: Name
    device: str
    max_inflight: int
    """Frames the client may have unanswered."""
    key: str | None = None
    """By which the session is resumed (`hello.resume`), where the client asked for it to be kept. A secret."""
    resumed: bool = False
    """Frames that were sent before are not answered any more, unless the session is lossless; requests are, if they
    are sent again."""
    room: Name | None = None
    codecs: tuple[ColorCodec, ...] = ("jpeg", "png", "raw")
    """That frames' colour may have."""
    depth_codecs: tuple[DepthCodec, ...] = ("raw", "zdelta", "zstd-delta")
    """That their depth may have."""


class LeftOut(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An effect that did not run, why, and what leaving it out can change at most, in display units (1 is 1/255)."""

    effect: str
    reason: str
    error_bound: float | None


class OperatingPoint(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where and how finely a frame was sampled, and why."""

    settings: str
    """As options of the command line."""
    reason: str
    expected_ms: float | None = None
    """What a frame was expected to take; of points that were chosen, like the next."""
    light_error_deg: float | None = None
    """Error of the dominant direction where the device was measured."""


class Plan(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which effects ran for a frame, in order, which did not, and how finely it was sampled."""

    run: tuple[str, ...]
    left_out: tuple[LeftOut, ...]
    point: OperatingPoint | None = None
    """None: a camera that is lost samples nothing."""


class Timings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Milliseconds under the thesis's row names (table 6.2): device plus host time; total is wall time."""

    input: float = 0.0
    reconstruct: float = 0.0
    surface: float = 0.0
    dynamic_geometry: float = 0.0
    radiance_transfer: float = 0.0
    light_estimation: float = 0.0
    rendering: float = 0.0
    total: float = 0.0


class DirectedLight(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One of the lights that the room's light is made of, besides an even sky."""

    direction: Vector3
    """World, unit, towards the light."""
    irradiance: Rgb
    """Radiance of a white surface that faces it, lit by it alone."""
    spread_deg: float
    """Standard deviation along either axis; 0 for light from one direction."""


class Lamp(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A light inside the room that shines evenly all around."""

    position_m: Vector3
    """World."""
    position_std_m: Vector3
    """One standard deviation along the world's axes."""
    intensity: Rgb
    """Radiant intensity: radiance of the light's units times m^2; d metres away it adds intensity / (pi d^2) to a white
    surface that faces it."""
    intensity_std: Rgb
    share: float
    """Of the light (luminance) that the surfaces seen receive."""


class Light(Message, frozen=True, kw_only=True, tag="light"):
    """The room's light as one frame left it; the fields of a line of `light.jsonl`."""

    frame: Index
    timestamp_s: float
    sh: tuple[Rgb, ...]
    """16 x [r, g, b], zeros for bands not estimated."""
    sh_all: tuple[Rgb, ...] | None = None
    """All coefficients, when there are more than 16."""
    sh_std: tuple[RgbOrNull, ...]
    """One standard deviation of each of `sh`; null where unknown."""
    sh_webxr: tuple[float, ...]
    """27 floats, RGB-interleaved C00 C1-1 C10 C11 ..., in axes with up as +y and the first camera's view near -z."""
    dominant_direction: Vector3
    """World, unit, towards the light, from l = 1 of Rec. 709 luminance; (0, 0, 0) where there is none."""
    dominant_intensity: float
    dominant_lights: tuple[DirectedLight, ...] = ()
    """Each of the lights, strongest first, where there is more than an even sky."""
    lamps: tuple[Lamp, ...] = ()
    """Lights inside the room, strongest first; their light is not part of `sh`."""
    exposure: float = 1.0
    """Of this frame relative to the session's first. All radiance here is in units of this frame's picture: over
    `exposure` it is in those of the first one's, which a room under steady light keeps."""
    up: Vector3 | None = None
    """World, unit: along it objects stand, as whoever opened the room asked."""
    condition: float | None
    """Condition number of the unregularised normal equations; null when infinite."""
    valid: bool


class Drawn(Message, frozen=True, kw_only=True):
    """What comes with the picture, or the layer, of one frame."""

    frame: Index
    timestamp_s: float
    world_from_camera: Matrix4
    tracking: Tracking
    timings: Timings
    plan: Plan
    notes: tuple[str, ...] = ()
    """What was wrong with this frame's input, one line each."""
    waited_ms: float = 0.0
    """From when the frame had arrived until the device began with it: unread, decoded, waiting for its turn."""


class Composite(Drawn, frozen=True, kw_only=True, tag="composite"):
    """The finished picture of one frame."""

    color: ColorImage


class LayerPatch(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A part of the camera's picture, and how far away each of its pixels is."""

    x: Annotated[int, Meta(ge=0, lt=MAX_IMAGE_SIDE_PX)]
    """Column of the camera's picture in which the part begins."""
    y: Annotated[int, Meta(ge=0, lt=MAX_IMAGE_SIDE_PX)]
    color: ColorImage
    """PNG."""
    depth: DepthImage
    """Of the same size, along the camera's z; 0: the pixel says nothing."""


class Layer(Drawn, frozen=True, kw_only=True, tag="layer"):
    """What is virtual in one frame (`wishes.answer`), to be put over a camera picture p, of this frame or a later one.

    All linear: picture = coverage * virtual + (1 - coverage) * ratio * p (thesis 7.2.1).
    """

    virtual: LayerPatch | None
    """Colour of four channels: sRGB, not multiplied by coverage, which is the fourth, 255 for all of a pixel.

    None: nothing is seen of it."""
    ratio: LayerPatch | None
    """Colour of three channels: 128 times the root of what real surface is multiplied by.

    None: real surface stays as it is."""
    depth_scale_m: Annotated[float, Meta(gt=0, le=1)]
    """Metres of a unit of depth."""


class Dropped(Message, frozen=True, kw_only=True, tag="dropped"):
    """This frame was replaced by a newer one before it was read, or refused; nothing else comes for it."""

    frame: Index
    reason: Reason


class MeshPart(Message, frozen=True, kw_only=True, tag="mesh_part"):
    """A piece of a file of the scene's mesh; the pieces of a file come in order, one file after the other.

    PLY: world axes, metres. GLB: a node turns the world into glTF's axes, +y up. Vertex colours are sRGB.
    """

    request: Index
    format: MeshFormat
    size_bytes: Annotated[int, Meta(ge=1, le=MAX_SCENE_MESH_BYTES)]
    """Of the whole file."""
    offset: Index
    """Of this piece's first byte in the file."""
    data: Annotated[bytes, Meta(min_length=1, max_length=MAX_MESH_PART_BYTES)]


class Acknowledged(Message, frozen=True, kw_only=True, tag="acknowledged"):
    """A control message was applied, or refused with its error."""

    request: Index
    error: Reason | None = None
    notes: tuple[str, ...] = ()


class Error(Message, frozen=True, kw_only=True, tag="error"):
    """Something the client sent is wrong; `fatal` when the server closes the socket after it."""

    reason: Reason
    fatal: bool


ClientMessage = Hello | Watch | Frame | PlaceObject | MoveObject | RemoveObject | Quality | RequestMesh | Bye
ServerMessage = Welcome | Composite | Layer | Light | Dropped | MeshPart | Acknowledged | Error | Bye

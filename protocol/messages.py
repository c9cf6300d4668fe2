"""All messages of the wire format as frozen typed structs: one tagged union per direction.

MessagePack maps, tag field `type`. Matrices are row-major lists of 16 floats named `world_from_*`, metres.
SH are radiance coefficients in the real orthonormal basis without Condon-Shortley phase, index l(l+1)+m, world axes.
A struct that decodes is valid: numbers are finite, sizes are within `protocol.limits`.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from msgspec import Meta, Struct

from protocol.frames import GREATEST_PLACE_M, CameraModel, ColorEncoding, check_physical, check_rigid
from protocol.limits import (
    FEW_INFLIGHT,
    MAX_IMAGE_PIXELS,
    MAX_IMAGE_SIDE_PX,
    MAX_LIGHT_PLACES,
    MAX_MESH_BYTES,
    MAX_MESH_PART_BYTES,
    MAX_MESSAGE_BYTES,
    MAX_NAME_CHARS,
    MAX_PANORAMA_BYTES,
    MAX_REASON_CHARS,
    MAX_SCENE_MESH_BYTES,
    MAX_SH_BANDS,
    MOST_INFLIGHT,
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
PanoramaFormat = Literal["hdr", "exr"]
LightPlace = Literal["view", "place", "object"]
SpotKind = Literal["pixel", "ray", "floor", "table", "auto"]
ObjectFormat = Literal["glb", "obj", "ply", "stl"]
ColorCodec = Literal["jpeg", "png", "raw", "h264"]
DepthCodec = Literal["raw", "zdelta", "zranks", "zstd-delta", "zstd-ranks"]


LEAST_VOLUME_M = 0.01
"""Side of a volume: a voxel or more."""
GREATEST_LIGHT = 1e6
"""Greatest coefficient of a given light; a picture's radiance is at most 1."""
GREATEST_TURN_DEG = 36_000.0
"""Hundred turns: beyond, float32 has no tenth of a degree."""
GREATEST_TIMESTAMP_S = 1e15
"""Beyond it a float64 has no millisecond."""


def _require_auto(where: str, preset: str, *chosen_by: float | None) -> None:
    if preset != "auto" and any(value is not None for value in chosen_by):
        raise ValueError(f"{where}: a budget or a greatest light error chooses the preset: it must be auto")


def _require_finite(owner: str, **fields: object) -> None:
    """Raise ValueError naming the field if any number in it is NaN or infinite."""
    for name, value in fields.items():
        numbers = value if isinstance(value, tuple) else (value,)
        if any(isinstance(number, float) and not math.isfinite(number) for number in numbers):
            raise ValueError(f"{owner}.{name} must be finite")


def _require_near(owner: str, **places: tuple[float, ...] | None) -> None:
    """Raise ValueError naming the field if a coordinate is not finite or is farther than GREATEST_PLACE_M."""
    _require_finite(owner, **places)
    for name, place in places.items():
        farthest_m = max(map(abs, place), default=0.0) if place else 0.0
        if farthest_m > GREATEST_PLACE_M:
            raise ValueError(
                f"{owner}.{name} has {farthest_m:g} m, at most {GREATEST_PLACE_M:g} m: is it in millimetres?"
            )


def _require_direction(name: str, direction: Vector3 | None) -> None:
    """Raise ValueError if a direction has no usable length in float32."""
    if direction is None:
        return
    if math.hypot(*direction) < 1e-6:
        raise ValueError(f"{name} must not be zero")
    if math.hypot(*direction) > 1e6:
        raise ValueError(f"{name} is {math.hypot(*direction):g} long, must be at most 1e6: give a unit vector")


def _require_turn(owner: str, yaw_deg: float) -> None:
    _require_finite(owner, yaw_deg=yaw_deg)
    if abs(yaw_deg) > GREATEST_TURN_DEG:
        raise ValueError(f"{owner}.yaw_deg is {yaw_deg:g}, must be within {GREATEST_TURN_DEG:g} degrees")


class Payload(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An encoded image. The declared size comes first, so that it is checked before the data is decoded."""

    width: Side
    """Pixels."""
    height: Side
    """Pixels."""
    data: Bytes
    """The encoded picture, as its codec says."""

    def __post_init__(self) -> None:
        if self.width * self.height > MAX_IMAGE_PIXELS:
            raise ValueError(f"picture of {self.width}x{self.height} exceeds {MAX_IMAGE_PIXELS} pixels")


class ColorImage(Payload, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Colour: `jpeg` and `png` are sRGB 8-bit; `raw` is interleaved RGB, little endian, in `encoding`.

    `h264`, in frames only and if listed in `welcome.codecs`: the next picture of the session's video.
    """

    codec: ColorCodec
    """How `data` is encoded."""
    encoding: ColorEncoding = "srgb8"
    """What the numbers are; that of the session's camera."""


class DepthImage(Payload, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """uint16 depth, lossless.

    `zdelta` and `zstd-delta`: horizontal delta, zigzag, byte planes, then raw deflate / zstd.
    `zranks` and `zstd-ranks`: the same for the values' ranks, two in a byte.
    """

    codec: DepthCodec
    """How `data` is encoded."""
    rounded_per_m: Annotated[float, Meta(gt=0, le=1)] | None = None
    """Rounding by the sender: each depth z (metres) was changed by at most this times z^2; None: no rounding."""


BudgetMs = Annotated[float, Meta(gt=0, le=60000)]
LightErrorDeg = Annotated[float, Meta(gt=0, le=180)]


class Wishes(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of a capturing client's session; the command line has options of the same names."""

    preset: Preset = "reg4"
    """`auto`: the server chooses sampling and rays from the times and errors measured on its device (`probeless
    tune`)."""
    budget_ms: BudgetMs | None = None
    """With `auto`: time limit of a frame."""
    max_light_error_deg: LightErrorDeg | None = None
    """With `auto`: choose the fastest point whose error of the dominant direction was measured to be no larger."""
    rays: Annotated[int, Meta(ge=4, le=1024)] = 81
    """Directions that are traced from a place."""
    stride: Annotated[int, Meta(ge=1, le=16)] | None = None
    """A1: distance between transfer samples in pixels. None here and in the next four fields: the preset's value."""
    interleave: Literal[1, 2, 4, 8] | None = None
    """A3, A4: number of subsets of the directions, of which a frame traces one; only for presets that trace rays."""
    upsampling: Literal["bilateral", "bicubic"] | None = None
    """A5."""
    visibility_state: bool | None = None
    """A6: skip rays where the volume is known to be open; only for presets that trace rays."""
    auxiliary_views: Annotated[int, Meta(ge=16, le=4096)] | None = None
    """R5, A7: depth views around the scene in which visibility is looked up; only for GR15 and GR15FAST."""
    smooth_depth: bool = True
    """G3: D''', the median of the merged depth; without it, D'' is the last."""
    ray_length_m: Annotated[float, Meta(ge=0, le=1000)] | None = None
    """None: the whole room."""
    bands: Annotated[int, Meta(ge=2, le=MAX_SH_BANDS)] = 4
    """SH bands of the estimated light: 4 are 16 coefficients."""
    albedo: Literal["constant", "estimated"] = "estimated"
    """Of real surfaces: the same everywhere, or estimated from the pictures."""
    indirect: Literal["none", "observed"] = "observed"
    """Light from one real surface to another: left out, or as photographed."""
    as_thesis: bool = False
    """Plain least squares with rays of 10 cm; one albedo and no indirect light, whatever the fields above say."""
    denoise: Literal["none", "bilateral", "tv_l1"] = "none"
    """Denoising of the lightness used for light estimation; the composite keeps the camera's image."""
    denoise_iterations: Annotated[int, Meta(ge=1, le=1000)] = 20
    """Iterations of TV-L1."""
    poses: Poses = "given"
    """`given`: those of the frames; `track`: the server finds them; `refine`: it corrects those of the frames."""
    volume_m: tuple[float, float, float, float, float, float] | None = None
    """x0, y0, z0, x1, y1, z1 in world metres; None: the view of the first frame."""
    voxel_m: Annotated[float, Meta(ge=1e-4, le=1)] | None = None
    """Side of a cell of the volume; None: from the size of the volume."""
    up: Vector3 | None = None
    """World direction; None: found from the scan, else the first camera's -y, as the notes of the answers say."""
    light: tuple[Rgb, ...] | None = None
    """Radiance SH to render with instead of an estimate: 1, 4, 9 ... coefficients, in units of the first picture, whose
    white is 1 (for other units, as most panoramas have, see `tone_mapping`); None: estimate one."""
    light_axes: Literal["world", "webxr"] = "world"
    """Axes of `light`; `webxr`: up as +y and the first camera's view near -z."""
    light_at: tuple[Vector3, ...] = ()
    """World positions, metres: places at which the arriving light is told in `light.at`, at most MAX_LIGHT_PLACES."""
    lamps: Literal["auto", "on", "off"] = "auto"
    """Whether to search for lights inside the room; `auto`: only where one light is estimated for all places (`albedo`
    constant, no indirect light) and does not explain the image."""
    exposure: Literal["auto", "constant"] = "auto"
    """`auto`: the frame's exposure if given, else estimated; `constant`: the same for all frames."""
    edges: Literal["smooth", "hard"] = "smooth"
    """Edges of virtual objects: by pixel coverage, or by the pixel centre, for images that are point samples."""
    tone_mapping: Literal["auto", "light", "average"] = "auto"
    """Brightness of virtual objects follows the light's scale, or the averages of the image and its shading; `auto`:
    the scale; with `as_thesis`, the averages for an estimated light."""
    light_color: Literal["estimated", "white"] = "estimated"
    """`white`: only the light's luminance, as the thesis assumes."""
    robustness: tuple[Robustness, ...] = ("openness", "memory", "outliers")
    """Robustness measures of light estimation (thesis 5.2, 5.4): `openness` skips samples that see little sky,
    `normals` weights by frequency of normals (`normals_printed`: as in eq. 5.7), `memory` uses earlier frames,
    `outliers` reduces the weight of bad fits."""
    plan: Literal["needed", "everything"] = "needed"
    """`everything`: also run effects whose change would be invisible, to check the bounds of culling."""
    cache: Literal["on", "off"] = "on"
    """`off`: transfer is computed anew in every frame, to compare with what is kept at places of the world."""
    answer: Literal["picture", "layer", "light"] = "picture"
    """`layer`: virtual content separate from the camera's image, for clients that compose it with their newest image.
    `light`: only the light, for clients that render virtual objects themselves."""
    lossless: bool = False
    """Answers use PNG, and every frame is answered in order instead of latest-wins."""

    def __post_init__(self) -> None:
        _require_finite("wishes", ray_length_m=self.ray_length_m, voxel_m=self.voxel_m, up=self.up)
        _require_near("wishes", volume_m=self.volume_m)
        _require_auto("wishes", self.preset, self.budget_ms, self.max_light_error_deg)
        _require_near("wishes", light_at=tuple(value for place in self.light_at for value in place))
        if len(self.light_at) > MAX_LIGHT_PLACES:
            raise ValueError(f"wishes.light_at names {len(self.light_at)} places, at most {MAX_LIGHT_PLACES} are told")
        if self.volume_m is not None and not all(self.volume_m[a] < self.volume_m[a + 3] for a in range(3)):
            raise ValueError("wishes.volume_m must be x0,y0,z0,x1,y1,z1 with each x0 < x1")
        if self.volume_m is not None:
            side_m = min(self.volume_m[axis + 3] - self.volume_m[axis] for axis in range(3))
            if side_m < LEAST_VOLUME_M:
                raise ValueError(f"wishes.volume_m has a side of {side_m:g} m, must be at least {LEAST_VOLUME_M:g} m")
        _require_direction("wishes.up", self.up)
        if self.light is not None:
            _require_finite("wishes", light=tuple(value for row in self.light for value in row))
            brightest = max((abs(value) for row in self.light for value in row), default=0.0)
            if brightest > GREATEST_LIGHT:
                raise ValueError(f"wishes.light has {brightest:g}, must be at most {GREATEST_LIGHT:g}")
            if len(self.light) not in [bands * bands for bands in range(1, MAX_SH_BANDS + 1)]:
                raise ValueError(f"wishes.light must have 1, 4, 9 ... {MAX_SH_BANDS**2} coefficients")


class Message(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="type"):
    """Base of all messages."""


# ---- client to server --------------------------------------------------------------------------------------------


class Marker(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A square fiducial marker that the clients of a room may detect."""

    id: Annotated[int, Meta(ge=0, le=999)]
    """Number of the marker in its dictionary."""
    side_m: Annotated[float, Meta(gt=0.005, le=5)]
    """Side of the black square."""
    dictionary: Dictionary = "4x4_50"
    """OpenCV's name of the set of markers."""


class Hello(Message, frozen=True, kw_only=True, omit_defaults=True, tag="hello"):
    """First message of a capturing client."""

    client: Name
    """Name of the program, for the server's log."""
    camera: CameraModel
    """Lens and size of the pictures that follow."""
    wishes: Wishes = Wishes()
    """Options of the session."""
    room: Name | None = None
    """Clients of one room share volume, light and objects; None: a room of its own."""
    room_key: Key | None = None
    """Key of the room: set by the client that opens it, required from the others."""
    room_from_world: Matrix4 | None = None
    """Rigid transform from this client's world to the room's, which is the world of its first client.

    None: unknown; found by `marker` or by relocalisation in the scanned room."""
    marker: Marker | None = None
    """Marker that aligns the client's world with the room's once it has been detected in both."""
    keep_s: Annotated[float, Meta(ge=0, le=300)] = 0.0
    """How long the session survives a connection that is lost without a bye; 0: not at all."""
    max_inflight: Annotated[int, Meta(ge=1, le=MOST_INFLIGHT)] = FEW_INFLIGHT
    """Frames that the client would have unanswered at most. The default keeps a server busy that is near.

    More are for a client that is far and sends no frame before its turn: who fills a larger window sees older pictures.
    """
    resume: Name | None = None
    """`welcome.key` of a session to resume. It continues unchanged; all other fields of this message are ignored."""

    def __post_init__(self) -> None:
        check_physical(self.camera)
        if self.room_from_world is not None:
            check_rigid("hello.room_from_world", self.room_from_world)
        if self.room is None and (self.room_from_world, self.marker, self.room_key) != (None, None, None):
            raise ValueError("hello.room_key, room_from_world and marker are of a room: name it in hello.room")


class Watch(Message, frozen=True, kw_only=True, omit_defaults=True, tag="watch"):
    """First message of a watching client, which receives the output of a capturing session."""

    session: Name | None = None
    """None: the session that is streaming, or the next one to start."""
    room: Name | None = None
    """With `session: None`: only sessions of this room."""
    room_key: Key | None = None
    """Required to watch a room that has a key."""


class Frame(Message, frozen=True, kw_only=True, omit_defaults=True, tag="frame"):
    """One RGB-D frame; answered by exactly one of composite or layer (with its light before it), dropped or error."""

    frame: Index
    """Number by which the frame is answered; a client counts upwards."""
    timestamp_s: float
    """Seconds of the client's clock, increasing."""
    world_from_camera: Matrix4 | None
    """Pose of the colour camera; None where the server tracks."""
    color: ColorImage | None = None
    """None, with a pose and no depth: the view of a client without a camera, in a room that others scan."""
    depth: DepthImage | None = None
    """None: a camera without a depth sensor, in a room that others scan."""
    exposure: float | None = None
    """Exposure time times gain of the colour image, in any unit that is constant during the session; None: unknown.

    An invalid value (not finite, not above 0) is reported in the answer's notes and treated as None.
    """

    def __post_init__(self) -> None:
        _require_finite("frame", timestamp_s=self.timestamp_s)
        if abs(self.timestamp_s) > GREATEST_TIMESTAMP_S:
            raise ValueError(
                f"frame.timestamp_s is {self.timestamp_s:g}, at most {GREATEST_TIMESTAMP_S:g}: give seconds"
            )
        if self.world_from_camera is not None:
            check_rigid("frame.world_from_camera", self.world_from_camera, GREATEST_PLACE_M)
        if self.color is None and (self.depth is not None or self.world_from_camera is None):
            raise ValueError("frame.color may be left out only where there is a pose and no depth")


class Spot(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """A place that the server finds in what it sees, in the next frame that shows it."""

    on: SpotKind
    """`pixel`: the surface seen in a pixel; `ray`: the scanned surface that a ray meets first; `floor`; `table`: the
    largest horizontal surface in view off the floor; `auto`: on a table, else the floor, at a size that fits there."""
    pixel: tuple[float, float] | None = None
    """u, v of the rectified picture; only with `pixel`."""
    frame: Index | None = None
    """The frame of `pixel`, which is still to be sent; None: the next one."""
    origin_m: Vector3 | None = None
    """World; only with `ray`, like the next field."""
    direction: Vector3 | None = None
    """World, of any length."""

    def __post_init__(self) -> None:
        _require_finite("spot", pixel=self.pixel, direction=self.direction)
        _require_near("spot", origin_m=self.origin_m)
        has_ray = self.origin_m is not None and self.direction is not None
        if (self.pixel is not None) != (self.on == "pixel") or (self.frame is not None and self.on != "pixel"):
            raise ValueError("spot.pixel is needed on a pixel, and it and spot.frame are of no other spot")
        if has_ray != (self.on == "ray") or (self.origin_m is None) != (self.direction is None):
            raise ValueError("spot.origin_m and spot.direction are needed on a ray, and are of no other spot")
        _require_direction("spot.direction", self.direction)


class PlaceObject(Message, frozen=True, kw_only=True, omit_defaults=True, tag="place_object"):
    """Place a virtual object; acknowledged. With `spot`, the answer to the frame in which it is found tells where."""

    request: Index
    """Number by which the request is answered, used once in a session."""
    object: Name
    """Its name; an object that has it is replaced."""
    format: ObjectFormat
    """Of the file."""
    data: Annotated[bytes, Meta(max_length=MAX_MESH_BYTES)]
    """The bytes of the file."""
    position_m: Vector3 | None = None
    """World position of the bottom centre of the model's box; None, without `spot`: the vertices are world coordinates
    already."""
    scale: Annotated[float, Meta(ge=1e-6, le=1000)] = 1.0
    """Not used on an `auto` spot."""
    yaw_deg: float = 0.0
    """Turn about the up axis."""
    spot: Spot | None = None
    """In place of `position_m`."""
    height_m: Annotated[float, Meta(ge=1e-4, le=1000)] | None = None
    """Height of the placed model, in place of `scale`."""

    def __post_init__(self) -> None:
        _require_finite("place_object", scale=self.scale)
        _require_near("place_object", position_m=self.position_m)
        _require_turn("place_object", self.yaw_deg)
        _require_finite("place_object", height_m=self.height_m)
        if self.spot is not None and self.position_m is not None:
            raise ValueError("place_object has a position_m and a spot: leave one out")
        if self.spot is None and self.position_m is None and self.height_m is not None:
            raise ValueError("place_object.height_m needs a position_m or a spot")


class MoveObject(Message, frozen=True, kw_only=True, tag="move_object"):
    """Move an existing object; acknowledged."""

    request: Index
    """Number by which the request is answered, used once in a session."""
    object: Name
    """Name of the object."""
    position_m: Vector3
    """World position of the bottom centre of the model's box."""
    scale: Annotated[float, Meta(ge=1e-6, le=1000)] = 1.0
    """Factor on the model's size."""
    yaw_deg: float = 0.0
    """Turn about the up axis."""

    def __post_init__(self) -> None:
        _require_finite("move_object", scale=self.scale)
        _require_near("move_object", position_m=self.position_m)
        _require_turn("move_object", self.yaw_deg)


class RemoveObject(Message, frozen=True, kw_only=True, tag="remove_object"):
    """Remove an object; acknowledged."""

    request: Index
    """Number by which the request is answered, used once in a session."""
    object: Name
    """Name of the object."""


class Quality(Message, frozen=True, kw_only=True, tag="quality"):
    """Change the preset of the running session, or the budget or error limit that chooses it; acknowledged."""

    request: Index
    """Number by which the request is answered, used once in a session."""
    preset: Preset
    """As in `wishes`."""
    budget_ms: BudgetMs | None = None
    """As in `wishes`."""
    max_light_error_deg: LightErrorDeg | None = None
    """As in `wishes`."""

    def __post_init__(self) -> None:
        _require_auto("quality", self.preset, self.budget_ms, self.max_light_error_deg)


class RequestMesh(Message, frozen=True, kw_only=True, tag="request_mesh"):
    """Request the scanned surface as mesh files; answered by mesh parts and then acknowledged."""

    request: Index
    """Number by which the request is answered, used once in a session."""


class RequestPanorama(Message, frozen=True, kw_only=True, omit_defaults=True, tag="request_panorama"):
    """Request the light that arrives at a place as a lat-long picture; answered by a panorama and then acknowledged."""

    request: Index
    """Number by which the request is answered, used once in a session."""
    format: PanoramaFormat
    """Of the file that is sent back."""
    position_m: Vector3 | None = None
    """World. None: the middle of the first virtual object, or of what the last frame sees if there is none."""

    def __post_init__(self) -> None:
        _require_near("request_panorama", position_m=self.position_m)


class Bye(Message, frozen=True, kw_only=True, tag="bye"):
    """Either side is leaving, with the reason."""

    reason: Reason = ""
    """One line for a person; may be empty."""


# ---- server to client --------------------------------------------------------------------------------------------


class Welcome(Message, frozen=True, kw_only=True, omit_defaults=True, tag="welcome"):
    """Answer to hello and watch."""

    session: Name
    """Name of the session; `waiting` for a watcher while nobody streams."""
    server: Name
    """Name and version of the server."""
    device: str
    """Name of the device that computes."""
    max_inflight: int
    """Number of frames that the client may have unanswered; at most as many as it asked for."""
    key: str | None = None
    """Secret key to resume the session (`hello.resume`), if the client set `keep_s`."""
    resumed: bool = False
    """True after a resume. What was sent over earlier connections is not answered any more; requests, and in a lossless
    session frames, are answered if they are sent again."""
    room: Name | None = None
    """The room that the session is in; None: one of its own."""
    codecs: tuple[ColorCodec, ...] = ("jpeg", "png", "raw")
    """Colour codecs that frames may use."""
    depth_codecs: tuple[DepthCodec, ...] = ("raw", "zdelta", "zstd-delta")
    """Depth codecs that frames may use."""
    camera: CameraModel | None = None
    """To a watcher: the lens of the session that it watches, by which it can point at places in the pictures."""


class LeftOut(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An effect that did not run, the reason, and a bound on the change, in display units (1 is 1/255)."""

    effect: str
    """Its name."""
    reason: str
    """Why it was not needed, in words."""
    error_bound: float | None
    """In display units; None: no bound is known. Where the reason says that it was measured, it leaves out a thousandth
    of the pixels."""


class OperatingPoint(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How a frame was sampled, and why."""

    settings: str
    """The settings, written as options of the command line."""
    reason: str
    """Why these settings, in words."""
    expected_ms: float | None = None
    """Expected time of a frame; like the next field, only for points that the server chose."""
    light_error_deg: float | None = None
    """Error of the dominant direction that was measured on the device."""


class Plan(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Effects that ran for a frame, in order, those that were left out, and how the frame was sampled."""

    run: tuple[str, ...]
    """Names of the effects, in order."""
    left_out: tuple[LeftOut, ...]
    """What did not run."""
    point: OperatingPoint | None = None
    """None if tracking is lost: nothing was sampled."""


class Timings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a frame cost: milliseconds under the thesis's row names (table 6.2), which add up to the total, and counts.

    While a kernel runs, time counts under the row that launched it, else under the row that the host is at.
    """

    input: float = 0.0
    """Milliseconds: colour to radiance, depth to points and normals."""
    reconstruct: float = 0.0
    """Milliseconds: tracking and fusion into the volume."""
    surface: float = 0.0
    """Milliseconds: ray cast of the volume."""
    dynamic_geometry: float = 0.0
    """Milliseconds: merging the volume with this frame's depth."""
    radiance_transfer: float = 0.0
    """Milliseconds: visibility and bounced light."""
    light_estimation: float = 0.0
    """Milliseconds."""
    rendering: float = 0.0
    """Milliseconds: effects and composite."""
    total: float = 0.0
    """Wall time."""
    host: float = 0.0
    """Milliseconds of `total` in which no kernel ran: the host's own work. The rows contain it."""
    launches: int = 0
    """Kernels launched; one that is cut into slices counts once."""
    reads: int = 0
    """Times that the host waited for memory of the device."""
    read_bytes: int = 0
    """Bytes of those reads."""
    copies: int = 0
    """Copies of memory to, from and on the device, waited for or not."""


TIMING_ROWS = (
    "input",
    "reconstruct",
    "surface",
    "dynamic_geometry",
    "radiance_transfer",
    "light_estimation",
    "rendering",
)
"""The rows of `Timings` that add up to the total."""


class DirectedLight(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One directional component of the room's light, in addition to uniform light."""

    direction: Vector3
    """World, unit, towards the light."""
    irradiance: Rgb
    """Radiance of a white surface that faces it and receives no other light."""
    spread_deg: float
    """Standard deviation along either axis; 0 for light from one direction."""


class Lamp(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A light inside the room that emits equally in all directions."""

    position_m: Vector3
    """World."""
    position_std_m: Vector3
    """One standard deviation along each world axis."""
    intensity: Rgb
    """Radiant intensity in units of radiance times m^2. At a distance of d metres it adds intensity / (pi d^2) to the
    radiance of a white surface that faces it."""
    intensity_std: Rgb
    """One standard deviation."""
    share: float
    """Share of the luminance that visible surfaces receive."""


class ArrivingLight(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The light that arrives at a place: from scanned surface where a direction meets it, from beyond it elsewhere."""

    of: LightPlace
    """`view`: the middle of what the frame sees; `place`: of `wishes.light_at`; `object`: the middle of its box."""
    index: Index
    """Among the `light_at` or the objects, in their order; 0 for the view."""
    position: Vector3
    """World, metres."""
    sh: tuple[Rgb, ...]
    """This and the fields below as in `light`; 16 x [r, g, b]."""
    sh_std: tuple[RgbOrNull, ...]
    """16 x [r, g, b]."""
    sh_webxr: tuple[float, ...]
    """27 floats."""
    dominant_direction: Vector3
    """World, unit, towards the light."""
    dominant_intensity: float
    """As in `light`."""
    spread_deg: float | None
    """As in `light`."""
    valid: bool
    """As in `light`."""
    seen: float | None = None
    """Share of the directions from here in which photographed surface is met, 0 to 1; null where unknown."""
    object: Name | None = None
    """With `of: object`: the object's name."""


class Light(Message, frozen=True, kw_only=True, tag="light"):
    """The estimate of the room's light after one frame; the fields of a line of `light.jsonl`."""

    frame: Index
    """The frame it belongs to."""
    timestamp_s: float
    """That of the frame."""
    sh: tuple[Rgb, ...]
    """16 x [r, g, b], zeros for bands not estimated."""
    sh_all: tuple[Rgb, ...] | None = None
    """All coefficients, when there are more than 16."""
    sh_std: tuple[RgbOrNull, ...]
    """One standard deviation of each of `sh`; null where unknown."""
    sh_webxr: tuple[float, ...]
    """27 floats, RGB-interleaved C00 C1-1 C10 C11 ..., in axes with up as +y and the first camera's view near -z."""
    dominant_direction: Vector3
    """World, unit, towards the light, from l = 1 of Rec. 709 luminance; (0, 0, 0) if there is none."""
    dominant_intensity: float
    """Luminance of the light from there, as one direction."""
    dominant_lights: tuple[DirectedLight, ...] = ()
    """Directional components, strongest first; empty if the light is uniform."""
    lamps: tuple[Lamp, ...] = ()
    """Lights inside the room, strongest first; not included in `sh`."""
    exposure: float = 1.0
    """Exposure of this frame relative to the session's first. All radiance here is in units of this frame's image.
    Divided by `exposure` it is in units of the first image, and constant under constant light."""
    up: Vector3 | None = None
    """World, unit: the up direction, along which objects stand."""
    condition: float | None
    """Condition number of the unregularised normal equations; null if infinite."""
    valid: bool
    """Whether the dominant direction is known: `spread_deg` is at most 25; where it is null, as the estimator says."""
    spread_deg: float | None = None
    """Angle in degrees that 90 % of the possible dominant directions are within; null where unknown."""
    position: Vector3 | None = None
    """World, metres: the middle of what the frame sees, from where `sh` is meant; it stays until that has moved by a
    twentieth of its distance from the camera. Null until a frame was placed."""
    at: tuple[ArrivingLight, ...] = ()
    """Light arriving at places: the view, then `wishes.light_at` in their order, then objects in theirs."""


class PlacedObject(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where an object stands whose spot was found; the fields of `place_object` and `move_object`."""

    object: Name
    """Its name."""
    position_m: Vector3
    """World position of the bottom centre of the model's box."""
    scale: float
    """Factor on the model's size."""
    yaw_deg: float
    """Turn about the up axis."""


class Drawn(Message, frozen=True, kw_only=True):
    """Fields common to composite and layer."""

    frame: Index
    """The frame it belongs to."""
    timestamp_s: float
    """That of the frame."""
    world_from_camera: Matrix4
    """Pose that was used; the last one while tracking is lost."""
    tracking: Tracking
    """Where the pose is from; `lost`: none was found."""
    timings: Timings
    """What the frame cost."""
    plan: Plan
    """Which effects ran."""
    notes: tuple[str, ...] = ()
    """Problems with this frame's input, one line each."""
    waited_ms: float = 0.0
    """Time from the frame's arrival until its processing began: in the queue, decoding, waiting for the device."""
    placed: tuple[PlacedObject, ...] = ()
    """Objects whose spots were found in this frame."""


class Composite(Drawn, frozen=True, kw_only=True, tag="composite"):
    """The composite image of one frame."""

    color: ColorImage
    """sRGB picture of the camera's size."""


class LayerPatch(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A rectangle of the camera's image with the depth of each pixel."""

    x: Annotated[int, Meta(ge=0, lt=MAX_IMAGE_SIDE_PX)]
    """Column of the camera's image at which the rectangle begins."""
    y: Annotated[int, Meta(ge=0, lt=MAX_IMAGE_SIDE_PX)]
    """Row of the camera's image at which the rectangle begins."""
    color: ColorImage
    """PNG."""
    depth: DepthImage
    """Same size, along the camera's z; 0: the pixel is empty."""


class Layer(Drawn, frozen=True, kw_only=True, tag="layer"):
    """Virtual content of one frame (`wishes.answer`), to be composed with a camera image p of this or a later frame.

    All linear: picture = coverage * virtual + (1 - coverage) * ratio * p (thesis 7.2.1).
    """

    virtual: LayerPatch | None
    """Four channels: sRGB, not premultiplied, and coverage (255: the whole pixel).

    None: no virtual object is visible."""
    ratio: LayerPatch | None
    """Three channels: 128 times the square root of the factor on real surfaces.

    None: real surfaces are unchanged."""
    depth_scale_m: Annotated[float, Meta(gt=0, le=1)]
    """Metres per unit of depth."""


class Dropped(Message, frozen=True, kw_only=True, tag="dropped"):
    """The frame was replaced by a newer one before it was read, or was refused. It gets no other answer."""

    frame: Index
    """Number of the frame."""
    reason: Reason
    """One line for a person."""


class MeshPart(Message, frozen=True, kw_only=True, tag="mesh_part"):
    """Part of a mesh file. The parts of a file come in order, one file after the other.

    PLY: world axes, metres. GLB: a node rotates the world to glTF's axes, +y up. Vertex colours are sRGB.
    """

    request: Index
    """Number of the request."""
    format: MeshFormat
    """Of the file."""
    size_bytes: Annotated[int, Meta(ge=1, le=MAX_SCENE_MESH_BYTES)]
    """Size of the whole file."""
    offset: Index
    """Offset of this part in the file."""
    data: Annotated[bytes, Meta(min_length=1, max_length=MAX_MESH_PART_BYTES)]
    """The bytes of this part."""


class Panorama(Message, frozen=True, kw_only=True, tag="panorama"):
    """The light that arrives at a place as a lat-long picture of linear radiance, in units of the last frame's image.

    The top row looks up; the middle column looks along the first camera's view, columns go on to the right.
    """

    request: Index
    """Number of the request."""
    format: PanoramaFormat
    """Of the file."""
    position_m: Vector3
    """World: where it was made for."""
    data: Annotated[bytes, Meta(min_length=1, max_length=MAX_PANORAMA_BYTES)]
    """The file: Radiance `hdr` or OpenEXR `exr`."""


NOT_SAVED = "not saved: "
"""Begin of `acknowledged.error` where the request was applied in a room that could not be written to disk."""


class Acknowledged(Message, frozen=True, kw_only=True, tag="acknowledged"):
    """A control message was applied, or refused with `error`.

    An `error` that begins with "not saved: ": applied, and lost if the server is killed before it can write its disk.
    """

    request: Index
    """Number of the request."""
    error: Reason | None = None
    """Why the request was refused; None: it was applied."""
    notes: tuple[str, ...] = ()
    """What a person should know, one line each."""


class Error(Message, frozen=True, kw_only=True, tag="error"):
    """The client sent something invalid; `fatal` if the server closes the connection."""

    reason: Reason
    """One line that names the field or rule and what was wrong."""
    fatal: bool
    """True: the connection is closed next."""


ClientMessage = (
    Hello | Watch | Frame | PlaceObject | MoveObject | RemoveObject | Quality | RequestMesh | RequestPanorama | Bye
)
ServerMessage = Welcome | Composite | Layer | Light | Dropped | MeshPart | Panorama | Acknowledged | Error | Bye

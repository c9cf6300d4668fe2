"""Options shared by the commands with a SOURCE, declared once; a command receives them as one `CaptureOptions`."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_type_hints

import typer

from protocol.limits import MAX_SH_BANDS
from protocol.messages import Preset as PresetName
from protocol.messages import Robustness as RobustnessName
from protocol.messages import Wishes

DEFAULTS = Wishes()
"""Of the wire; the command line has no others, except where the source knows better."""
PRESETS: tuple[PresetName, ...] = get_args(PresetName)
DENOISE: tuple[Literal["none", "bilateral", "tv_l1"], ...] = ("none", "bilateral", "tv_l1")
ROBUSTNESS: tuple[RobustnessName, ...] = ("openness", "normals", "memory", "outliers")
"""The wire has one more, `normals_printed`, for a comparison in `probeless bench light`."""

SourceArgument = Annotated[
    str,
    typer.Argument(
        metavar="SOURCE", help="data-set folder, capture of another program, synthetic:NAME, recording or oak[?vio=off]"
    ),
]
Frames = Annotated[str | None, typer.Option(metavar="A:B", help="half-open range of positions in the source")]
PosesOption = Annotated[
    str | None, typer.Option(metavar="given|track|refine", help="default: given if the source has poses")
]
VolumeOption = Annotated[str | None, typer.Option(metavar="x0,y0,z0,x1,y1,z1", help="metres; default: fits the source")]
Voxel = Annotated[float | None, typer.Option(metavar="M", help="voxel size in metres; default: fits the volume")]
Preset = Annotated[
    str | None,
    typer.Option(metavar="|".join(PRESETS), help=f"where and how transfer is sampled; default: {DEFAULTS.preset}"),
]
Rays = Annotated[
    int | None, typer.Option(min=4, max=1024, help=f"visibility rays per sample; default: {DEFAULTS.rays}")
]
Stride = Annotated[
    int | None,
    typer.Option(
        min=1, max=16, metavar="PX", help="distance between samples; default here and for the next four: of the preset"
    ),
]
Interleave = Annotated[int | None, typer.Option(metavar="1|2|4|8", help="number of frames that share the directions")]
Upsampling = Annotated[str | None, typer.Option(metavar="bilateral|bicubic", help="of sampled shading to all pixels")]
VisibilityState = Annotated[
    bool | None,
    typer.Option("--visibility-state/--no-visibility-state", help="skip rays where the volume is known to be open"),
]
AuxiliaryViews = Annotated[
    int | None,
    typer.Option(min=16, max=4096, metavar="N", help="number of depth views in which GR15 looks up visibility"),
]
SmoothDepth = Annotated[bool, typer.Option("--smooth-depth/--no-smooth-depth", help="final median of the merged depth")]
RayLength = Annotated[str | None, typer.Option(metavar="M|room", help="search distance for occluders; default: room")]
Bands = Annotated[int, typer.Option(min=2, max=MAX_SH_BANDS, help="spherical-harmonics bands")]
Albedo = Annotated[str | None, typer.Option(metavar="constant|estimated", help=f"default: {DEFAULTS.albedo}")]
Indirect = Annotated[str | None, typer.Option(metavar="none|observed", help=f"default: {DEFAULTS.indirect}")]
AsThesis = Annotated[bool, typer.Option("--as-thesis", help="--ray-length 0.1 --albedo constant --indirect none")]
Denoise = Annotated[
    str, typer.Option(metavar="|".join(DENOISE), help="denoising of the lightness used for light estimation")
]
DenoiseIterations = Annotated[int, typer.Option(min=1, max=1000, help="iterations of TV-L1")]
Object = Annotated[
    list[str] | None,
    typer.Option(
        metavar="FILE[@PLACE[,SIZE[,yaw]]]",
        help="virtual object; may be repeated. PLACE: x,y,z, pixel:U,V[:FRAME], floor, table or auto; SIZE: a scale, "
        "or a height such as 0.3m",
    ),
]
Up = Annotated[
    str | None, typer.Option(metavar="x,y,z", help="up direction; default: of the source, else found from the scan")
]
LightFile = Annotated[str | None, typer.Option("--light", metavar="FILE", help="use this light instead of an estimate")]
Panorama = Annotated[str | None, typer.Option(metavar="FILE", help="use the light of this panorama")]
LightAt = Annotated[
    list[str] | None,
    typer.Option("--light-at", metavar="x,y,z", help="tell the light that arrives at this place; may be repeated"),
]
PanoramaFile = Annotated[
    str | None,
    typer.Option(
        "--panorama-out",
        metavar="FILE.hdr|.exr[@x,y,z]",
        help="write the light that arrives at a place, after the last frame; default: the first object's",
    ),
]
Lamps = Annotated[
    str | None,
    typer.Option(
        metavar="on|off", help="search for lights inside the room; default: where one light is estimated for all of it"
    ),
]
Exposure = Annotated[
    str | None, typer.Option(metavar="auto|constant", help="default: auto, of the frame if given, else estimated")
]
Robustness = Annotated[
    str | None,
    typer.Option(
        metavar="LIST|none", help=f"list of {', '.join(ROBUSTNESS)}; default: {','.join(DEFAULTS.robustness)}"
    ),
]
Edges = Annotated[str | None, typer.Option(metavar="smooth|hard", help="edges of virtual objects; hard: point-sampled")]
ToneMapping = Annotated[
    str | None,
    typer.Option(
        metavar="light|average",
        help="what virtual objects are as bright as; default: light; with --panorama, or --as-thesis alone: average",
    ),
]
Plan = Annotated[
    str | None, typer.Option(metavar="needed|everything", help="everything: also effects whose change is invisible")
]
Cache = Annotated[
    str | None,
    typer.Option(metavar="on|off", help="off: nothing is kept at places of the world, to compare; default: on"),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="replace an earlier run in the output folder")]
VideoFileOption = Annotated[bool, typer.Option("--video", help="write video.mp4 (H.264); needs PyAV")]
RerunOption = Annotated[
    Path | None,
    typer.Option("--rerun", metavar="FILE.rrd", help="recording for the rerun viewer; needs rerun-sdk"),
]
Mesh = Annotated[bool, typer.Option("--mesh", help="write mesh.ply and mesh.glb")]
Scene = Annotated[
    bool, typer.Option("--scene", help="write scene.glb: scan, objects, lights, camera path; and scene.hdr")
]
BudgetMs = Annotated[float | None, typer.Option(metavar="N", help="choose the operating point for this frame time")]
MaxLightError = Annotated[
    float | None, typer.Option(metavar="DEG", help="choose the operating point for this light error")
]
DeviceOption = Annotated[str | None, typer.Option(metavar="NAME", help="part of an OpenCL device's name")]
RoomName = Annotated[
    str | None, typer.Option("--room", metavar="NAME", help="share volume, light and objects with others")
]
RoomKey = Annotated[str | None, typer.Option("--room-key", metavar="KEY", help="set by the client that opens the room")]
RoomFromWorld = Annotated[
    str | None,
    typer.Option(
        metavar="same|16 NUMBERS|FILE",
        help="pose of this source's world in the room, row-major 4x4; default: estimated",
    ),
]
MarkerOption = Annotated[
    str | None,
    typer.Option(
        "--marker", metavar="ID,SIDE_M[,DICTIONARY]", help="ArUco or AprilTag that all clients of the room see"
    ),
]
Token = Annotated[
    str | None, typer.Option(metavar="TOKEN", envvar="PROBELESS_TOKEN", help="token of the server, if the URL has none")
]
ServeToken = Annotated[
    str | None,
    typer.Option(
        metavar="TOKEN|none", envvar="PROBELESS_TOKEN", help="required from clients; default: a new one; none: no token"
    ),
]
TokenFile = Annotated[
    Path | None,
    typer.Option(metavar="FILE", envvar="PROBELESS_TOKEN_FILE", help="file with the token, as a container's secret"),
]
AllowOrigin = Annotated[
    list[str] | None,
    typer.Option(metavar="ORIGIN", help="https://host of other pages that may connect; may be repeated"),
]


@dataclass(frozen=True)
class CaptureOptions:
    """The shared options as typed; None: not given."""

    source: SourceArgument
    frames: Frames = None
    poses: PosesOption = None
    volume: VolumeOption = None
    voxel: Voxel = None
    preset: Preset = None
    rays: Rays = None
    stride: Stride = None
    interleave: Interleave = None
    upsampling: Upsampling = None
    visibility_state: VisibilityState = None
    auxiliary_views: AuxiliaryViews = None
    smooth_depth: SmoothDepth = DEFAULTS.smooth_depth
    ray_length: RayLength = None
    bands: Bands = DEFAULTS.bands
    albedo: Albedo = None
    indirect: Indirect = None
    as_thesis: AsThesis = DEFAULTS.as_thesis
    denoise: Denoise = DEFAULTS.denoise
    denoise_iterations: DenoiseIterations = DEFAULTS.denoise_iterations
    object: Object = None
    up: Up = None
    light: LightFile = None
    panorama: Panorama = None
    light_at: LightAt = None
    lamps: Lamps = None
    exposure: Exposure = None
    robustness: Robustness = None
    edges: Edges = None
    tone_mapping: ToneMapping = None
    plan: Plan = None
    cache: Cache = None
    budget_ms: BudgetMs = None
    max_light_error: MaxLightError = None


def capturing(command: Callable[..., None]) -> Callable[..., None]:
    """Wrap a command whose first parameter is a `CaptureOptions` as one with a parameter per field, for typer."""
    hints = get_type_hints(CaptureOptions, include_extras=True)
    shared = [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            annotation=hints[field.name],
            default=inspect.Parameter.empty if field.name == "source" else field.default,
        )
        for field in fields(CaptureOptions)
    ]
    own = list(inspect.signature(command, eval_str=True).parameters.values())[1:]
    own = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in own]
    names = [parameter.name for parameter in shared]

    def run(**given: Any) -> None:
        options = CaptureOptions(**{name: given.pop(name) for name in names})
        command(options, **given)

    parameters = [shared[0], *own, *shared[1:]]
    run.__name__, run.__doc__ = command.__name__, command.__doc__
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run

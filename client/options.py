"""The options that `run` and `stream` share, and the wishes, volume and objects that they amount to."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from client.laptop.datasets.ground_truth import GroundTruthSource
from client.laptop.errors import OptionError
from client.laptop.light_file import read_light, read_panorama_light
from client.laptop.objects import ObjectFile, parse_object
from client.laptop.source import Source, open_source
from client.laptop.volume import Volume, default_volume, default_voxel, with_room_to_move
from protocol.limits import MAX_SH_BANDS
from protocol.messages import Robustness as RobustnessName
from protocol.messages import Wishes

BUILT_PRESETS = ("rm", "reg4", "reg8", "art1", "art4", "art8", "gr15", "gr15fast")
PRESETS = (*BUILT_PRESETS, "auto")
THESIS_RAY_LENGTH_M = 0.1
DENOISE = ("none", "bilateral", "tv_l1")
ROBUSTNESS = get_args(RobustnessName)

SourceArgument = Annotated[
    str, typer.Argument(metavar="SOURCE", help="data-set folder, synthetic:NAME, recording or oak")
]
Frames = Annotated[str | None, typer.Option(metavar="A:B", help="half-open range of positions in the source")]
PosesOption = Annotated[
    str | None, typer.Option(metavar="given|track|refine", help="default: given where there are any")
]
VolumeOption = Annotated[
    str | None, typer.Option(metavar="x0,y0,z0,x1,y1,z1", help="metres; default: what the source sees")
]
Voxel = Annotated[float | None, typer.Option(metavar="M", help="voxel side in metres; default: fits the volume")]
Preset = Annotated[str, typer.Option(metavar="|".join(PRESETS), help="where and how transfer is sampled")]
Rays = Annotated[int, typer.Option(min=4, max=1024, help="visibility rays per sample")]
RayLength = Annotated[
    str | None, typer.Option(metavar="M|room", help="how far occluders are looked for; default: room")
]
Bands = Annotated[int, typer.Option(min=2, max=MAX_SH_BANDS, help="spherical-harmonics bands")]
Albedo = Annotated[str | None, typer.Option(metavar="constant|estimated", help="default: estimated")]
Indirect = Annotated[str | None, typer.Option(metavar="none|observed", help="default: observed")]
AsThesis = Annotated[bool, typer.Option("--as-thesis", help="--ray-length 0.1 --albedo constant --indirect none")]
Denoise = Annotated[
    str, typer.Option(metavar="|".join(DENOISE), help="of the lightness that the light is estimated from")
]
DenoiseIterations = Annotated[int, typer.Option(min=1, max=1000, help="of TV-L1")]
Object = Annotated[
    list[str] | None, typer.Option(metavar="FILE[@x,y,z[,scale[,yaw]]]", help="virtual object; may be repeated")
]
Up = Annotated[str | None, typer.Option(metavar="x,y,z", help="default: what the source says, else the camera's -y")]
LightFile = Annotated[str | None, typer.Option("--light", metavar="FILE", help="use this light, estimate none")]
Panorama = Annotated[str | None, typer.Option(metavar="FILE", help="light from a panorama")]
Lamps = Annotated[
    str | None, typer.Option(metavar="on|off", help="look for lights inside the room; default: where called for")
]
Exposure = Annotated[
    str | None, typer.Option(metavar="auto|constant", help="default: auto, as frames say it, else estimated")
]
Robustness = Annotated[
    str | None,
    typer.Option(metavar="LIST|none", help=f"of {', '.join(ROBUSTNESS)}; default: openness,memory,outliers"),
]
Edges = Annotated[
    str | None, typer.Option(metavar="smooth|hard", help="of virtual things; hard: as in point-sampled pictures")
]
ToneMapping = Annotated[
    str | None,
    typer.Option(
        metavar="light|average", help="what virtual things' brightness rests on; default: average, light with --light"
    ),
]
LightColor = Annotated[
    str | None, typer.Option(metavar="estimated|white", help="white: the light without its colours, as the thesis")
]
Plan = Annotated[
    str | None, typer.Option(metavar="needed|everything", help="everything: also what would hardly be seen")
]
Mesh = Annotated[bool, typer.Option("--mesh", help="write mesh.ply and mesh.glb")]
BudgetMs = Annotated[float | None, typer.Option(metavar="N", help="choose the operating point for this time")]
MaxLightError = Annotated[float | None, typer.Option(metavar="DEG", help="choose it for this light error")]
DeviceOption = Annotated[str | None, typer.Option(metavar="NAME", help="part of an OpenCL device's name")]


@dataclass(frozen=True)
class CaptureOptions:
    """The shared options as they were typed; None where nothing was said."""

    source: str
    frames: str | None = None
    poses: str | None = None
    volume: str | None = None
    voxel: float | None = None
    preset: str = "reg4"
    rays: int = 81
    ray_length: str | None = None
    bands: int = 4
    albedo: str | None = None
    indirect: str | None = None
    as_thesis: bool = False
    denoise: str = "none"
    denoise_iterations: int = 20
    object: list[str] | None = None
    up: str | None = None
    light: str | None = None
    panorama: str | None = None
    lamps: str | None = None
    exposure: str | None = None
    robustness: str | None = None
    edges: str | None = None
    tone_mapping: str | None = None
    light_color: str | None = None
    plan: str | None = None
    budget_ms: float | None = None
    max_light_error: float | None = None

    @classmethod
    def of(cls, parameters: dict[str, Any]) -> CaptureOptions:
        """From a command's parameters by name; others are left out."""
        return cls(**{field.name: parameters[field.name] for field in fields(cls)})


@dataclass(frozen=True)
class Capture:
    """What to stream, and how it shall be processed: the same for `run` and `stream`."""

    source: Source
    frames: range
    wishes: Wishes
    objects: tuple[ObjectFile, ...]


def prepare(options: CaptureOptions, lossless: bool = False) -> Capture:
    """Open the source and settle every default. Raises OptionError, SourceError, ObjectError."""
    refuse_unbuilt(options)
    objects = tuple(parse_object(text) for text in options.object or ())
    up, volume = parse_up(options.up), parse_volume(options.volume)
    wishes = _wishes_of_options(options)
    source = open_source(options.source)
    if options.light is not None and isinstance(source, GroundTruthSource):
        wishes["light"] = read_light(Path(options.light), source.radiance_of_white)
    poses = choose_poses(options.poses, source)
    frames = parse_frames(options.frames, len(source))
    seen = volume or default_volume(source, frames)
    voxel = options.voxel or default_voxel(seen)
    volume = volume or (seen if source.has_poses else with_room_to_move(seen))
    settled = {"volume_m": volume, "voxel_m": voxel, "up": up or source.up, "poses": poses, "lossless": lossless}
    return Capture(source, frames, Wishes(**wishes, **settled), objects)


def choose_poses(asked: str | None, source: Source) -> str:
    """What was asked for, else given where the source has poses, else track. Raises OptionError."""
    poses = asked or ("given" if source.has_poses else "track")
    if poses != "track" and not source.has_poses:
        raise OptionError(f"--poses {poses}: {source.name} has no poses; leave it out or use --poses track")
    return poses


def refuse_unbuilt(options: CaptureOptions) -> None:
    """Raise OptionError for an option whose system does not exist yet, naming what does."""
    _choice("--preset", options.preset, PRESETS)
    _choice("--denoise", options.denoise, DENOISE)
    _choice("--poses", options.poses, ("given", "track", "refine"))
    _choice("--albedo", options.albedo, ("constant", "estimated"))
    _choice("--indirect", options.indirect, ("none", "observed"))
    _choice("--lamps", options.lamps, ("on", "off"))
    _choice("--edges", options.edges, ("smooth", "hard"))
    _choice("--tone-mapping", options.tone_mapping, ("light", "average"))
    _choice("--light-color", options.light_color, ("estimated", "white"))
    _choice("--plan", options.plan, ("needed", "everything"))
    _choice("--exposure", options.exposure, ("auto", "constant"))
    unbuilt = {
        f"--preset {options.preset}": (options.preset not in BUILT_PRESETS, f"use {', '.join(BUILT_PRESETS)}"),
        "--budget-ms": (options.budget_ms is not None, "choose a --preset and --rays instead"),
        "--max-light-error": (options.max_light_error is not None, "choose a --preset and --rays instead"),
    }
    for name, (asked, instead) in unbuilt.items():
        if asked:
            raise OptionError(f"{name} is not built yet; {instead}")


def parse_frames(text: str | None, count: int) -> range:
    """`A:B`, half-open, either side may be left out. Raises OptionError unless it selects frames that exist."""
    if text is None:
        return range(count)
    first, colon, last = text.partition(":")
    try:
        start, stop = int(first or 0), int(last or count)
    except ValueError:
        colon = ""
    if not colon:
        raise OptionError(f"--frames {text}: expected A:B, for example 0:60")
    if not 0 <= start < stop <= count:
        raise OptionError(f"--frames {text}: the source has frames 0:{count}")
    return range(start, stop)


def parse_volume(text: str | None) -> Volume | None:
    """Six metres. Raises OptionError."""
    if text is None:
        return None
    x0, y0, z0, x1, y1, z1 = _numbers("--volume", text, "x0,y0,z0,x1,y1,z1")
    if not (x0 < x1 and y0 < y1 and z0 < z1):
        raise OptionError(f"--volume {text}: each of x1,y1,z1 must be more than x0,y0,z0")
    return x0, y0, z0, x1, y1, z1


def parse_up(text: str | None) -> tuple[float, float, float] | None:
    """A world direction. Raises OptionError."""
    if text is None:
        return None
    x, y, z = _numbers("--up", text, "x,y,z")
    if math.hypot(x, y, z) < 1e-6:
        raise OptionError(f"--up {text}: must not be zero")
    return x, y, z


def parse_ray_length(text: str | None) -> float | None:
    """Metres; None for the whole room. Raises OptionError."""
    if text is None or text == "room":
        return None
    try:
        length_m = float(text)
    except ValueError:
        length_m = math.nan
    if not 0 < length_m <= 1000:
        raise OptionError(f"--ray-length {text}: expected metres up to 1000, or room")
    return length_m


def _robustness(text: str | None) -> dict[str, Any]:
    """The measures that a list names. Raises OptionError for one that does not exist."""
    if text is None:
        return {}
    names = () if text == "none" else tuple(name.strip() for name in text.split(","))
    for name in names:
        _choice("--robustness", name, (*ROBUSTNESS, "none"))
    if "none" in names or {"normals", "normals_printed"} <= set(names):
        raise OptionError(f"--robustness {text}: these exclude one another; leave one out")
    return {"robustness": names}


def _wishes_of_options(options: CaptureOptions) -> dict[str, Any]:
    if options.voxel is not None and not 0 < options.voxel <= 1:
        raise OptionError(f"--voxel {options.voxel:g}: expected metres, more than 0 and at most 1")
    if options.as_thesis and "normals" in (options.robustness or ""):
        raise OptionError("--as-thesis is plain least squares, without weights by normals; leave one of them out")
    if options.as_thesis and options.ray_length is not None:
        raise OptionError("--as-thesis sets --ray-length 0.1; leave one of the two out")
    for name, asked in (("--albedo", options.albedo), ("--indirect", options.indirect)):
        if options.as_thesis and asked not in (None, "constant", "none"):
            raise OptionError(f"--as-thesis sets {name}; leave one of the two out")
    ray_length_m = THESIS_RAY_LENGTH_M if options.as_thesis else parse_ray_length(options.ray_length)
    return {
        "preset": options.preset,
        "rays": options.rays,
        "ray_length_m": ray_length_m,
        "bands": options.bands,
        "albedo": options.albedo or ("constant" if options.as_thesis else "estimated"),
        "indirect": options.indirect or ("none" if options.as_thesis else "observed"),
        "as_thesis": options.as_thesis,
        "denoise": options.denoise,
        "denoise_iterations": options.denoise_iterations,
        "lamps": options.lamps or "auto",
        "exposure": options.exposure or "auto",
        **_robustness(options.robustness),
        "edges": options.edges or "smooth",
        "tone_mapping": options.tone_mapping or "auto",
        "light_color": options.light_color or "estimated",
        "plan": options.plan or "needed",
        **_given_light(options),
    }


def _given_light(options: CaptureOptions) -> dict[str, Any]:
    """The wishes of `--light` and `--panorama`. Raises OptionError."""
    if options.light is not None and options.panorama is not None:
        raise OptionError("--light and --panorama each give the light; leave one of the two out")
    if options.light is not None:
        return {"light": read_light(Path(options.light))}
    if options.panorama is not None:
        return {"light": read_panorama_light(Path(options.panorama), options.bands), "light_axes": "webxr"}
    return {}


def _choice(name: str, value: str | None, allowed: tuple[str, ...]) -> None:
    if value is not None and value not in allowed:
        raise OptionError(f"{name} {value}: expected one of {', '.join(allowed)}")


def _numbers(name: str, text: str, form: str) -> list[float]:
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != form.count(",") + 1 or not all(math.isfinite(x) for x in numbers):
        raise OptionError(f"{name} {text}: expected {form}, finite numbers")
    return numbers

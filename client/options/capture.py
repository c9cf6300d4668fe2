"""What the options of a capture amount to: its source, frames, wishes, volume and objects."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from client.errors import OptionError
from client.objects.object_file import ObjectFile, parse_object
from client.options.capture_options import DENOISE, PRESETS, ROBUSTNESS, CaptureOptions
from client.options.light_file import read_light, read_panorama_light
from client.options.source import open_source
from client.sources.datasets.ground_truth import GroundTruthSource
from client.sources.frame_source import ENDLESS, Source, is_live
from client.sources.volume import Volume, default_volume, default_voxel, with_room_to_move
from protocol.messages import Wishes

THESIS_RAY_LENGTH_M = 0.1


@dataclass(frozen=True)
class Capture:
    """What to stream, and how it shall be processed: the same for `run` and `stream`."""

    source: Source
    frames: range
    wishes: Wishes
    objects: tuple[ObjectFile, ...]

    @property
    def total(self) -> int | None:
        """Number of frames; None where they end when somebody says so."""
        return None if self.frames.stop >= ENDLESS else len(self.frames)


def prepare(options: CaptureOptions, lossless: bool = False, answer: str | None = None) -> Capture:
    """Open the source and settle every default. Raises OptionError, SourceError, ObjectError."""
    refuse_unknown(options)
    _choice("--answer", answer, ("picture", "layer", "light"))
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
    is_seen_whole = source.has_poses and not is_live(source)
    volume = volume or (seen if is_seen_whole else with_room_to_move(seen))
    settled = {"volume_m": volume, "voxel_m": voxel, "up": up or source.up, "poses": poses}
    answered = {"answer": answer or "picture", "lossless": lossless}
    return Capture(source, frames, Wishes(**wishes, **settled, **answered), objects)


def choose_poses(asked: str | None, source: Source) -> str:
    """What was asked for, else given where the source has poses, else track. Raises OptionError."""
    poses = asked or ("given" if source.has_poses else "track")
    if poses != "track" and not source.has_poses:
        raise OptionError(f"--poses {poses}: {source.name} has no poses; leave it out or use --poses track")
    return poses


def refuse_unknown(options: CaptureOptions) -> None:
    """Raise OptionError for a word that an option does not know, naming those that it does."""
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
    _choice("--upsampling", options.upsampling, ("bilateral", "bicubic"))
    _choice("--interleave", options.interleave, (1, 2, 4, 8))


def refuse_depth_noise(noise_per_m: float | None, lossless: bool) -> None:
    """Raise OptionError for a noise at 1 m that no sensor has, or beside `--lossless`."""
    if noise_per_m is None:
        return
    if not 0 < noise_per_m <= 0.05:
        raise OptionError(f"--depth-noise {noise_per_m:g}: expected metres at 1 m, up to 0.05; a Kinect's is 0.0014")
    if lossless:
        raise OptionError("--depth-noise rounds depth and --lossless keeps every bit; leave one out")


def refuse_video(codec: str | None, lossless: bool) -> None:
    """Raise OptionError for a codec that is not known, cannot be written here, or stands beside `--lossless`."""
    from client.streaming.video import IS_POSSIBLE

    if codec is None:
        return
    _choice("--video", codec, ("h264",))
    if lossless:
        raise OptionError("--video loses a little of each picture and --lossless keeps every bit; leave one out")
    if not IS_POSSIBLE:
        raise OptionError("--video h264 needs PyAV, which is not installed: make install-video, or pip install av")


_SAMPLED_BY = ("rays", "stride", "interleave", "upsampling", "visibility_state", "auxiliary_views")


def _sampling(options: CaptureOptions) -> dict[str, Any]:
    """Where and how transfer is sampled, or by what the server chooses that. Raises OptionError."""
    chosen_by = {"budget_ms": options.budget_ms, "max_light_error_deg": options.max_light_error}
    is_chosen = options.preset == "auto" or any(value is not None for value in chosen_by.values())
    said = [name for name in _SAMPLED_BY if getattr(options, name) is not None]
    if is_chosen and (said or options.preset not in (None, "auto")):
        flag = "--" + (said[0] if said else "preset").replace("_", "-")
        raise OptionError(f"{flag} is what --preset auto, --budget-ms and --max-light-error choose; leave one out")
    for flag, value in (("--budget-ms", options.budget_ms), ("--max-light-error", options.max_light_error)):
        most = 60000 if flag == "--budget-ms" else 180
        if value is not None and not 0 < value <= most:
            raise OptionError(f"{flag} {value:g}: expected more than 0 and at most {most}")
    if is_chosen:
        return {"preset": "auto", **chosen_by}
    return {"preset": options.preset or "reg4", **{name: getattr(options, name) for name in said}}


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
        **_sampling(options),
        "smooth_depth": options.smooth_depth,
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


def _choice(name: str, value: str | int | None, allowed: tuple[str | int, ...]) -> None:
    if value is not None and value not in allowed:
        raise OptionError(f"{name} {value}: expected one of {', '.join(str(word) for word in allowed)}")


def _numbers(name: str, text: str, form: str) -> list[float]:
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != form.count(",") + 1 or not all(math.isfinite(x) for x in numbers):
        raise OptionError(f"{name} {text}: expected {form}, finite numbers")
    return numbers

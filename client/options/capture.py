"""A capture: the source, frames, wishes and objects that the options of the command line describe."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from client.errors import OptionError
from client.objects.object_file import ObjectFile, parse_object
from client.options.capture_options import DEFAULTS, ROBUSTNESS, CaptureOptions
from client.options.choices import Choices, choice, choices_of
from client.options.light_file import Coefficients, read_light, read_panorama_light
from client.options.light_places import parse_light_at
from client.options.source import open_source
from client.sources.datasets.ground_truth import GroundTruthSource
from client.sources.frame_source import ENDLESS, Source, is_live
from client.sources.volume import Volume, default_volume, default_voxel, enlarged_volume
from protocol.messages import Poses, Preset, Robustness, Wishes

THESIS_RAY_LENGTH_M = 0.1


@dataclass(frozen=True)
class Capture:
    """What to process and how; the same for `run` and `stream`."""

    source: Source
    frames: range
    wishes: Wishes
    objects: tuple[ObjectFile, ...]

    @property
    def total(self) -> int | None:
        """Number of frames; None for a live source without an upper bound."""
        return None if self.frames.stop >= ENDLESS else len(self.frames)


@dataclass(frozen=True)
class _Sampling:
    """Sampling of the transfer: a preset and changes to it, or limits by which the server chooses (preset `auto`)."""

    preset: Preset
    budget_ms: float | None = None
    max_light_error_deg: float | None = None
    rays: int = DEFAULTS.rays
    stride: int | None = None
    interleave: Literal[1, 2, 4, 8] | None = None
    upsampling: Literal["bilateral", "bicubic"] | None = None
    visibility_state: bool | None = None
    auxiliary_views: int | None = None


@dataclass(frozen=True)
class _GivenLight:
    """The light of `--light` or `--panorama`; without both, it is estimated."""

    sh: Coefficients | None = None
    axes: Literal["world", "webxr"] = "world"
    tone_mapping: Literal["auto", "average"] = "auto"
    """Panoramas are in units of their own, not in those of the camera's picture."""


def prepare(options: CaptureOptions, lossless: bool = False, answer: str | None = None) -> Capture:
    """Check the options, open the source and resolve all defaults. Raises OptionError, SourceError, ObjectError."""
    choices = choices_of(options)
    answer_kind: Literal["picture", "layer", "light"] | None = choice("--answer", answer, ("picture", "layer", "light"))
    objects = tuple(parse_object(text) for text in options.object or ())
    up, volume = parse_up(options.up), parse_volume(options.volume)
    light_at = parse_light_at(options.light_at)
    _refuse_conflicts(options)
    as_thesis = options.as_thesis
    ray_length_m = THESIS_RAY_LENGTH_M if as_thesis else parse_ray_length(options.ray_length)
    sampling, robustness = _sampling(options, choices), _robustness(options.robustness)
    light = _given_light(options)
    source = open_source(options.source)
    if options.light is not None and isinstance(source, GroundTruthSource):
        light = _GivenLight(read_light(Path(options.light), source.radiance_of_white))
    poses = _poses(choices.poses, source)
    frames = parse_frames(options.frames, len(source))
    _refuse_other_frames(objects, frames)
    visible_volume = volume or default_volume(source, frames)
    voxel = options.voxel or default_voxel(visible_volume)
    is_path_known = source.has_poses and not is_live(source)
    volume = volume or (visible_volume if is_path_known else enlarged_volume(visible_volume))
    wishes = Wishes(
        preset=sampling.preset,
        budget_ms=sampling.budget_ms,
        max_light_error_deg=sampling.max_light_error_deg,
        rays=sampling.rays,
        stride=sampling.stride,
        interleave=sampling.interleave,
        upsampling=sampling.upsampling,
        visibility_state=sampling.visibility_state,
        auxiliary_views=sampling.auxiliary_views,
        smooth_depth=options.smooth_depth,
        ray_length_m=ray_length_m,
        bands=options.bands,
        albedo="constant" if as_thesis else choices.albedo or DEFAULTS.albedo,
        indirect="none" if as_thesis else choices.indirect or DEFAULTS.indirect,
        as_thesis=as_thesis,
        denoise=choices.denoise or DEFAULTS.denoise,
        denoise_iterations=options.denoise_iterations,
        poses=poses,
        volume_m=volume,
        voxel_m=voxel,
        up=up or source.up,
        light=light.sh,
        light_axes=light.axes,
        light_at=light_at,
        lamps=choices.lamps or DEFAULTS.lamps,
        exposure=choices.exposure or DEFAULTS.exposure,
        edges=choices.edges or DEFAULTS.edges,
        tone_mapping=choices.tone_mapping or light.tone_mapping,
        robustness=robustness,
        plan=choices.plan or DEFAULTS.plan,
        cache=choices.cache or DEFAULTS.cache,
        answer=answer_kind or DEFAULTS.answer,
        lossless=lossless,
    )
    return Capture(source, frames, wishes, objects)


def refuse_depth_noise(noise_per_m: float | None, lossless: bool) -> None:
    """Raise OptionError for `--depth-noise` outside of (0, 0.05] metres, or together with `--lossless`."""
    if noise_per_m is None:
        return
    if not 0 < noise_per_m <= 0.05:
        raise OptionError(f"--depth-noise {noise_per_m:g}: expected metres at 1 m, up to 0.05; a Kinect's is 0.0014")
    if lossless:
        raise OptionError("--depth-noise rounds depth and --lossless keeps every bit; leave one out")


def refuse_color(codec: str | None, lossless: bool) -> None:
    """Raise OptionError for an unknown codec, one that cannot be encoded here, or together with `--lossless`."""
    from client.streaming.video import IS_POSSIBLE

    if codec is None:
        return
    choice("--color", codec, ("jpeg", "h264"))
    if lossless:
        raise OptionError("--color loses a little of each picture and --lossless keeps every bit; leave one out")
    if codec == "h264" and not IS_POSSIBLE:
        raise OptionError("--color h264 needs PyAV, which is not installed: make install-video, or pip install av")


def parse_frames(text: str | None, count: int) -> range:
    """Half-open range `A:B`; either side may be empty. Raises OptionError unless all its frames exist."""
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


def _refuse_other_frames(objects: tuple[ObjectFile, ...], frames: range) -> None:
    """Raise OptionError for an object on a pixel of a frame that is not processed."""
    for item in objects:
        frame = None if item.spot is None else item.spot.frame
        if frame is not None and frame not in frames:
            raise OptionError(
                f"--object {item.path.name}: frame {frame} of its pixel is none of {frames.start}:{frames.stop}"
            )


def parse_volume(text: str | None) -> Volume | None:
    """Six numbers x0,y0,z0,x1,y1,z1 in metres. Raises OptionError."""
    if text is None:
        return None
    x0, y0, z0, x1, y1, z1 = _numbers("--volume", text, "x0,y0,z0,x1,y1,z1")
    if not (x0 < x1 and y0 < y1 and z0 < z1):
        raise OptionError(f"--volume {text}: each of x1,y1,z1 must be more than x0,y0,z0")
    return x0, y0, z0, x1, y1, z1


def parse_up(text: str | None) -> tuple[float, float, float] | None:
    """A direction in world axes, not normalised. Raises OptionError."""
    if text is None:
        return None
    x, y, z = _numbers("--up", text, "x,y,z")
    if math.hypot(x, y, z) < 1e-6:
        raise OptionError(f"--up {text}: must not be zero")
    return x, y, z


def parse_ray_length(text: str | None) -> float | None:
    """Metres; None: the whole room. Raises OptionError."""
    if text is None or text == "room":
        return None
    try:
        length_m = float(text)
    except ValueError:
        length_m = math.nan
    if not 0 < length_m <= 1000:
        raise OptionError(f"--ray-length {text}: expected metres up to 1000, or room")
    return length_m


def _poses(choice: Poses | None, source: Source) -> Poses:
    """Default: `given` if the source has poses, else `track`. Raises OptionError if the source lacks them."""
    poses: Poses = choice or ("given" if source.has_poses else "track")
    if poses != "track" and not source.has_poses:
        raise OptionError(f"--poses {poses}: {source.name} has no poses; leave it out or use --poses track")
    return poses


_SAMPLING_OPTIONS = ("rays", "stride", "interleave", "upsampling", "visibility_state", "auxiliary_views")


def _sampling(options: CaptureOptions, choices: Choices) -> _Sampling:
    """Raises OptionError for values out of range, and for settings that `--preset auto` chooses."""
    is_auto = options.preset == "auto" or options.budget_ms is not None or options.max_light_error is not None
    given = [name for name in _SAMPLING_OPTIONS if getattr(options, name) is not None]
    if is_auto and (given or options.preset not in (None, "auto")):
        flag = "--" + (given[0] if given else "preset").replace("_", "-")
        raise OptionError(f"{flag} is what --preset auto, --budget-ms and --max-light-error choose; leave one out")
    for flag, value in (("--budget-ms", options.budget_ms), ("--max-light-error", options.max_light_error)):
        most = 60000 if flag == "--budget-ms" else 180
        if value is not None and not 0 < value <= most:
            raise OptionError(f"{flag} {value:g}: expected more than 0 and at most {most}")
    if is_auto:
        return _Sampling("auto", options.budget_ms, options.max_light_error)
    return _Sampling(
        choices.preset or DEFAULTS.preset,
        rays=DEFAULTS.rays if options.rays is None else options.rays,
        stride=options.stride,
        interleave=choices.interleave,
        upsampling=choices.upsampling,
        visibility_state=options.visibility_state,
        auxiliary_views=options.auxiliary_views,
    )


def _robustness(text: str | None) -> tuple[Robustness, ...]:
    """Raises OptionError for an unknown measure, and for measures that exclude each other."""
    if text is None:
        return DEFAULTS.robustness
    words = () if text == "none" else tuple(word.strip() for word in text.split(","))
    for word in words:
        choice("--robustness", word, (*ROBUSTNESS, "none"))
    if "none" in words:
        raise OptionError(f"--robustness {text}: these exclude one another; leave one out")
    return tuple(name for word in words for name in ROBUSTNESS if name == word)


def _refuse_conflicts(options: CaptureOptions) -> None:
    """Raise OptionError for a bad `--voxel` and for options that contradict `--as-thesis`."""
    if options.voxel is not None and not 0 < options.voxel <= 1:
        raise OptionError(f"--voxel {options.voxel:g}: expected metres, more than 0 and at most 1")
    if options.as_thesis and "normals" in (options.robustness or ""):
        raise OptionError("--as-thesis is plain least squares, without weights by normals; leave one of them out")
    if options.as_thesis and options.ray_length is not None:
        raise OptionError("--as-thesis sets --ray-length 0.1; leave one of the two out")
    for flag, value in (("--albedo", options.albedo), ("--indirect", options.indirect)):
        if options.as_thesis and value not in (None, "constant", "none"):
            raise OptionError(f"--as-thesis sets {flag}; leave one of the two out")


def _given_light(options: CaptureOptions) -> _GivenLight:
    """Raises OptionError."""
    if options.light is not None and options.panorama is not None:
        raise OptionError("--light and --panorama each give the light; leave one of the two out")
    if options.light is not None:
        return _GivenLight(read_light(Path(options.light)))
    if options.panorama is not None:
        return _GivenLight(read_panorama_light(Path(options.panorama), options.bands), "webxr", "average")
    return _GivenLight()


def _numbers(name: str, text: str, form: str) -> list[float]:
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != form.count(",") + 1 or not all(math.isfinite(x) for x in numbers):
        raise OptionError(f"{name} {text}: expected {form}, finite numbers")
    return numbers

"""Options whose value is one of a few words: checked, and typed as the wire format needs them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeVar

from client.errors import OptionError
from client.options.capture_options import DENOISE, PRESETS, CaptureOptions
from protocol.messages import Poses, Preset

Word = TypeVar("Word", bound=str | int)


@dataclass(frozen=True)
class Choices:
    """None: not given."""

    preset: Preset | None
    denoise: Literal["none", "bilateral", "tv_l1"] | None
    poses: Poses | None
    albedo: Literal["constant", "estimated"] | None
    indirect: Literal["none", "observed"] | None
    lamps: Literal["on", "off"] | None
    edges: Literal["smooth", "hard"] | None
    tone_mapping: Literal["light", "average"] | None
    plan: Literal["needed", "everything"] | None
    cache: Literal["on", "off"] | None
    exposure: Literal["auto", "constant"] | None
    upsampling: Literal["bilateral", "bicubic"] | None
    interleave: Literal[1, 2, 4, 8] | None


def choices_of(options: CaptureOptions) -> Choices:
    """The checked words of the shared options. Raises OptionError for an unknown word; it lists the known ones."""
    return Choices(
        preset=choice("--preset", options.preset, PRESETS),
        denoise=choice("--denoise", options.denoise, DENOISE),
        poses=choice("--poses", options.poses, ("given", "track", "refine")),
        albedo=choice("--albedo", options.albedo, ("constant", "estimated")),
        indirect=choice("--indirect", options.indirect, ("none", "observed")),
        lamps=choice("--lamps", options.lamps, ("on", "off")),
        edges=choice("--edges", options.edges, ("smooth", "hard")),
        tone_mapping=choice("--tone-mapping", options.tone_mapping, ("light", "average")),
        plan=choice("--plan", options.plan, ("needed", "everything")),
        cache=choice("--cache", options.cache, ("on", "off")),
        exposure=choice("--exposure", options.exposure, ("auto", "constant")),
        upsampling=choice("--upsampling", options.upsampling, ("bilateral", "bicubic")),
        interleave=choice("--interleave", options.interleave, (1, 2, 4, 8)),
    )


def choice(option: str, value: str | int | None, allowed: tuple[Word, ...]) -> Word | None:
    """The element of `allowed` that equals `value`; None for None. Raises OptionError for any other value."""
    if value is None:
        return None
    for word in allowed:
        if word == value:
            return word
    raise OptionError(f"{option} {value}: expected one of {', '.join(str(word) for word in allowed)}")

"""Sampling settings: where and how densely radiance transfer is sampled. Chosen by the client or by a time budget."""

from __future__ import annotations

from typing import Any, Literal

from msgspec import Struct, structs

from protocol.messages import OperatingPoint, Preset, Wishes


class SamplingSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """The wishes that may change during a session; see `Wishes` for their meaning."""

    preset: Preset = "reg4"
    rays: int = 81
    stride: int | None = None
    interleave: Literal[1, 2, 4, 8] | None = None
    upsampling: Literal["bilateral", "bicubic"] | None = None
    visibility_state: bool | None = None
    auxiliary_views: int | None = None

    @classmethod
    def of(cls, wishes: Wishes) -> SamplingSettings:
        """The settings in a session's wishes."""
        return cls(**{name: getattr(wishes, name) for name in cls.__struct_fields__})

    def wishes(self, others: Wishes) -> Wishes:
        """`others` with these settings and without a budget or limit of the light error."""
        return structs.replace(others, **structs.asdict(self), budget_ms=None, max_light_error_deg=None)

    @property
    def settings(self) -> str:
        """The settings as command-line options, without those that the preset implies."""
        words = [f"--preset {self.preset}", f"--rays {self.rays}"]
        for name, value in structs.asdict(self).items():
            if name not in ("preset", "rays") and value is not None:
                words.append(option_of(name, value))
        return " ".join(words)


def option_of(name: str, value: Any) -> str:
    """A wish as a command-line option."""
    flag = "--" + name.removesuffix("_m").replace("_", "-")
    if isinstance(value, bool):
        return flag if value else flag.replace("--", "--no-", 1)
    return f"{flag} {value:g}" if isinstance(value, float) else f"{flag} {value}"


def requested_point(wishes: Wishes) -> OperatingPoint:
    """Operating point of a frame whose settings were given by the client."""
    return OperatingPoint(settings=SamplingSettings.of(wishes).settings, reason="asked for")

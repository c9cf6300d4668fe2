"""How finely one session samples: as its client wishes, or as a time budget or a light error chooses (U1)."""

from __future__ import annotations

from msgspec import structs

from protocol.messages import OperatingPoint, Preset, Timings, Wishes
from server.opencl.device import Device
from server.quality.operating_point_control import OperatingPointControl, control_for
from server.quality.sampling_settings import SamplingSettings, asked_for
from server.quality.settings import Settings, read_wishes


class SessionQuality:
    """`settings` hold for the next frame; `observe` each frame."""

    def __init__(self, device: Device, wishes: Wishes) -> None:
        """Raises ValueError, one line, for wishes that cannot be met, and where the device's front is not known."""
        self._device = device
        self._client_wishes = wishes
        self._control: OperatingPointControl | None = control_for(device, wishes)
        self.wishes = self._control.chosen.point.wishes(wishes) if self._control else wishes
        """As they are met now."""
        self.settings: Settings = read_wishes(self.wishes)

    def request(self, preset: Preset, budget_ms: float | None, max_light_error_deg: float | None) -> None:
        """Another preset, budget or light error, from the next frame on. Raises ValueError as the constructor does."""
        wishes = structs.replace(
            self.wishes, preset=preset, budget_ms=budget_ms, max_light_error_deg=max_light_error_deg
        )
        control = control_for(self._device, wishes)
        self._sample_at(control.chosen.point if control else self._sampling_of(preset))
        self._control = control

    def observe(self, timings: Timings, *, is_reused: bool) -> OperatingPoint:
        """Which operating point a frame had. The time it took decides the next one's.

        is_reused: the frame reused what was made before, so that its time says nothing of frames that cannot.
        """
        if self._control is None:
            return asked_for(self.wishes)
        said = self._control.said
        if not is_reused:
            self._control.observe(timings)
            self._sample_at(self._control.chosen.point)
        return said

    def _sampling_of(self, preset: Preset) -> SamplingSettings:
        """As the client wished at first where it is the same preset, else the preset's own."""
        wishes = self._client_wishes
        return (
            SamplingSettings.of(wishes)
            if preset == wishes.preset
            else SamplingSettings(preset=preset, rays=wishes.rays)
        )

    def _sample_at(self, sampling: SamplingSettings) -> None:
        wishes = sampling.wishes(self.wishes)
        self.settings = read_wishes(wishes)
        self.wishes = wishes

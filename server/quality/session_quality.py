"""Sampling quality of one session: given by its client, or chosen by a time budget or a light error (U1)."""

from __future__ import annotations

from msgspec import structs

from protocol.messages import OperatingPoint, Preset, Timings, Wishes
from server.opencl.device import Device
from server.quality.operating_point_control import OperatingPointControl, control_for
from server.quality.sampling_settings import SamplingSettings, requested_point
from server.quality.settings import Settings, read_wishes

RAY_S = 160e-9
"""Time of one ray of transfer on one compute unit: 83 ns on two cores, in the kitchen and with rays through all of it.
Other devices are taken to be as fast in each of their units, which is only to tell seconds from minutes."""


class SessionQuality:
    """`settings` are those of the next frame. Call `observe` after each frame."""

    def __init__(self, device: Device, wishes: Wishes) -> None:
        """Raises ValueError, one line, for invalid wishes, or if the device's front is needed and not measured."""
        self._device = device
        self._client_wishes = wishes
        self._control: OperatingPointControl | None = control_for(device, wishes)
        self.wishes = self._control.chosen.point.wishes(wishes) if self._control else wishes
        """The client's wishes with the current sampling settings."""
        self.settings: Settings = read_wishes(self.wishes)

    def request(self, preset: Preset, budget_ms: float | None, max_light_error_deg: float | None) -> None:
        """Set preset, budget and light error from the next frame on. Raises ValueError as the constructor does."""
        wishes = structs.replace(
            self.wishes, preset=preset, budget_ms=budget_ms, max_light_error_deg=max_light_error_deg
        )
        control = control_for(self._device, wishes)
        self._sample_at(control.chosen.point if control else self._sampling_of(preset))
        self._control = control

    def observe(self, timings: Timings, *, is_reused: bool) -> OperatingPoint:
        """Operating point of a frame; its time controls the next one's.

        is_reused: the frame reused results of earlier frames; its time is not used.
        """
        if self._control is None:
            return requested_point(self.wishes)
        point = self._control.operating_point
        if not is_reused:
            self._control.observe(timings)
            self._sample_at(self._control.chosen.point)
        return point

    def predicted_s(self, preset: Preset, width: int, height: int) -> float:
        """Time of the transfer of a frame of this size at a preset, before it was measured; 0 for `auto`."""
        if preset == "auto":
            return 0.0
        settings = read_wishes(self._sampling_of(preset).wishes(self.wishes))
        sampling, rays = settings.sampling, settings.rays
        rays_per_sample = rays if sampling.rays_per_frame else rays / sampling.interleave
        samples = (width // sampling.stride) * (height // sampling.stride)
        return samples * rays_per_sample * RAY_S / self._device.cl_device.max_compute_units

    def _sampling_of(self, preset: Preset) -> SamplingSettings:
        """The client's first settings if the preset is the same, else the preset's."""
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

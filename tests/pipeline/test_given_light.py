"""A light that is given, where nothing else is learnt from pictures: they are not denoised and nothing is estimated."""

from __future__ import annotations

import numpy as np

from client.gallery.play import play, wishes_of
from client.gallery.source import GallerySource
from protocol.messages import Plan
from server.opencl.device import Device

DENOISED = {"denoise": "tv_l1", "indirect": "none"}


def played(device: Device, **wishes: object) -> tuple[list[np.ndarray], Plan, set[str]]:
    """Pictures of three frames, the last one's plan, and the kernels that it launched."""
    source = GallerySource("sharp-sun")
    results = play(device, source, wishes_of(source, **{**DENOISED, **wishes}))
    frames = [next(results) for _ in range(3)]
    pictures, plan, kernels = [r.color for _, r in frames], frames[-1][1].plan, set(frames[-1][0].kernel_ms)
    results.close()
    return pictures, plan, kernels


def left_out(plan: Plan) -> dict[str, float | None]:
    return {left.effect: left.error_bound for left in plan.left_out}


def is_denoised(kernels: set[str]) -> bool:
    return any("tv_l1" in name for name in kernels)


def test_no_denoiser_where_the_light_is_given_and_nothing_else_reads_it(device: Device) -> None:
    pictures, plan, kernels = played(device, albedo="constant")
    everything, whole, all_kernels = played(device, albedo="constant", plan="everything")
    assert left_out(plan).items() >= {"denoise": 0.0, "estimate_light": 0.0}.items()
    assert not is_denoised(kernels)
    assert is_denoised(all_kernels)
    assert not {"denoise", "estimate_light"} & left_out(whole).keys()
    assert np.abs(np.array(pictures).astype(int) - everything).max() <= 1


def test_it_runs_where_the_light_is_to_be_found(device: Device) -> None:
    _, plan, kernels = played(device, albedo="constant", light=None)
    assert not {"denoise", "estimate_light"} & left_out(plan).keys()
    assert is_denoised(kernels)

"""Which of several OpenCL devices is the fastest here: one processor may have two drivers."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from client.tuning.scenes import FRAMES, Stage
from server.opencl.device import Device, list_devices, open_device
from server.quality.sampling_settings import SamplingSettings

USUAL = SamplingSettings(preset="reg4")


def other_devices(device: Device) -> list[Device]:
    """The usable devices besides this one."""
    names = [f"{info.platform} / {info.name}".strip() for info in list_devices() if info.usable is None]
    return [open_device(name) for name in names if name != device.name]


def frame_ms(device: Device, stage: Stage, progress: Callable[[int], None] = lambda _: None) -> float:
    """Median time of a frame of the stage at the usual settings."""
    return sum(stage.cost(device, USUAL, progress).ms.values())


def comparison(device: Device, note: Callable[[str], None]) -> Iterator[str]:
    """What the usual settings cost on every usable device, fastest first; nothing where there is only one."""
    others = other_devices(device)
    if not others:
        return
    note(f"comparing {1 + len(others)} devices, {FRAMES} frames each ...")
    stage = Stage()
    found = sorted((frame_ms(one, stage), one.name) for one in (device, *others))
    yield f"{USUAL.settings} on the devices here:"
    for ms, name in found:
        yield f"{ms:10.1f} ms  {name}"
    (_, fastest), *_ = found
    if fastest != device.name:
        yield f'The fastest is not the one that was tuned: use --device "{fastest}", here and with run and serve.'

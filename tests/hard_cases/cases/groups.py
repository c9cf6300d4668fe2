"""The device's ways: work-groups of any size, the same bits again."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pyopencl as cl

from server.light.light_estimation import sum_tiles
from server.opencl.device import Device
from server.opencl.engine import Engine, KernelArgument
from server.transfer.radiance_transfer import direction_sets, transfer_radiance
from server.volume.volume import Volume
from tests.hard_cases.catalogue import Family, Floats, Found, Trial
from tests.scenes.bad_depth import BOUNDS, CAMERA, frame_of, good_depth
from tests.scenes.volumes import fuse_frame, seen_surface, vectors

GROUPS = Family("work-groups")
_VOXEL_M = 0.06
_ITSELF = "no kernel reads the size of its work-group where that is open: the same operations, so the same bits."


class Grouped(Engine):
    """An engine whose work-groups, where a kernel leaves them open, hold `items`."""

    def __init__(self, device: Device, items: int) -> None:
        super().__init__(device)
        self._items = items

    def launch(
        self,
        kernel: cl.Kernel,
        size: tuple[int, ...],
        *arguments: KernelArgument,
        local: tuple[int, ...] | None = None,
        steps: int = 1,
    ) -> None:
        wide = 1 << (self._items.bit_length() // 2)
        shapes = {1: (self._items,), 2: (wide, self._items // wide), 3: (wide, self._items // wide, 1)}
        super().launch(kernel, size, *arguments, local=local or shapes[len(size)], steps=steps)


def _chain(engine: Engine) -> Floats:
    """Everything from the sensor's picture to the light's sums, of one frame."""
    frame = frame_of(good_depth(np.eye(4)), np.eye(4))
    volume = Volume(engine, BOUNDS, _VOXEL_M)
    pose, measurement = fuse_frame(engine, volume, CAMERA, frame)
    surface = seen_surface(engine, volume, CAMERA, pose)
    transfer = transfer_radiance(engine, CAMERA, volume, surface, 4, direction_sets(81, 4), 1.0)
    total = sum_tiles(engine, CAMERA, measurement.radiance, surface, transfer, _VOXEL_M).total()
    parts = (surface.positions, transfer.coefficients, transfer.openness)
    downloaded = [vectors(engine.download(a)).ravel() for a in parts]
    return np.concatenate([*downloaded, total.matrix.ravel(), total.vector.ravel()]).astype(np.float64)


_usual: dict[str, Floats] = {}


def _expected(device: Device) -> Floats:
    """Of the usual work-groups; of one device, once."""
    if device.name not in _usual:
        engine = Engine(device)
        _usual[device.name] = _chain(engine)
        engine.close()
    return _usual[device.name]


for _items in (1, 2, 4, 8, 16, 32, 64, 128, 256):

    @GROUPS.case(f"of {_items}", 0, "any difference", _ITSELF, apart=1e-3, checkable=_items == 64)
    def of_items(trial: Trial, items: int = _items) -> Found:
        engine = Grouped(trial.device, min(items, trial.device.cl_device.max_work_group_size))
        try:
            return Found(_chain(engine), _expected(trial.device))
        finally:
            engine.close()


@GROUPS.case(
    "one queue after another", 0, "any difference", "fixed orders of sums, no atomic floats: the same bits.", apart=1e-3
)
def again(trial: Trial) -> Found:
    chains = [_chain(trial.engine) for _ in range(3)]
    return Found([np.abs(a - b).max() for a, b in pairwise(chains)], 0)

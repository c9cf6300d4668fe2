"""Random surface samples under a known light, as light estimation takes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.light.near_samples import LOBES, PooledSamples
from server.opencl.engine import Engine
from server.transfer.radiance_transfer import Transfer
from server.volume.raycast import LABEL_DYNAMIC, LABEL_NONE, LABEL_STATIC, Surface
from tests.scenes import lights
from tests.scenes.analytic import Floats
from tests.scenes.solids import float4


@dataclass(frozen=True)
class Frame:
    """Everything that the sums are made of, on the host."""

    stride: int
    radiance: Floats
    labels: NDArray[np.uint8]
    positions: Floats
    normals: Floats
    transfer: Floats
    openness: Floats
    flatness: Floats

    def upload(self, engine: Engine) -> tuple[CameraModel, cl_array.Array, Surface, Transfer]:
        height, width = self.labels.shape
        rows, cols, n = self.transfer.shape
        space = engine.workspace
        return (
            CameraModel(width=width, height=height, fx=100.0, fy=100.0, cx=0.0, cy=0.0),
            space.upload("radiance", float4(self.radiance[..., :3], self.radiance[..., 3])),
            Surface(
                space.upload("positions", float4(self.positions)),
                space.upload("normals", float4(self.normals)),
                space.upload("labels", self.labels),
            ),
            Transfer(
                self.stride,
                rows,
                cols,
                round(n**0.5),
                *(
                    space.upload(name, values.astype(np.float32))
                    for name, values in (
                        ("transfer", self.transfer),
                        ("openness", self.openness),
                        ("flatness", self.flatness),
                    )
                ),
                space.array("free_mask", (rows, cols, 3), np.uint32),
            ),
        )

    @property
    def sampled(self) -> tuple[slice, slice]:
        """The samples' pixels."""
        rows, cols = self.openness.shape
        first = self.stride // 2
        return np.s_[first : first + rows * self.stride : self.stride, first : first + cols * self.stride : self.stride]


def random_frame(height: int, width: int, stride: int, bands: int = 4, seed: int = 1) -> Frame:
    """Two surfaces side by side, noise on everything, holes in everything. Every number is a float32."""
    random = np.random.default_rng(seed)
    rows, cols = height // stride, width // stride
    v, u = np.mgrid[:height, :width]
    left = u + 0.3 * v < width / 2
    positions = 0.01 * np.stack([u, v, np.where(left, 0, 30)], -1) + random.normal(size=(height, width, 3)) * 1e-3
    normals = lights.unit(
        np.where(left[..., None], [0, 0, -1.0], [0.9, 0, -0.5]) + 0.02 * random.normal(size=(height, width, 3))
    )
    radiance = np.concatenate(
        [
            random.uniform(0, 1, (height, width, 3)),
            random.choice([1, 1, 1, 0, -1], (height, width, 1), p=[0.33] * 3 + [0.005] * 2),
        ],
        -1,
    )
    labels = random.choice([LABEL_STATIC, LABEL_DYNAMIC, LABEL_NONE], (height, width), p=[0.98, 0.01, 0.01]).astype(
        np.uint8
    )
    transfer = random.normal(size=(rows, cols, bands * bands)) * 0.3
    openness, flatness = random.uniform(-0.05, 1, (rows, cols)), random.uniform(0.9, 1.3, (rows, cols))
    numbers = (radiance, positions, normals, transfer, openness, flatness)
    radiance, positions, normals, transfer, openness, flatness = (
        x.astype(np.float32).astype(np.float64) for x in numbers
    )
    return Frame(stride, radiance, labels, positions, normals, transfer, openness, flatness)


def samples_of(positions: Floats, normals: Floats) -> PooledSamples:
    """Pooled samples at given places, which have no transfer of their own."""
    return PooledSamples(positions, normals, np.zeros_like(positions), np.zeros((len(positions), LOBES)))

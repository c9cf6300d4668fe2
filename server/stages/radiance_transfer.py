"""Diffuse shadowed radiance transfer by ray tracing the volume (thesis 5.1.2, eq. 5.2).

Kernel: radiance_transfer.cl.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.sh import GOLDEN_TURN, sh_basis, spherical_fibonacci
from server.opencl.engine import Engine
from server.stages.raycast import Surface
from server.stages.volume import Volume

SETS = 64
"""Direction sets, interleaved over 8 x 8 samples, so that neighbours fill each other's gaps."""
_SEED = 1
_DEALT = 16
_WHOLE_TURNS = 10  # of 0 to 15 the one that leaves the lattice of all sets most even
_WINDOW = 1 / 160  # half the window that a sample's normal is the mean of, in picture widths


@dataclass(frozen=True)
class Directions:
    """Directions that visibility is tested along, with their basis functions."""

    directions: NDArray[np.float32]
    """[SETS, count, 4]: unit direction in world axes, solid angle in steradians."""
    basis: NDArray[np.float32]
    """[SETS, count, bands^2]."""

    @property
    def count(self) -> int:
        """Directions in one set."""
        return int(self.directions.shape[1])


@cache
def direction_sets(count: int, bands: int) -> Directions:
    """SETS sets of `count` directions of equal solid angle: four lattices, each turned at random and dealt to 16 sets
    in turn.

    A lattice advances by a sixteenth of a golden turn and of whole turns, so that every sixteenth point advances by a
    golden turn: each set is a spherical Fibonacci lattice, and 16 together are an even, fine one. What error a lattice
    has left is the same wherever it is used, so blocks of samples take turns with four of them.
    """
    generator = np.random.default_rng(_SEED)
    lattice = spherical_fibonacci(_DEALT * count, (GOLDEN_TURN + _WHOLE_TURNS) / _DEALT)
    turns = [np.linalg.qr(generator.normal(size=(3, 3)))[0] for _ in range(SETS // _DEALT)]
    turned = np.stack([(lattice @ turn)[k::_DEALT] for turn in turns for k in range(_DEALT)])
    weighted = np.concatenate([turned, np.full((SETS, count, 1), 4 * np.pi / count)], -1)
    return Directions(weighted.astype(np.float32), sh_basis(turned, bands).astype(np.float32))


@dataclass(frozen=True)
class Transfer:
    """Radiance transfer on the device; sample i along an axis lies at pixel stride / 2 + i stride."""

    stride: int
    rows: int
    cols: int
    bands: int
    coefficients: cl_array.Array
    """[rows, cols, bands^2] float32; zeros where there is no surface."""
    openness: cl_array.Array
    """[rows, cols] float32: free share of the cosine-weighted sky, -1 where there is no surface."""
    flatness: cl_array.Array
    """[rows, cols] float32: share of the window around a sample that lies on its own smooth surface."""
    free_mask: cl_array.Array
    """[rows, cols, words] uint32: bit j set where direction j is above the surface and free."""


def transfer_radiance(
    engine: Engine, camera: CameraModel, volume: Volume, surface: Surface, stride: int, rays: Directions, reach_m: float
) -> Transfer:
    """Transfer of the real world alone at every `stride`-th pixel; visibility rays of at most `reach_m`."""
    cols, rows = camera.width // stride, camera.height // stride
    coefficients = rays.basis.shape[2]
    bands = round(coefficients**0.5)
    words = -(-rays.count // 32)
    space = engine.workspace
    result = Transfer(
        stride,
        rows,
        cols,
        bands,
        space.array("transfer", (rows, cols, coefficients), np.float32),
        space.array("openness", (rows, cols), np.float32),
        space.array("flatness", (rows, cols), np.float32),
        space.array("free_mask", (rows, cols, words), np.uint32),
    )
    engine.launch(
        engine.kernel("radiance_transfer.cl", "transfer_radiance", BANDS=bands, MASK_WORDS=words, LANES=engine.lanes),
        (cols, rows),
        cols,
        rows,
        stride,
        camera.width,
        camera.height,
        max(1, round(camera.width * _WINDOW)),
        surface.positions,
        surface.normals,
        *volume.arguments(),
        rays.count,
        space.constant("directions", rays.directions.view(cl_types.float4)),
        space.constant("direction_basis", rays.basis),
        reach_m,
        result.coefficients,
        result.openness,
        result.flatness,
        result.free_mask,
    )
    return result

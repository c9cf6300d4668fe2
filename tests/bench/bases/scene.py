"""A scene under lights of its own, seen through transfers in any basis: what B9 compares bases on.

The kernel is that of the product: its table of basis values at the directions holds those of another basis, at the same
cost. Only the open part, which the kernel evaluates in closed form for spherical harmonics, is put in for the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from client.tuning.known_light import ALBEDO, BACKGROUND
from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from server.geometry.geometry import Geometry
from server.input.measure import measure
from server.light.light_estimation import TileSums, sum_tiles
from server.maths.sh import GOLDEN_TURN, lambert_transfer, spherical_fibonacci
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.quality.settings import WHOLE_ROOM_M
from server.shading.composite import srgb_codes
from server.transfer.radiance_transfer import SETS, Directions, Transfer, direction_sets, transfer_radiance
from server.volume.raycast import LABEL_STATIC, Surface
from tests.bench.bases.bases import Basis
from tests.bench.bases.lights import LATTICE, HardLight, lattice

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

RAYS = 81
"""Of the estimator and of what is shaded."""
STRIDE = 4
"""Pixels between samples; a picture shows each sample as a block of so many."""
BALL_POINTS, FLOOR_POINTS = 160, 320
FLOOR_RADII = 2.5
"""Radius of the floor looked at around a ball, in the ball's."""
LEAST_OPENNESS = 0.03
"""Points that receive less of an even light are inside of something."""


@dataclass(frozen=True)
class TableDirections(Directions):
    """Directions with values of another basis; `name` tells them apart on the device."""

    name: str = ""

    def on_device(self, engine: Engine) -> cl_array.Array:
        """[SETS, count] float4: `directions`."""
        return engine.workspace.constant(f"directions_of_{self.name}", self.directions.view(cl_types.float4))

    def basis_on_device(self, engine: Engine) -> cl_array.Array:
        """[SETS, count, size] float32: `basis`."""
        return engine.workspace.constant(f"table_of_{self.name}", self.basis)


@cache
def rays_in(basis: Basis) -> TableDirections:
    """The estimator's directions with the values of `basis`."""
    rays = direction_sets(RAYS, 2)
    values = basis.values(rays.directions[..., :3].astype(np.float64)).astype(np.float32)
    return TableDirections(rays.directions, values, name=f"{basis.name}_{basis.size}_{RAYS}")


def rays_along(directions: Floats, name: str) -> TableDirections:
    """The same unit `directions` [n, 3] for all samples, without a basis: the transfer is that of an open surface."""
    table = np.concatenate([directions, np.full((len(directions), 1), 4 * np.pi / len(directions))], 1)
    tables = np.ascontiguousarray(np.broadcast_to(table.astype(np.float32), (SETS, *table.shape)))
    return TableDirections(tables, np.zeros((SETS, len(directions), 4), np.float32), name=name)


@dataclass(frozen=True)
class Points:
    """Points of surface with what they receive from each direction of all lights, and what is blocked of RAYS."""

    normals: Floats
    """[n, 3]."""
    weights: NDArray[np.float32]
    """[n, directions]: visible share of the cosine, over pi; the lattice's first, then each light's discs'."""
    blocked: Floats
    """[n, RAYS]: blocked share of the cosine over pi, times solid angle."""
    rays: Floats
    """[n, RAYS, 3] unit."""

    def transfer(self, basis: Basis) -> Floats:
        """[n, size] of white surface."""
        hidden: Floats = np.einsum("pj,pjc->pc", self.blocked, basis.values(self.rays))
        return basis.open_transfer(self.normals) - hidden

    def kept(self, which: Bools) -> Points:
        """Some of them."""
        return Points(self.normals[which], self.weights[which], self.blocked[which], self.rays[which])


@dataclass(frozen=True)
class Ball:
    """A virtual ball that stands on a floor y = 0."""

    foot_m: tuple[float, float, float]
    """World."""
    radius_m: float

    @property
    def center_m(self) -> Floats:
        """World."""
        x, y, z = self.foot_m
        return np.array([x, y + self.radius_m, z])

    def surface(self) -> tuple[Floats, Floats]:
        """Points [n, 3], world metres, and their normals."""
        normals = spherical_fibonacci(BALL_POINTS)
        return self.center_m + self.radius_m * normals, normals

    def floor(self) -> tuple[Floats, Floats]:
        """Points [n, 3] of the floor around it, world metres, and their normals."""
        index = np.arange(FLOOR_POINTS) + 0.5
        away, turn = FLOOR_RADII * self.radius_m * np.sqrt(index / FLOOR_POINTS), 2 * np.pi * GOLDEN_TURN * index
        points: Floats = self.foot_m + np.stack([away * np.cos(turn), 0 * away, away * np.sin(turn)], 1)
        return points, np.tile([0.0, 1.0, 0.0], (FLOOR_POINTS, 1))

    def hides(self, points: Floats, directions: Floats) -> Bools:
        """[n, m] whether rays from `points` [n, 3] along `directions` [n, m, 3] or [m, 3] meet it."""
        offset = self.center_m - points
        along = np.einsum("pc,pjc->pj", offset, np.broadcast_to(directions, (len(points), *directions.shape[-2:])))
        return np.asarray((along > 0) & ((offset**2).sum(1)[:, None] - along**2 < self.radius_m**2))


@dataclass(frozen=True)
class View:
    """One frame's surface of the fused scene; the arrays are the view's own."""

    frame: RgbdFrame
    surface: Surface
    samples: Points
    covered: Bools
    """[rows, cols] which samples there are."""
    codes: NDArray[np.uint8]
    """[lights, rows, cols, 3] sRGB of each sample under each light."""


class LitScene:
    """A fused scene, views of it, and a ball in it, under any of `lights`."""

    def __init__(
        self,
        device: Device,
        camera: CameraModel,
        frames: Sequence[RgbdFrame],
        wishes: Wishes,
        lights: Sequence[HardLight],
        ball: Ball,
    ) -> None:
        """All `frames` are fused, then each is a view. Raises ValueError for none."""
        self.engine, self.lights, self._camera = Engine(device), lights, camera
        geometry = Geometry(self.engine, camera, wishes)
        for frame in frames:
            geometry.scan(frame)
        if geometry.volume is None:
            raise ValueError("a scene of no frames shows nothing")
        self._volume = geometry.volume
        discs = [light.directions()[LATTICE:] for light in lights]
        self._ends = LATTICE + np.cumsum([0, *map(len, discs)])
        self._discs = np.concatenate([*discs, np.array([[0.0, 1.0, 0.0]])])  # one at least
        self.views = [self._view(geometry, frame, number) for number, frame in enumerate(frames)]
        self.ball, self.floor = self._stand(ball)

    def close(self) -> None:
        """Give the device's memory back."""
        self.engine.close()

    def shading(self, points: Points, light: int) -> Floats:
        """[n, 3] what white surface receives, over pi: the truth."""
        flux, discs = self.lights[light].flux(), slice(self._ends[light], self._ends[light + 1])
        lattice_part: Floats = points.weights[:, :LATTICE] @ flux[:LATTICE]
        return lattice_part + points.weights[:, discs] @ flux[LATTICE:]

    def traced(self, basis: Basis, view: View) -> Transfer:
        """The kernel's transfer of the samples; its open part is that of spherical harmonics. Holds until the next."""
        return self._trace(view.surface, self._camera, rays_in(basis))

    def transfer(self, basis: Basis, view: View) -> Transfer:
        """Transfer of the samples in `basis`. Holds until the next."""
        found = self.traced(basis, view)
        if basis.name == "SH":
            return found
        host = self.engine.download(found.coefficients)
        closed = lambert_transfer(view.samples.normals, found.bands)
        host[view.covered] += (basis.open_transfer(view.samples.normals) - closed).astype(np.float32)
        return replace(found, coefficients=self.engine.workspace.upload("transfer_in_basis", host))

    def show(self, light: int, view: View) -> cl_array.Array:
        """Radiance as measured from an 8-bit picture under one of the lights, all of one albedo."""
        codes = np.repeat(np.repeat(view.codes[light], STRIDE, 0), STRIDE, 1)
        return measure(self.engine, self._camera, replace(view.frame, color=codes)).radiance

    def sums(self, basis: Basis) -> list[TileSums]:
        """The estimator's sums under each of the lights, of all views."""
        parts: list[list[TileSums]] = [[] for _ in self.lights]
        for view in self.views:
            transfer = self.transfer(basis, view)
            for light, part in enumerate(parts):
                part.append(self.sum_up(self.show(light, view), transfer, view))
        return [_joined(part) for part in parts]

    def sum_up(self, radiance: cl_array.Array, transfer: Transfer, view: View) -> TileSums:
        """The estimator's sums of one picture."""
        return sum_tiles(self.engine, self._camera, radiance, view.surface, transfer, self._volume.voxel_m)

    def _view(self, geometry: Geometry, frame: RgbdFrame, number: int) -> View:
        seen = geometry.scan(frame).surface
        own = [
            self.engine.workspace.upload(f"view_{number}_{part}", self.engine.download(getattr(seen, part)))
            for part in ("positions", "normals", "labels")
        ]
        surface = Surface(*own)
        samples, covered = self._look(surface, self._camera)
        codes = np.empty((len(self.lights), *covered.shape, 3), np.uint8)
        for light in range(len(self.lights)):
            picture = np.full((*covered.shape, 3), BACKGROUND)
            picture[covered] = ALBEDO * self.shading(samples, light)
            codes[light] = srgb_codes(picture)
        return View(frame, surface, samples, covered, codes)

    def _stand(self, ball: Ball) -> tuple[Points, Points]:
        """Points of the ball and of the floor around it, each hidden from the sky by the ball and by the scene."""
        on_ball = self._look(*self._upload(*ball.surface()))[0]
        places, upwards = ball.floor()
        on_floor = self._look(*self._upload(places, upwards))[0]
        seen = ~np.concatenate([ball.hides(places, lattice()), ball.hides(places, self._discs)], 1)
        cosine = np.maximum(np.einsum("pc,pjc->pj", on_floor.normals, on_floor.rays), 0) * (4 / RAYS)
        blocked = np.where(ball.hides(places, on_floor.rays), cosine, on_floor.blocked)
        on_floor = Points(on_floor.normals, on_floor.weights * seen, blocked, on_floor.rays)
        outside = on_floor.weights[:, :LATTICE].sum(1) * (4 * np.pi / LATTICE) > LEAST_OPENNESS
        return on_ball, on_floor.kept(outside)

    def _upload(self, places: Floats, normals: Floats) -> tuple[Surface, CameraModel]:
        """Points [n, 3], world metres, as a picture in which each fills a block, and that picture's camera."""
        space, cols = self.engine.workspace, 16
        blocks = []
        for values in (places + self._volume.volume_from_world()[:3, 3], normals):
            packed = np.ones((len(values), 4), np.float32)
            packed[:, :3] = values
            grid = packed.reshape(-1, cols, 4)
            blocks.append(np.repeat(np.repeat(grid, STRIDE, 0), STRIDE, 1).copy().view(cl_types.float4)[..., 0])
        height, width = len(places) // cols * STRIDE, cols * STRIDE
        labels = np.full((height, width), LABEL_STATIC, np.uint8)
        surface = Surface(
            space.upload("points", blocks[0]), space.upload("point_normals", blocks[1]), space.upload("ones", labels)
        )
        return surface, CameraModel(width=width, height=height, fx=100.0, fy=100.0, cx=0.0, cy=0.0)

    def _look(self, surface: Surface, camera: CameraModel) -> tuple[Points, Bools]:
        """Every `STRIDE`-th pixel's point, and [rows, cols] which have one."""
        parts = []
        for name, directions in (("lattice", lattice()), ("discs", self._discs)):
            found = self._trace(surface, camera, rays_along(directions, f"{name}_{len(directions)}"))
            free, covered, normals = self._downloaded(found, len(directions))
            cosine = np.maximum(normals @ directions.T, 0) / np.pi
            parts.append((cosine * free).astype(np.float32))
        rays = direction_sets(RAYS, 2)
        found = self._trace(surface, camera, rays)
        assert found.sets is not None
        free = self._downloaded(found, RAYS)[0]
        table = rays.directions[self.engine.download(found.sets)[..., 0]][covered].astype(np.float64)
        cosine = np.maximum(np.einsum("pc,pjc->pj", normals, table[..., :3]), 0) * table[..., 3] / np.pi
        return Points(normals, np.concatenate(parts, 1), cosine * ~free, table[..., :3]), covered

    def _trace(self, surface: Surface, camera: CameraModel, rays: Directions) -> Transfer:
        return transfer_radiance(self.engine, camera, self._volume, surface, STRIDE, rays, WHOLE_ROOM_M)

    def _downloaded(self, found: Transfer, count: int) -> tuple[Bools, Bools, Floats]:
        """[n, count] which directions are free, [rows, cols] where there is surface, and [n, 3] its normals.

        Normals as the kernel took them: from the l = 1 coefficients where nothing is blocked or the table is empty.
        """
        covered = self.engine.download(found.flatness) > 0
        bits = np.unpackbits(self.engine.download(found.free_mask)[covered].view(np.uint8), axis=-1, bitorder="little")
        linear = self.engine.download(found.coefficients)[covered][:, [3, 1, 2]].astype(np.float64)
        return bits[:, :count].astype(np.bool_), covered, linear / np.linalg.norm(linear, axis=1, keepdims=True)


def _joined(parts: Sequence[TileSums]) -> TileSums:
    """The tiles of several pictures as of one."""
    return TileSums(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("matrices", "vectors", "energies", "counts")
        )
    )

"""Frame-to-model tracking (KinectFusion 3.5; thesis 4.2.1): point-to-plane ICP of the measured depth against the
surface that the volume predicts. Kernels: track.cl.

Projective data association: every model pixel reads the measured depth of one pixel without interpolation. All images
are relative to the camera, so that float32 suffices at any distance from the volume's origin; poses and equations are
float64.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.registration import Scale, least_information, motion_of_twist, solve_where_fixed, symmetric
from server.maths.rigid import inverse_rigid, repaired_pose
from server.opencl.buffers import KeyedBufferDescription, StageBuffers
from server.opencl.engine import Engine, float4, float16
from server.volume.raycast import Surface

Pyramid = tuple[cl_array.Array, ...]
"""Depth pictures of the levels used, finest first."""

_FINEST_WIDTH_PX = 160
"""Halving averages noise and quantisation: on 640x480 pictures, the error with 160x120 as the finest level was a third
of that at full size, in a fifth of the time."""
_LEVELS = 3
_LANES, _ROWS, _SUMS = 8, 16, 32
_EDGE = 0.05
"""Relative depth difference up to which pixels are averaged into a coarser level."""

NOISE_M = 0.002
"""Standard deviation of a depth, constant: with one that grows with depth, as a sensor's does, rotations erred more,
because near surface alone fixes them badly."""
_GATES_M = (0.05, 0.08, 0.15)
"""Per level, finest first: pairs of points farther apart are rejected."""
_ITERATIONS = (8, 4, 4)
_WIDEST_CUTOFF, _CLOSEST_CUTOFF = 30.0, 1.0
"""Limits of Tukey's cut-off, in multiples of NOISE_M; between them it is 4.685 times the residuals' deviation."""
_CONVERGED_M = 2e-5

CORRELATED_PIXELS = 64.0
"""Noise of a depth picture is correlated over patches: one pixel in this many is an independent measurement."""
NORMAL_NOISE_RAD = 0.03
"""Noise of the predicted normals, which would otherwise count as structure."""


class ViewBuffers(StageBuffers):
    """Device buffers of one model view. A caller that keeps a view owns them."""

    levels = KeyedBufferDescription(np.float32)
    """By pyramid level, [4, h, pitch] as in ModelView."""


class _Buffers(StageBuffers):
    depth_m = KeyedBufferDescription(np.float32)
    """By pyramid level, [h, w] metres, 0 = none."""
    sums = KeyedBufferDescription(np.float32)
    """By pyramid level, [work-item, 32] as sum_equations of track.cl writes them."""


@dataclass(frozen=True)
class ModelView:
    """The predicted surface, in the axes of the camera for which it was predicted."""

    levels: tuple[cl_array.Array, ...]
    """Per level, finest first, planes [4, h, pitch] float32: depth (metres, 0 = none), normal x, y, z. Pixel (x, y) of
    a picture halved i times is pixel (2^i x, 2^i y) of the camera."""
    volume_from_camera: NDArray[np.float64]


@dataclass(frozen=True)
class Registration:
    """Result of registering the measured depth with the model."""

    volume_from_camera: NDArray[np.float64]
    deviation_m: float
    """Root mean square distance of the pairs used from the surface."""
    depth_m: float
    """Mean depth of the surface compared."""
    share: float
    """Share of the measured pixels with model surface that agree with it, 0 to 1."""
    overlap: float
    """Share of the picture that was compared."""
    free: NDArray[np.float64]
    """[k, 6] directions (rotation * radius, translation; world axes) that the scene does not fix: not moved."""
    iterations: int


def finest_level(camera: CameraModel) -> int:
    """How many times pictures are halved before they are compared."""
    return max(0, round(float(np.log2(camera.width / _FINEST_WIDTH_PX))))


def level_intrinsics(camera: CameraModel, level: int) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a depth picture halved `level` times."""
    scale = 0.5**level
    shift = 0.5 - 0.5 * scale  # the centre of a block of pixels is not its first pixel's
    return camera.fx * scale, camera.fy * scale, camera.cx * scale - shift, camera.cy * scale - shift


def depth_pyramid(engine: Engine, camera: CameraModel, depth_m: cl_array.Array) -> Pyramid:
    """The levels used of depth [h, w] (0 = none), halved without mixing surfaces. Valid until the next call."""
    finest, levels = finest_level(camera), [depth_m]
    for level in range(1, finest + _LEVELS):
        width, height = _size(camera, level)
        halved = engine.buffers(_Buffers).depth_m[level].array((height, width))
        engine.launch(
            engine.kernel("track.cl", "halve_depth", ROWS=_ROWS),
            (width, height),
            width,
            height,
            _size(camera, level - 1)[0],
            levels[-1],
            _EDGE,
            halved,
        )
        levels.append(halved)
    return tuple(levels[finest:])


def view_model(
    engine: Engine, camera: CameraModel, volume_from_camera: NDArray[np.float64], model: Surface, buffers: ViewBuffers
) -> ModelView:
    """A copy of the surface predicted at `volume_from_camera`, for `register`. Valid until `buffers` are used again."""
    levels = []
    for level in range(finest_level(camera), finest_level(camera) + _LEVELS):
        width, height = _size(camera, level)
        pitch = _pitch(width)
        planes = buffers.levels[level].array((4, height, pitch))
        engine.launch(
            engine.kernel("track.cl", "view_model", ROWS=_ROWS),
            (pitch, height),
            width,
            height,
            pitch,
            1 << level,
            camera.width,
            model.positions,
            model.normals,
            float16(inverse_rigid(volume_from_camera)),
            planes,
        )
        levels.append(planes)
    return ModelView(tuple(levels), volume_from_camera)


def register(
    engine: Engine,
    camera: CameraModel,
    view: ModelView,
    pyramid: Pyramid,
    guess: NDArray[np.float64],
    tolerance_m: float,
) -> Registration | None:
    """Register the measured depth with the model, starting at `guess` (volume_from_camera); None without overlap.

    `tolerance_m`: directions that the scene fixes less accurately stay as in the guess.
    """
    model_from_current = inverse_rigid(view.volume_from_camera) @ guess
    cutoff, sums, iterations = _WIDEST_CUTOFF, None, 0
    free = np.empty((0, 6))
    for rung in reversed(range(_LEVELS)):
        level = finest_level(camera) + rung
        for _ in range(_ITERATIONS[rung]):
            sums = _sum_equations(
                engine, camera, view.levels[rung], pyramid[rung], level, model_from_current, cutoff, _GATES_M[rung]
            )
            iterations += 1
            if sums.weight < 6:
                return None
            spread = min(_WIDEST_CUTOFF, 4.685 * sums.deviation)
            cutoff = max(_CLOSEST_CUTOFF, spread)
            correlated = max(CORRELATED_PIXELS / 4**level, 1.0) * max(sums.deviation, 1.0) ** 2
            least = least_information(correlated, tolerance_m, NORMAL_NOISE_RAD, sums.total_information)
            solution = solve_where_fixed(sums.information, sums.gradient, sums.scale(camera), least)
            model_from_current = motion_of_twist(solution.twist) @ model_from_current
            free = solution.free
            if solution.step_m < _CONVERGED_M * 4**rung:
                break
    assert sums is not None
    pose = repaired_pose(view.volume_from_camera @ model_from_current)  # products of rotations drift from rotations
    world_from_view = np.kron(np.eye(2), view.volume_from_camera[:3, :3])
    return Registration(
        pose,
        NOISE_M * sums.deviation,
        sums.depth_m,
        sums.share,
        sums.overlap(camera),
        free @ world_from_view.T,
        iterations,
    )


@dataclass(frozen=True)
class _Equations:
    """Sums of sum_equations in track.cl."""

    values: NDArray[np.float64]
    level: int

    @property
    def information(self) -> NDArray[np.float64]:
        return symmetric(self.values[:21])

    @property
    def gradient(self) -> NDArray[np.float64]:
        return self.values[21:27]

    @property
    def weight(self) -> float:
        return float(self.values[28])

    @property
    def deviation(self) -> float:
        return float(np.sqrt(self.values[27] / self.values[28]))

    @property
    def depth_m(self) -> float:
        return float(self.values[29] / self.values[28])

    @property
    def share(self) -> float:
        return float(self.values[28] / max(self.values[30], 1.0))

    @property
    def total_information(self) -> float:
        """Sum of w / sigma^2, 1/m^2: the normals are unit vectors."""
        return float(self.values[[15, 18, 20]].sum())

    def overlap(self, camera: CameraModel) -> float:
        width, height = _size(camera, self.level)
        return float(self.values[30] / (width * height))

    def scale(self, camera: CameraModel) -> Scale:
        """Centre and radius of the surface that a picture at this mean depth shows."""
        depth_m = self.depth_m
        half_diagonal = 0.5 * np.hypot(camera.width / camera.fx, camera.height / camera.fy)
        return Scale(np.array([0.0, 0.0, depth_m]), max(depth_m * half_diagonal / np.sqrt(3), 1e-3))


def _sum_equations(
    engine: Engine,
    camera: CameraModel,
    view: cl_array.Array,
    depth_m: cl_array.Array,
    level: int,
    model_from_current: NDArray[np.float64],
    cutoff: float,
    gate_m: float,
) -> _Equations:
    width, height = _size(camera, level)
    columns, strips = _pitch(width) // _LANES, -(-height // _ROWS)
    partial = engine.buffers(_Buffers).sums[level].array((columns * strips, _SUMS))
    scale = 0.5**level
    engine.launch(
        engine.kernel("track.cl", "sum_equations", ROWS=_ROWS),
        (columns, strips),
        cl_types.make_int2(width, height),  # type: ignore[attr-defined]
        _pitch(width),
        view,
        depth_m,
        float4(camera.fx * scale, camera.fy * scale, camera.cx * scale, camera.cy * scale),
        float4(*level_intrinsics(camera, level)),
        float16(model_from_current),
        float16(inverse_rigid(model_from_current)),
        NOISE_M,
        cutoff,
        gate_m,
        partial,
    )
    return _Equations(engine.download(partial).sum(axis=0, dtype=np.float64), level)


def _size(camera: CameraModel, level: int) -> tuple[int, int]:
    return camera.width >> level, camera.height >> level


def _pitch(width: int) -> int:
    return -(-width // _LANES) * _LANES

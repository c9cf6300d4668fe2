"""The bust `rgbd_socrates_natural_light`: real photographs under a room's own light, geometry given.

The light has no label. What can be judged: how much of the shading one light explains in all views (R2 of luminance),
beside the 9-coefficient least-squares fit without visibility that is customary, and whether views agree.

Points seen in two views say what no light of their own says: the pictures differ by a factor each (exposure), and a
point is the darker the more it faces the camera. Both go into the model: exposure_i (T x - hidden max(n . v, 0)).
The latter is the shading that light from behind the camera would give: whoever holds the camera hides it (rough plaster
looks alike). A single view cannot tell it from the light.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from server.geometry.geometry import Geometry
from server.light.light_estimation import prior_precision
from server.maths.bayes import NormalEquations, solve_with_evidence
from server.maths.dominant import dominant_lights
from server.maths.sh import LUMINANCE, dominant_direction, sh_basis
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.transfer.radiance_transfer import direction_sets, transfer_radiance

BANDS = 5
VIEWS = 4
_SHRINK = 4
_STRIDE = 3
_VOXEL_M = 0.003
_MARGIN_M = 0.03
_RAYS = 256
_ROOM_M = 1000.0
_PASSES = 4  # over the views, so that the volume averages the depth's millimetre steps
_LEAST_OPENNESS = 0.3
_POOL = 100.0
"""How many samples share their errors: dirt and chisel marks are larger than a pixel."""
_HIDDEN_PRECISION = 1e-3  # beside the light's, which begins at 1: as good as free
_MOST_TURNS = 100
_SETTLED = 1e-6

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class BustView:
    """The samples of one photograph, world axes."""

    normals: Floats
    """[n, 3]."""
    transfer: Floats
    """[n, 25] with the bust's own visibility."""
    facing: Floats
    """[n] cosine between the normal and the direction to the camera."""
    luminance: Floats
    """[n] linear."""


@dataclass(frozen=True)
class BustLight:
    """One light for some views."""

    sh: Floats
    """[25] luminance, times the bust's albedo."""
    explained: float
    """R2: share of the luminance's variance."""
    direction: Floats
    """[3] towards its strongest part, fitted to the pictures; zeros where there is none."""
    linear_direction: Floats
    """[3] of its l = 1 coefficients."""


@dataclass(frozen=True)
class ViewEffects:
    """What differs between the pictures without being light of the room."""

    exposures: Floats
    """[views] factors of mean 1."""
    hidden: float
    """Luminance that surfaces which face the camera lack."""


def read_views(folder: Path, device: Device) -> list[BustView]:
    """Fuse the depth and trace visibility. Raises OSError where a picture is missing."""
    numbers = np.loadtxt(folder / "intrinsics.txt").ravel()
    camera, frames = _frames(folder, numbers)
    engine = Engine(device)
    try:
        geometry = Geometry(engine, camera, Wishes(volume_m=_bounds(camera, frames), voxel_m=_VOXEL_M, poses="given"))
        for frame in frames * _PASSES:
            geometry.scan(frame)
        return [_view(engine, camera, geometry, frame) for frame in frames]
    finally:
        engine.close()


def fit_light(views: list[BustView]) -> BustLight:
    """One light for all of `views`, by the estimator's solver."""
    transfer = np.concatenate([view.transfer for view in views])
    luminance = np.concatenate([view.luminance for view in views])
    equations = _equations(transfer, luminance)
    light = solve_with_evidence(equations, prior_precision(BANDS)).mean
    gray = np.repeat(light, 3, axis=1)
    strongest = dominant_lights(gray, equations.matrix, most=1)
    return BustLight(
        sh=light[:, 0],
        explained=explained(luminance, transfer @ light[:, 0]),
        direction=strongest[0].direction if strongest else np.zeros(3),
        linear_direction=dominant_direction(gray),
    )


def find_effects(views: list[BustView]) -> ViewEffects:
    """Least squares with the light, in turns: the exposures given the rest, the rest given the exposures."""
    each = [_equations(np.column_stack([v.transfer, -np.maximum(v.facing, 0)]), v.luminance) for v in views]
    precision = np.append(prior_precision(BANDS), _HIDDEN_PRECISION)
    exposures, found = np.ones(len(views)), np.zeros(len(precision))
    for _ in range(_MOST_TURNS):
        before = exposures
        whole = sum(
            (_exposed(e, x) for e, x in zip(each[1:], exposures[1:], strict=True)), _exposed(each[0], exposures[0])
        )
        found = solve_with_evidence(whole, precision).mean[:, 0]
        exposures = np.array([(found @ e.vector[:, 0]) / (found @ e.matrix @ found) for e in each])
        exposures /= exposures.mean()
        if np.abs(exposures - before).max() < _SETTLED:
            break
    return ViewEffects(exposures, float(found[-1]))


def without_effects(views: list[BustView], effects: ViewEffects) -> list[BustView]:
    """The views as one camera without anybody behind it would have seen them."""
    return [
        replace(view, luminance=view.luminance / exposure + effects.hidden * np.maximum(view.facing, 0))
        for view, exposure in zip(views, effects.exposures, strict=True)
    ]


def plain_fit(views: list[BustView]) -> float:
    """R2 of the customary fit: 9 coefficients of the normal alone, least squares."""
    basis = sh_basis(np.concatenate([view.normals for view in views]), 3)
    luminance = np.concatenate([view.luminance for view in views])
    return explained(luminance, basis @ np.linalg.lstsq(basis, luminance, rcond=None)[0])


def _equations(transfer: Floats, luminance: Floats) -> NormalEquations:
    sums = NormalEquations(
        transfer.T @ transfer, (transfer.T @ luminance)[:, None], np.array([luminance @ luminance]), len(luminance)
    )
    return sums.scaled(1 / _POOL)


def _exposed(equations: NormalEquations, exposure: float) -> NormalEquations:
    """The same samples of a transfer that is `exposure` times as large."""
    return replace(equations, matrix=equations.matrix * exposure**2, vector=equations.vector * exposure)


def explained(seen: Floats, modelled: Floats) -> float:
    """R2: 1 less the residual's share of the variance."""
    return float(1 - np.sum((seen - modelled) ** 2) / np.sum((seen - seen.mean()) ** 2))


def _frames(folder: Path, numbers: Floats) -> tuple[CameraModel, list[RgbdFrame]]:
    """The views, shrunk."""
    frames = []
    poses = np.loadtxt(folder / "pose.txt")
    for number in range(1, VIEWS + 1):
        color = cv2.imread(str(folder / f"color{number:06d}.png"), cv2.IMREAD_COLOR)
        depth = cv2.imread(str(folder / f"depth{number:06d}.png"), cv2.IMREAD_UNCHANGED)
        if color is None or depth is None:
            raise OSError(f"view {number} of {folder} cannot be read")
        height, width = (side // _SHRINK for side in depth.shape)
        whole = color[: height * _SHRINK, : width * _SHRINK]
        small = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
        pose = next(row for row in poses if int(row[0]) == number)
        world_from_camera = np.eye(4)
        world_from_camera[:3, :3] = _rotation(pose[4:])
        world_from_camera[:3, 3] = pose[1:4]
        frames.append(
            RgbdFrame(
                index=number - 1,
                timestamp_s=float(number - 1),
                color=np.ascontiguousarray(small[..., ::-1], np.uint8),
                depth=np.ascontiguousarray(depth[_SHRINK // 2 :: _SHRINK, _SHRINK // 2 :: _SHRINK][:height, :width]),
                world_from_camera=world_from_camera,
            )
        )
    fx, _, cx, _, fy, cy = numbers[:6]
    camera = CameraModel(
        width=width,
        height=height,
        fx=float(fx / _SHRINK),
        fy=float(fy / _SHRINK),
        cx=float((cx + 0.5) / _SHRINK - 0.5),
        cy=float((cy + 0.5) / _SHRINK - 0.5),
    )
    return camera, frames


def _rotation(quaternion: Floats) -> Floats:
    """[3, 3] of x, y, z, w."""
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross)


def _bounds(camera: CameraModel, frames: list[RgbdFrame]) -> tuple[float, float, float, float, float, float]:
    """World metres around all that has depth."""
    points = []
    for frame in frames:
        v, u = np.nonzero(frame.depth)
        z = frame.depth[v, u] * camera.depth_scale_m
        in_camera = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1)
        assert frame.world_from_camera is not None
        points.append(in_camera @ frame.world_from_camera[:3, :3].T + frame.world_from_camera[:3, 3])
    low, high = np.percentile(np.concatenate(points), (0.1, 99.9), axis=0)
    x0, y0, z0, x1, y1, z1 = (float(value) for value in (*(low - _MARGIN_M), *(high + _MARGIN_M)))
    return x0, y0, z0, x1, y1, z1


def _view(engine: Engine, camera: CameraModel, geometry: Geometry, frame: RgbdFrame) -> BustView:
    """The samples of one frame against the fused bust."""
    now = geometry.scan(frame)
    assert geometry.volume is not None
    rays = direction_sets(_RAYS, BANDS)
    transfer = transfer_radiance(engine, camera, geometry.volume, now.model, _STRIDE, rays, _ROOM_M)
    openness = engine.download(transfer.openness)
    rows, columns = openness.shape

    def sampled(buffer: cl_array.Array) -> Floats:
        """[rows, columns, 4] of a float4 picture, which comes as four named fields."""
        whole = engine.download(buffer).view(np.float32).reshape(camera.height, camera.width, 4)
        at = np.s_[_STRIDE // 2 :: _STRIDE]
        return whole[at, at][:rows, :columns].astype(np.float64)

    normals, positions = sampled(now.model.normals), sampled(now.model.positions)
    radiance = sampled(now.measurement.radiance)
    usable = (normals[..., 3] > 0) & (openness > _LEAST_OPENNESS) & (radiance[..., 3] > 0)
    to_camera = now.volume_from_camera[:3, 3] - positions[usable][:, :3]
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    return BustView(
        normals=normals[usable][:, :3],
        transfer=engine.download(transfer.coefficients)[usable].astype(np.float64),
        facing=np.sum(normals[usable][:, :3] * to_camera, axis=1),
        luminance=radiance[usable][:, :3] @ LUMINANCE,
    )

"""Transfer, lamps, volume and ray cast: nothing in view, much too far, much too near, after very many frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from server.light.near_light import Emitters
from server.volume.integrate import GREATEST_WEIGHT, integrate
from server.volume.volume import Volume
from tests.hard_cases.catalogue import Family, Floats, Found, Trial, share_beyond
from tests.reference.integrate import voxel_centers
from tests.reference.sh import open_transfer
from tests.scenes import fused_scenes
from tests.scenes.analytic import look, look_at
from tests.scenes.fused_scenes import CAMERA
from tests.scenes.light_samples import samples_of
from tests.scenes.solids import SCENES, fill_volume, normal_at
from tests.scenes.traced_points import trace
from tests.scenes.volumes import cast, dense_voxels, fill, fuse, upload_measurement

TRANSFER, VOLUME = Family("transfer"), Family("volume")
VOXEL_M = 0.01
_UP = np.array([0.0, 1.0, 0.0])
_BOUNDS = (-0.16, -0.16, 1.0, 0.16, 0.16, 1.32)
_WALL_M = 1.14

# ---- transfer ----------------------------------------------------------------------------------------------------


def _inside(side: int = 64) -> Floats:
    return np.random.default_rng(0).uniform(0.02, 0.94, (side, 3))


@TRANSFER.case("empty volume", 4e-6, "absolute", "no ray is blocked, so transfer is the open one, in float32.")
def empty_volume(trial: Trial) -> Found:
    volume = Volume(trial.engine, (0, 0, 0, 1, 1, 1), VOXEL_M)
    traced = trace(trial.engine, volume, _inside(), np.tile(_UP, (64, 1)))
    found = np.concatenate([traced.transfer.reshape(64, -1), traced.openness.reshape(64, 1)], axis=1)
    return Found(found, np.append(open_transfer(_UP, 4), 1.0))


@TRANSFER.case(
    "zero normals", 0, "absolute", "no direction lies above no normal: the sample is marked and nothing is made of it."
)
def zero_normals(trial: Trial) -> Found:
    """Openness is -1, so estimation and rendering leave such samples out."""
    volume = fill_volume(trial.engine, SCENES["ball above a floor"], VOXEL_M)
    traced = trace(trial.engine, volume, _inside(), np.zeros((64, 3)))
    return Found([traced.openness.ravel(), traced.free.reshape(64, -1).any(1)], [[-1.0], [0.0]])


@TRANSFER.case(
    "inside a solid body",
    0.02,
    "of the sky",
    "seen voxels behind a surface reach a truncation deep and hide the sky; what is left are rays between "
    "voxels' corners.",
)
def inside_a_body(trial: Trial) -> Found:
    """Points two voxels below the floor, looking up through it."""
    scene = SCENES["ball above a floor"]
    points = np.column_stack([np.linspace(0.2, 0.8, 64), np.full(64, 0.1 - 3 * VOXEL_M), np.full(64, 0.15)])
    traced = trace(trial.engine, fill_volume(trial.engine, scene, VOXEL_M), points, np.tile(_UP, (64, 1)))
    return Found(traced.openness, 0.0)


@TRANSFER.case(
    "normals that point into the surface",
    0.05,
    "of the sky",
    "the body hides all that the normal faces but for rays between voxels' corners; nothing else comes of it.",
)
def inverted_normals(trial: Trial) -> Found:
    scene = SCENES["ball above a floor"]
    points = np.column_stack([np.linspace(0.1, 0.86, 64), np.full(64, 0.1), np.full(64, 0.15)])
    normals = -normal_at(scene, points)
    traced = trace(trial.engine, fill_volume(trial.engine, scene, VOXEL_M), points, normals)
    return Found(np.append(traced.openness.ravel(), np.abs(traced.transfer).max()), 0.0)


@TRANSFER.case(
    "a lamp from 10 m down to nothing",
    1e-5,
    "relative",
    "a form factor is ten float32 operations; nearer than 0.1 mm it is not known and left out: exactly zero.",
)
def lamp_at_no_distance(trial: Trial) -> Found:
    volume = Volume(trial.engine, (0, 0, 0, 1, 1, 1), VOXEL_M)
    point = np.array([[0.5, 0.5, 0.5]])
    heights = np.array([10.0, 1.0, 0.1, 0.01, 1e-3, 1e-5, 0.0, -1e-5, -1.0])
    emitters = (point + heights[:, None] * _UP).astype(np.float32).astype(np.float64)
    shares = Emitters(trial.engine, volume, samples_of(point, _UP[None])).shares(emitters)[:, 0]
    height = (emitters - point)[:, 1]
    lit = height > 1e-4
    exact = np.where(lit, 1 / (np.pi * np.where(lit, height, 1) ** 2), 0)
    return Found(shares / np.where(lit, exact, 1), lit)


# ---- volume ------------------------------------------------------------------------------------------------------


def _fused(trial: Trial, volume: Volume, depth_m: float, frames: int) -> None:
    pose = volume.volume_from_world()
    measurement = upload_measurement(trial.engine, np.full((CAMERA.height, CAMERA.width), depth_m))
    volume.allocate(CAMERA, pose, measurement.depth_m)
    for frame in range(frames):
        integrate(trial.engine, volume, CAMERA, pose, measurement)
        if frame % 100 == 99:
            trial.engine.queue.finish()
            trial.engine.profile.begin()


def _told(volume: Volume, depth_m: float) -> tuple[Floats, Floats]:
    """Signed distance over the truncation and weight of one frame of a wall, [z, y, x], in closed form."""
    shape = tuple(8 * count for count in reversed(volume.bricks))
    centers = voxel_centers(shape, volume.voxel_m) + volume.origin_world
    along = np.linalg.norm(centers, axis=-1) / centers[..., 2]
    signed = (depth_m - centers[..., 2]) * along / volume.truncation_m
    return np.minimum(signed, 1), signed > -1


_MIDDLE = (slice(5, 9), slice(6, 10), slice(6, 10))


@VOLUME.case(
    "weight after 1 000 000 frames",
    1e-5,
    "of the truncation",
    "the running mean's weight stays at 64, and a mean of equal values rounds to itself: 10 float32 operations.",
)
def million_frames(trial: Trial) -> Found:
    """What a million frames leave is put there, and some more are fused: full or overfull weights come to the same."""
    results = []
    for weight in (GREATEST_WEIGHT, 1e6):
        volume = Volume(trial.engine, _BOUNDS, 0.02)
        tsdf, seen = _told(volume, _WALL_M)
        fill(trial.engine, volume, tsdf, weight * seen)
        for _ in range(1_000_000):
            volume.count_frame()
        _fused(trial, volume, _WALL_M, trial.of(50, 2000))
        after, weights, _ = dense_voxels(trial.engine, volume)
        results.append(np.stack([after[_MIDDLE] - tsdf[_MIDDLE], weights[_MIDDLE] / GREATEST_WEIGHT - 1]))
    return Found(results, 0.0)


@VOLUME.case(
    "10 000 frames of one wall",
    2.0**-22,
    "of the truncation",
    "a difference of zero is added exactly, and that of one rounding is divided by the weight: two roundings at most.",
    checkable=False,
)
def ten_thousand(trial: Trial) -> Found:
    volume = Volume(trial.engine, _BOUNDS, 0.02)
    _fused(trial, volume, _WALL_M, 1)
    first = dense_voxels(trial.engine, volume)[0]
    _fused(trial, volume, _WALL_M, trial.of(500, 10_000))
    return Found(dense_voxels(trial.engine, volume)[0], first)


@VOLUME.case(
    "depth that is not a number, infinite, negative",
    0,
    "voxels",
    "a pixel without a depth in (0, 10 m] tells nothing: no voxel changes, and none is made.",
)
def no_depth(trial: Trial) -> Found:
    found = []
    for value in (np.nan, np.inf, -np.inf, -1.0, 0.0, 1.7e7):
        volume = Volume(trial.engine, _BOUNDS, 0.02)
        fuse(trial.engine, volume, CAMERA, np.eye(4), np.full((CAMERA.height, CAMERA.width), value))
        tsdf, weight, _ = dense_voxels(trial.engine, volume)
        found.append([float((~np.isfinite(tsdf)).sum()), float((tsdf < 1).sum()), float((~np.isfinite(weight)).sum())])
    return Found(found, 0.0)


@VOLUME.case("empty, from inside, outside and 9 km off", 0, "hits", "there is no surface to see.")
def empty(trial: Trial) -> Found:
    volume = Volume(trial.engine, fused_scenes.BOUNDS, 0.04)
    eyes = ((0, 0, 0), (0, 0, -4), (9e3, 0, 0))
    views = [look_at(eye, (0.01, 0.0, 0.02)) for eye in eyes]
    return Found([float(cast(trial.engine, volume, CAMERA, view)[0].sum()) for view in views], 0)


def _seen_from(trial: Trial, offset: Floats) -> tuple[NDArray[np.bool_], Floats]:
    """Hits and depths of tilted planes, the whole of it moved by `offset`."""
    scene, views, new = fused_scenes.SCENES["tilted planes"]
    bounds = tuple(float(v) for v in np.array(fused_scenes.BOUNDS) + np.tile(offset, 2))
    volume = Volume(trial.engine, bounds, 0.04)  # type: ignore[arg-type]

    def moved(view: Floats) -> Floats:
        result = view.copy()
        result[:3, 3] += offset
        return result

    for view in views:
        fuse(trial.engine, volume, CAMERA, moved(view), look(scene, CAMERA, view).depth_m)
    hit, depth, _ = cast(trial.engine, volume, CAMERA, moved(new))
    return hit, depth


for _offset in (10.0, 1e4, 1e6):

    @VOLUME.case(
        f"{_offset:.0f} m from the origin",
        5e-3,
        "share of pixels off by 0.1 mm",
        "poses are taken relative to the volume in float64, whose 2^-52 of 1000 km is far below a float32's rounding; "
        "voxels at the border of what was seen may fall on either side.",
        distance=share_beyond(1e-4),
    )
    def far_away(trial: Trial, offset: float = _offset) -> Found:
        near, far = _seen_from(trial, np.zeros(3)), _seen_from(trial, offset * np.array([1.0, 0.25, -1.0]))
        return Found(np.where(far[0], far[1], 0), np.where(near[0], near[1], 0))


@VOLUME.case(
    "a camera inside the surface",
    0,
    "pixels",
    "from behind a surface its back is not shown, and there is nothing beyond it.",
)
def inside_surface(trial: Trial) -> Found:
    """3 cm inside a wall."""
    camera = CAMERA
    views = [look_at((0, 0, -1), (0, 0, 1))]
    volume = Volume(trial.engine, fused_scenes.BOUNDS, 0.04)
    for view in views:
        fuse(trial.engine, volume, camera, view, np.full((camera.height, camera.width), 1.5))
    hit, depth, _ = cast(trial.engine, volume, camera, look_at((0.0, 0.0, 0.53), (0.0, 0.0, 2.0)))
    return Found([float(hit.sum()), float((~np.isfinite(depth)).sum())], 0)

"""Consistent shadows (thesis 7.3.2, fig. 7.8): a real occluder leaves the picture, its shadow on a virtual ball stays.

The camera stands still and turns away from a slab that shades the ball, until nothing of the slab is in view. The same
points of the ball are looked up before and after. The slab's shadow is what it takes from them: the sequence without
the slab minus the one with it. The light is given; nothing is learnt from the camera's pictures.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from client.synthetic.lighting.bake import blocked_directions
from client.synthetic.lighting.lights import disc_light
from client.synthetic.render import camera_rays, cast, look_at
from client.synthetic.solids.polyhedra import Solid, box
from client.synthetic.source import FOCAL_OF_WIDTH
from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from server.maths.sh import sh_basis, spherical_fibonacci
from server.scene.colors import linear_from_srgb
from tests.bench.light.runs import at_preset, refusal, results_of
from tests.bench.rendering.common import OUT, PRESETS
from tests.bench.rendering.flip import Codes
from tests.bench.rendering.pictures import bgr, save_jpeg
from tests.bench.report.drawing import side_by_side
from tests.bench.report.finished import Part
from tests.bench.report.run import Run
from tests.bench.truth.composite_truth import linear_from_codes
from tests.scenes.plain_light import PLAIN_LIGHT

Floats = NDArray[np.float64]

SIZE = (320, 240)
EYE = np.array([0.05, 0.42, 1.0])
UP = np.array([0.0, 1.0, 0.0])
TOWARDS_LIGHT = np.array([-0.78, 0.6, 0.17])
BALL_CENTER, BALL_RADIUS_M, BALL_SRGB = np.array([0.05, 0.09, 0.0]), 0.09, 200
TABLE = box((0, -0.02, 0), (1.6, 0.04, 1.0))
SLAB = box((-0.19, 0.15, -0.02), (0.03, 0.3, 0.26))
VOLUME_M, VOXEL_M = (-0.7, -0.1, -0.55, 0.7, 0.5, 0.55), 0.005
COLORS = np.array([(150, 140, 125), (95, 140, 100), (60, 60, 60)], np.uint8)
"""sRGB of the table, the slab, and nothing."""
START_DEG, TURN_DEG = -6.0, 30.0
"""To the right of the ball: where the camera looks at first, and how far it turns."""
STILL, TURNING = 6, 12
QUICK_STILL, QUICK_TURNING = 3, 4
AVERAGED = 3
"""Frames at the end of each stillness: directions take turns from frame to frame."""
POINTS, DIRECTIONS = 3000, 4096
LEAST_FACING = 0.35
"""Cosine between a looked-up point's normal and the way to the camera."""
CHANGE_GOAL_PERCENT = 5


@dataclass(frozen=True)
class Turn:
    """The frames: still, turning, still."""

    still: int
    turning: int

    def poses(self) -> list[Floats]:
        """world_from_camera of each."""
        shares = [0.0] * self.still + [(i + 1) / self.turning for i in range(self.turning)] + [1.0] * self.still
        return [pose_at(START_DEG + share * TURN_DEG) for share in shares]

    def frames(self, solids: list[Solid]) -> Iterator[RgbdFrame]:
        """Exact depth; colours tell the solids apart, light is not shown."""
        camera = turning_camera()
        rays = camera_rays(camera)
        for index, pose in enumerate(self.poses()):
            depth_m, owner = cast(solids, camera, rays, pose)
            units = np.where(np.isfinite(depth_m), depth_m / camera.depth_scale_m, 0).round()
            depth = units.astype(np.uint16).reshape(camera.height, camera.width)
            color = COLORS[owner].reshape(camera.height, camera.width, 3)
            yield RgbdFrame(index, index / 30, color, depth, pose)


def turning_camera() -> CameraModel:
    """Of all frames."""
    width, height = SIZE
    focal = FOCAL_OF_WIDTH * width
    return CameraModel(width=width, height=height, fx=focal, fy=focal, cx=(width - 1) / 2, cy=(height - 1) / 2)


def pose_at(right_deg: float) -> Floats:
    """world_from_camera, looking so far to the right of the ball."""
    forward = BALL_CENTER - EYE
    angle = math.radians(-right_deg)
    turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    return look_at(EYE, EYE + turn @ forward, UP)


def ball_points() -> tuple[Floats, Floats]:
    """Points [n, 3] of the ball that the camera sees well, and their normals."""
    normals = spherical_fibonacci(POINTS)
    points = BALL_CENTER + BALL_RADIUS_M * normals
    towards = (EYE - points) / np.linalg.norm(EYE - points, axis=1, keepdims=True)
    facing = (normals * towards).sum(axis=1) > LEAST_FACING
    return points[facing], normals[facing]


def pixels_of(points: Floats, pose: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Row and column of each point. Raises ValueError where one is not in the picture."""
    camera = turning_camera()
    x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
    u, v = np.rint(x / z * camera.fx + camera.cx).astype(int), np.rint(y / z * camera.fy + camera.cy).astype(int)
    if u.min() < 0 or v.min() < 0 or u.max() >= camera.width or v.max() >= camera.height:
        raise ValueError("a point of the ball is not in the picture")
    return v, u


def exact_shadow(light: Floats) -> Floats:
    """[n, 3] radiance that the slab alone takes from the ball's points."""
    points, normals = ball_points()
    directions = spherical_fibonacci(DIRECTIONS)
    arriving = sh_basis(directions, 4) @ light * (4 / DIRECTIONS)  # 4 pi / n of solid angle each, over pi
    blocked = [
        blocked_directions([solid], None, points.astype(np.float32), directions.astype(np.float32))
        for solid in (SLAB, TABLE)
    ]
    cosines = np.maximum(normals @ directions.T, 0)
    return _albedo() * ((cosines * (blocked[0] & ~blocked[1])) @ arriving)


def turning_part(run: Run) -> Part:
    """Rows of every preset, and the pictures before and after."""
    turn = Turn(run.of(QUICK_STILL, STILL), run.of(QUICK_TURNING, TURNING))
    part = Part(sizes={"frames of the camera that turns": len(turn.poses())})
    light = disc_light(TOWARDS_LIGHT / np.linalg.norm(TOWARDS_LIGHT)).sh
    ball = write_ball(OUT / "ball.ply")
    true = exact_shadow(light)
    source: Any = SimpleNamespace(camera=turning_camera())
    cells = []
    for preset in PRESETS:
        wishes = at_preset(turning_wishes(light), preset)
        row = f"occluder leaves the picture: {preset.upper()}"
        refused = refusal(wishes)
        if refused:
            part.leave_out(row, refused)
            continue
        run.say(row)
        with_slab, without = (
            [r.color for r in results_of(run.device, source, turn.frames(solids), wishes, [ball])]
            for solids in ([TABLE, SLAB], [TABLE])
        )
        before, after = (shadow_at(turn, with_slab, without, first) for first in (turn.still, len(turn.poses())))
        part.add(f"{row}: its shadow, change", shadow_change(before, after), "%", f"<= {CHANGE_GOAL_PERCENT}")
        part.add(f"{row}: its shadow, change point by point", 100 * _share(np.abs(after - before), before), "%")
        part.add(f"{row}: its shadow over the exact one, before", _share(before, true), "")
        cells += [(f"{preset.upper()}: before", bgr(with_slab[turn.still - 1])), ("after", bgr(with_slab[-1]))]
        cells += [("after, without the slab ever", bgr(without[-1]))]
    if cells:
        save_jpeg(OUT / "turning.jpg", side_by_side(cells, columns=3))
    return part


def turning_wishes(light: Floats) -> Wishes:
    """The light is given, nothing else lights."""
    given = tuple((float(r), float(g), float(b)) for r, g, b in light)
    return Wishes(volume_m=VOLUME_M, voxel_m=VOXEL_M, up=(0.0, 1.0, 0.0), light=given, **PLAIN_LIGHT)


def shadow_at(turn: Turn, with_slab: list[Codes], without: list[Codes], end: int) -> Floats:
    """[n, 3] what the slab takes from the ball's points, mean over the frames before `end`."""
    points, _normals = ball_points()
    taken = []
    for index in range(end - AVERAGED, end):
        at = pixels_of(points, turn.poses()[index])
        taken.append(linear_from_codes(without[index][at]) - linear_from_codes(with_slab[index][at]))
    return np.mean(taken, axis=0)


def shadow_change(before: Floats, after: Floats) -> float:
    """Percent of the whole shadow."""
    return abs(100 * (_share(after, before) - 1))


def write_ball(path: Path) -> Path:
    """The ball as a PLY in world coordinates."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=BALL_RADIUS_M)
    ball.apply_translation(BALL_CENTER)
    ball.visual.vertex_colors = np.full((len(ball.vertices), 4), (*(BALL_SRGB,) * 3, 255), np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(ball.export(file_type="ply"))
    return path


def _albedo() -> float:
    return float(linear_from_srgb(np.array(BALL_SRGB / 255)))


def _share(part: Floats, whole: Floats) -> float:
    return float(part.sum() / whole.sum())

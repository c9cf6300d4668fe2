"""The camera: tracking where the scene does not fix it, depth that is none, pictures of any size."""

from __future__ import annotations

import numpy as np
from msgspec.structs import replace

from server.input.measure import GREATEST_DEPTH_M
from server.maths.registration import motion_of_twist
from server.maths.rigid import inverse_rigid
from tests.hard_cases.catalogue import Family, Floats, Found, Trial
from tests.reference import measure as twin
from tests.scenes.analytic import look
from tests.scenes.raw_frames import PLAIN, frame_of, measured, random_frame
from tests.scenes.tracked_scene import CAMERA, FLAT, SCENE, START, VOXEL_M, moved, world

TRACKING, INPUT = Family("tracking"), Family("input")
_SHARE = 0.05 * VOXEL_M

# ---- tracking ----------------------------------------------------------------------------------------------------


def _fixed_part(name: str, change: Floats, origin: Floats) -> Floats:
    """What of a motion (from found to true, world axes) the scene would show, in metres."""
    if name == "sphere":
        center = np.array([0.1, 0.2, 1.3, 1.0]) - [*origin, 0.0]
        return np.asarray((change @ center - center)[:3])
    points = np.array([[0.3, 0.4, 1.4, 1.0], [-0.3, 0.4, 1.4, 1.0], [0.2, -0.2, 1.2, 1.0]]) - [*origin, 0.0]
    shifts = (points @ change.T - points)[:, :3]
    normals = {
        "plane": [(0.2, 0.1, -1.0)],
        "corridor": [(0, 1, 0), (-1, 0, -0.6)],
        "two planes": [(0, 1, 0), (0, 0, 1)],
    }[name]
    return np.array([shifts @ np.array(n, float) / np.linalg.norm(n) for n in normals]).ravel()


for _name in FLAT:

    @TRACKING.case(
        f"{_name}, 2 mm of noise",
        _SHARE,
        "m",
        "2 mm over 19 000 pixels of which one in 64 counts is 0.1 mm; the volume's surface is right to a "
        "twentieth of a voxel.",
        known=False,
    )
    def unfixed(trial: Trial, name: str = _name) -> Found:
        """The motions that the scene shows are found, the others are named; `known` says whether none were named."""
        shapes, free = FLAT[name]
        scene = world(trial.engine, shapes)
        truth = moved(np.radians(0.5), 0.01, seed=2)
        depth = look(shapes, CAMERA, truth).depth_m
        noise = np.random.default_rng(0).normal(0, 0.002, depth.shape)
        found = scene.register(np.where((depth > 0) & (depth < 3), depth + noise, 0), START)
        assert found is not None
        expected = scene.volume.volume_from_world() @ truth
        change = expected @ inverse_rigid(found.volume_from_camera)
        part = _fixed_part(name, change, scene.volume.origin_world)
        return Found(np.append(part, len(found.free) - free), 0, known=not len(found.free))


@TRACKING.case(
    "a camera that stands still",
    2e-5,
    "m",
    "iterations end below 0.02 mm, and one picture on one model always ends at one place: it does not creep.",
    known=True,
)
def still(trial: Trial) -> Found:
    scene, depth, guess, found = world(trial.engine), look(SCENE, CAMERA, START).depth_m, START, []
    for _ in range(trial.of(10, 300)):
        registered = scene.register(depth, guess)
        assert registered is not None
        guess = inverse_rigid(scene.volume.volume_from_world()) @ registered.volume_from_camera
        found.append(guess[:3, 3].copy())
    return Found(found[-1], found[3], known=not len(registered.free))


@TRACKING.case(
    "a jump of 6 cm and 4 degrees",
    _SHARE,
    "m",
    "the scene fixes all motions; a twentieth of a voxel is what its quantised surface leaves.",
    known=True,
)
def jump(trial: Trial) -> Found:
    scene, truth = world(trial.engine), moved(np.radians(4.0), 0.06, 1)
    found = scene.register(look(SCENE, CAMERA, truth).depth_m, START)
    assert found is not None
    expected = scene.volume.volume_from_world() @ truth
    return Found(found.volume_from_camera[:3, 3], expected[:3, 3], known=not len(found.free))


@TRACKING.case(
    "pictures that do not meet",
    0,
    "registrations",
    "where fewer than six pixels are compared there is no motion to find, and none is made up.",
)
def no_meeting(trial: Trial) -> Found:
    scene = world(trial.engine)
    blind = [np.full((120, 160), depth) for depth in (0.0, 0.02, 9.0, np.nan, np.inf)]
    turned = START @ motion_of_twist(np.array([0, np.pi, 0, 0, 0, 0]))
    found = [scene.register(depth, START) for depth in blind]
    found.append(scene.register(look(SCENE, CAMERA, START).depth_m, turned))
    return Found([float(f is not None) for f in found], 0)


# ---- input -------------------------------------------------------------------------------------------------------


@INPUT.case(
    "depth of 0, 65535, 10 m and beyond, in any unit",
    1e-6,
    "relative",
    "a product of two float32; 0, 65535 and what is beyond 10 m are no measurement: exactly zero.",
)
def special_depths(trial: Trial) -> Found:
    units = np.array([0, 1, 9_999, 10_000, 10_001, 40_000, 65_534, 65_535], np.uint16)
    found, truth = [], []
    for scale in (1e-9, 1e-4, 1e-3, 1.0, 260.0, 1e30):
        camera = replace(PLAIN, width=8, height=8, depth_scale_m=scale)
        _, metres = measured(trial.engine, camera, frame_of(np.zeros((8, 8, 3)), np.tile(units, (8, 1)), camera))
        exact = np.where((units == 65_535) | (units * scale > GREATEST_DEPTH_M * (1 + 1e-9)), 0, units * scale)
        found.append(metres[0] / np.where(exact > 0, exact, 1))
        truth.append(exact > 0)
    return Found(found, truth)


for _width, _height in ((8, 8), (9, 11), (15, 17), (33, 31), (64, 65), (129, 9)):

    @INPUT.case(
        f"a picture of {_width}x{_height}",
        1e-6,
        "absolute",
        "one table look-up and one product in float32; work-groups that stick out of the picture write nothing.",
    )
    def partial(trial: Trial, width: int = _width, height: int = _height) -> Found:
        camera = replace(PLAIN, width=width, height=height)
        frame = random_frame(camera, seed=width)
        radiance, depth = measured(trial.engine, camera, frame)
        expected, expected_depth = twin.measure(camera, frame.color, frame.depth, GREATEST_DEPTH_M)
        return Found(
            np.concatenate([radiance, depth[..., None] / 10], axis=-1),
            np.concatenate([expected, expected_depth[..., None] / 10], axis=-1),
        )


@INPUT.case(
    "a lens of 1e30",
    0,
    "values that are no number",
    "what no ray of the picture reaches is outside it; nothing is computed from where it would be.",
)
def extreme_lens(trial: Trial) -> Found:
    camera = replace(PLAIN, distortion=(1e30, -1e30, 1e20, 1e20, 1e38))
    radiance, depth = measured(trial.engine, camera, random_frame(camera, seed=3))
    return Found([float((~np.isfinite(a)).sum()) for a in (radiance, depth)], 0)

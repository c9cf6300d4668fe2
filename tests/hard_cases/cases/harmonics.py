"""Spherical harmonics where their formulas are weakest, and lights that few bands cannot hold."""

from __future__ import annotations

import numpy as np

from server.maths.nonnegative import faded
from server.maths.sh import rotate_sh, spherical_fibonacci
from server.maths.sh import sh_basis as host_basis
from server.opencl.program import with_headers
from tests.hard_cases.catalogue import Family, Floats, Found, Trial
from tests.reference.composite import srgb_codes
from tests.reference.sh import open_transfer, sh_basis
from tests.scenes.composite_scene import NONE_TAKEN, WALL, buffer, camera_picture, compose, plane
from tests.scenes.lights import random_directions, unit
from tests.scenes.own_kernel import own_kernel
from tests.scenes.sh_kernel import AXES, NEAR_POLES, SOURCE

HARMONICS = Family("spherical harmonics")
_SUN = unit([0.3, -0.8, -0.5])


def _evaluate(trial: Trial, directions: Floats, bands: int) -> Floats:
    """[n, bands^2] of include/sh.clh."""
    kernel = own_kernel(trial.device, with_headers(SOURCE, "evaluate.cl"), "evaluate", [f"-DBANDS={bands}"])
    space, count = trial.engine.workspace, len(directions)
    basis = space.array("basis", (count, bands * bands), np.float32)
    lambert = space.array("lambert", (bands,), np.float32)
    device = space.upload("directions", directions.astype(np.float32))
    trial.engine.launch(kernel, (count,), count, device, basis, lambert)
    return trial.engine.download(basis).astype(np.float64)


for _bands in range(2, 7):

    @HARMONICS.case(
        f"axes and poles, {_bands} bands",
        4e-6,
        "absolute",
        "recurrences of a dozen float32 operations on values below 3, so 12 times 3 times 2^-24, and an input rounded.",
    )
    def axes(trial: Trial, bands: int = _bands) -> Found:
        directions = np.concatenate([AXES, NEAR_POLES, random_directions(64, 1)]).astype(np.float32)
        return Found(_evaluate(trial, directions, bands), sh_basis(directions.astype(np.float64), bands))

    @HARMONICS.case(
        f"a zero normal, {_bands} bands",
        0,
        "absolute",
        "all but the bands even in the vector vanish with it exactly, and those are their constants.",
        apart=0,
    )
    def zero_normal(trial: Trial, bands: int = _bands) -> Found:
        found = _evaluate(trial, np.zeros((3, 3)), bands)
        odd = np.array([l % 2 == 1 for l in range(bands) for _ in range(2 * l + 1)])
        return Found(np.where(odd, found, 0), 0)


@HARMONICS.case(
    "a light turned full circle in 360 steps",
    1e-10,
    "of the largest coefficient",
    "each turn solves a system of condition below 10 in float64; 360 errors of 1e-15 add up at most.",
)
def turned(_trial: Trial) -> Found:
    light = random_directions(36, 2) * np.arange(1, 37)[:, None] ** -0.5
    angle = np.deg2rad(1)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    found = light
    for _ in range(360):
        found = rotate_sh(found, turn)
    return Found(found, light)


@HARMONICS.case(
    "a sun in 4 bands, faded",
    0.01,
    "of its mean radiance",
    "1024 probes stand 6 degrees apart; between them a function of 4 bands falls below the least by under 1 % of "
    "its mean.",
)
def sun_faded(_trial: Trial) -> Found:
    light = faded(np.outer(host_basis(_SUN, 4), np.ones(3)))
    radiance = sh_basis(spherical_fibonacci(20_011), 4) @ light
    return Found(np.minimum(radiance, 0) / radiance.mean(), 0)


@HARMONICS.case(
    "a sun in 4 bands on a wall of any normal",
    1,
    "code values",
    "a Lambertian surface's ringing goes 4 % below zero: shading is cut there, and codes round to a neighbour.",
)
def sun_on_walls(trial: Trial) -> Found:
    """The composite's pictures of a virtual wall that turns all around under the sun."""
    light = np.outer(host_basis(_SUN, 4), np.ones(3))
    shown, radiance = camera_picture()
    points, _ = plane(0.8)
    normals = spherical_fibonacci(points[..., 0].size).reshape(points.shape)
    virtual = buffer(points, normals)
    found = compose(trial.engine, shown, radiance, WALL, virtual, NONE_TAKEN, light=light)
    shading = open_transfer(virtual.normals[..., :3], 4) @ light
    assert shading.min() < -0.03 * shading.max()
    return Found(found, srgb_codes(np.maximum(shading, 0) * virtual.colors))

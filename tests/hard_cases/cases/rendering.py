"""Rendering: ratios of almost nothing, coplanar surfaces, triangles through the camera or of no area."""

from __future__ import annotations

import numpy as np

from server.objects.rasterize import NEAR_M
from server.shading.tone_mapping import AverageMemory, Averages
from tests.hard_cases.catalogue import Family, Floats, Found, Trial, share_beyond
from tests.reference import rasterize as raster_twin
from tests.reference.composite import srgb_codes
from tests.reference.sh import open_transfer
from tests.scenes import lights
from tests.scenes.composite_scene import LIGHT as COMPOSITE_LIGHT
from tests.scenes.composite_scene import NONE_TAKEN, WALL, buffer, camera_picture, compose, plane
from tests.scenes.meshes import pose, soup_of
from tests.scenes.shaded_floor import LIGHT, PLATE, shade_floor
from tests.scenes.solids import box
from tests.scenes.soups import CAMERA as SOUP_CAMERA
from tests.scenes.soups import EXACT, EYE, FLIPS, SOUPS, at_pixels, draw, random_soup, triangulated_grid
from tests.scenes.toned_picture import Case as ToneCase

SHADOWS, RASTER = Family("differential rendering"), Family("rasteriser")

# ---- R' / R and H ------------------------------------------------------------------------------------------------

for _name, _light in {
    "no light": np.zeros((16, 3)),
    "light from below alone": lights.lobe((0, -1, 0)),
    "light of 1e-20": 1e-20 * LIGHT,
    "light of one colour": lights.uniform((1, 0, 0)),
}.items():

    @SHADOWS.case(
        f"R' / R under {_name}",
        1.0,
        "of the picture",
        "a shadow takes between nothing and all of the picture: R' and R have a floor in common, so that 0 / 0 is 1.",
        apart=1e-3,
    )
    def near_zero(trial: Trial, light: Floats = _light) -> Found:
        ratio = shade_floor(trial.engine, PLATE, light).ratio[..., :3]
        return Found(1 - ratio + np.where((ratio < 0) | (ratio > 1), 10.0, 0.0), 0)


@SHADOWS.case(
    "R' / R under a negative light",
    10.0,
    "of the picture",
    "coefficients below zero are no light: the ratio stays finite, not negative, and under what the floor of R allows.",
    apart=1e-3,
)
def negative_light(trial: Trial) -> Found:
    ratio = shade_floor(trial.engine, PLATE, -LIGHT).ratio[..., :3]
    return Found(ratio + np.where(ratio < 0, 100.0, 0.0), 1)


@SHADOWS.case(
    "an object out of reach", 0, "of the picture", "nothing is taken, so the quotient is of equals: exactly 1."
)
def out_of_reach(trial: Trial) -> Found:
    return Found(shade_floor(trial.engine, box((3, 5, 3), (3.2, 5.2, 3.2)), ray_length_m=2.0).ratio, 1)


@SHADOWS.case(
    "tone mapping of nothing", 0, "gain", "without averages the light keeps its own scale: exactly 1.", known=False
)
def tone_of_nothing(trial: Trial) -> Found:
    clipped, bare, black = ToneCase(), ToneCase(), ToneCase()
    clipped.radiance[..., 3], bare.has_surface[:], black.radiance[..., :3] = 0.0, False, 0.0
    averages = [case.measured(trial.engine) for case in (clipped, bare, black)]
    averages.append(ToneCase().measured(trial.engine, np.zeros((16, 3)), indirect=False))
    memory = AverageMemory()
    averages += [memory.update(Averages(0.0, 0.0, 0), 1.0), memory.update(Averages(0.0, 0.5, 9), 1.0)]
    return Found([a.gain for a in averages], 1, known=any(a.are_known for a in averages))


_WHOLE = (
    "within the tolerance of a voxel the virtual surface is shown, everywhere or nowhere; a code rounds to "
    "its neighbour."
)
for _name, _offset_m in {"0": 0.0, "0.1 mm behind": 1e-4, "9 mm behind": 0.009, "0.1 mm before": -1e-4}.items():

    @SHADOWS.case(f"virtual surface in the real one, {_name}", 1, "code values", _WHOLE)
    def coplanar(trial: Trial, offset_m: float = _offset_m) -> Found:
        shown, radiance = camera_picture()
        points, normals = plane(1.0 + offset_m)
        found = compose(trial.engine, shown, radiance, WALL, buffer(points, normals), NONE_TAKEN)
        shading = open_transfer(normals[0, 0], 4) @ COMPOSITE_LIGHT
        return Found(found, srgb_codes(shading * 0.5 * np.array([1, 0.8, 0.5])))


@SHADOWS.case(
    "virtual surface 12 mm behind the real one", 0, "code values", "it is hidden: the picture is the camera's."
)
def hidden(trial: Trial) -> Found:
    shown, radiance = camera_picture()
    found = compose(trial.engine, shown, radiance, WALL, buffer(*plane(1.012)), NONE_TAKEN)
    return Found(found, shown)


# ---- rasteriser --------------------------------------------------------------------------------------------------


def _against_twin(trial: Trial, corners: Floats) -> Found:
    """Which triangle is seen at each pixel, -1 for none."""
    soup = soup_of(corners)
    picture = draw(trial.engine, (soup, EYE))
    vertices, triangles = soup.vertices.astype(np.float64), soup.triangles.astype(np.int64)
    setup = raster_twin.setup_triangles(SOUP_CAMERA, EYE, vertices, triangles)
    return Found(picture.triangle, raster_twin.raster_tiles(SOUP_CAMERA, setup))


for _name in SOUPS:

    @RASTER.case(
        f"triangles {_name}",
        FLIPS,
        "share of pixels",
        "a corner is snapped to 1/256 pixel: centres that near to an edge, 1 in 500, may fall on either side.",
        distance=share_beyond(0.5),
    )
    def soups(trial: Trial, name: str = _name) -> Found:
        return _against_twin(trial, random_soup(len(name), *SOUPS[name]).vertices.reshape(-1, 3, 3).astype(float))


@RASTER.case(
    "triangles that touch the near plane",
    FLIPS,
    "share of pixels",
    "one corner or two on the plane, or a rounding before or behind it, change a triangle by a rounding: 1 "
    "centre in 500.",
    distance=share_beyond(0.5),
)
def on_the_near_plane(trial: Trial) -> Found:
    rng, near = np.random.default_rng(2), float(np.float32(NEAR_M))
    corners = rng.uniform(-0.3, 0.3, (60, 3, 3)) * (near, 0.7 * near, 0.0)
    before, behind = (float(np.nextafter(np.float32(near), np.float32(to))) for to in (0, 1))
    corners[..., 2] = np.array([near, before, behind])[rng.integers(0, 3, (60, 3))]
    corners[:, 0] = rng.uniform((-0.3, -0.2, 0.3), (0.3, 0.2, 1.0), (60, 3))
    corners[::2, 1, 2] = rng.uniform(0.1, 1.0, 30)
    return _against_twin(trial, corners)


@RASTER.case(
    "degenerate triangles",
    0,
    "pixels",
    "a point, a line and a triangle seen edge on cover no pixel's centre: nothing is drawn of them, and nothing "
    "changes.",
)
def degenerate(trial: Trial) -> Found:
    point = [[0.0, 0.0, 1.0]] * 3
    line = [[-1.0, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 1.0]]
    edge_on = [[0.0, 0.0, 1.0], [0.0, 0.0, 2.0], [0.0, 0.0, 3.0]]
    behind = [[-1.0, -1.0, -2.0], [1.0, -1.0, -2.0], [0.0, 1.0, -2.0]]
    real = [[-1.0, -1.0, 2.0], [1.0, -1.0, 2.0], [0.0, 1.0, 2.0]]
    alone = draw(trial.engine, (soup_of([real]), EYE)).covered
    picture = draw(trial.engine, (soup_of([point, line, edge_on, behind, real]), EYE))
    return Found(picture.triangle, np.where(alone, 4, -1))


@RASTER.case(
    "edges through pixel centres", 0, "times drawn", "corners are exact, so a shared edge belongs to one side."
)
def shared_edges(trial: Trial) -> Found:
    rng = np.random.default_rng(1)
    pixels = np.stack(np.meshgrid(np.linspace(4, 36, 5), np.linspace(2, 34, 5)), axis=-1)
    pixels[1:-1, 1:-1] += rng.integers(-2, 3, (3, 3, 2))
    corners = at_pixels(EXACT, pixels).reshape(-1, 3)[triangulated_grid(pixels)]
    count = np.zeros((EXACT.height, EXACT.width))
    for triangle in corners:
        count += draw(trial.engine, (soup_of(triangle), EYE), camera=EXACT).covered
    expected = np.zeros_like(count)
    expected[2:34, 4:36] = 1
    return Found(count, expected)


@RASTER.case(
    "equally near triangles", 0, "which is seen", "depths of equal triangles are equal bits; the first is shown."
)
def equally_near(trial: Trial) -> Found:
    rng = np.random.default_rng(0)
    pixels = rng.uniform((10, 10), (140, 90), (60, 1, 2)) + rng.uniform(-0.5, 0.5, (60, 3, 2)) * 40
    corners = at_pixels(SOUP_CAMERA, pixels) * rng.uniform(0.5, 2, (60, 1, 1))
    thrice = draw(trial.engine, (soup_of(np.concatenate([corners] * 3)), EYE))
    return Found(thrice.triangle, draw(trial.engine, (soup_of(corners), EYE)).triangle)


@RASTER.case("an object behind the camera", 0, "pixels", "what lies before the near plane is clipped away.")
def behind_camera(trial: Trial) -> Found:
    soup = random_soup(1, 50, 0.2, (0.0, 0.0, 0.0), 0.2)
    return Found(draw(trial.engine, (soup, pose((0.0, 0.0, -3.0)))).covered, 0)

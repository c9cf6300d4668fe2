"""The 27 WebXR floats shade in three.js as this program shades (B7).

The twin is three.js's own published formula, typed from its source: `shGetIrradianceAt` of
ShaderChunk/lights_pars_begin.glsl.js and `SphericalHarmonics3.fromArray`, `getAt`, r170 (MIT),
with the Lambert material's `RECIPROCAL_PI * diffuseColor` (common.glsl.js, BRDF_Lambert).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from server.maths.sh import LAMBERT_BANDS, lambert_transfer, webxr_floats, webxr_from_world
from tests.reference.sh import sh_basis, sphere_rule
from tests.scenes import lights
from tests.scenes.lights import random_directions

Floats = NDArray[np.float64]
SIX_DIGITS = 2e-6
"""three.js types its constants with six digits."""


def from_array(floats: tuple[float, ...]) -> Floats:
    """`SphericalHarmonics3.fromArray`: coefficient i is the vector at 3 i."""
    return np.array([floats[3 * i : 3 * i + 3] for i in range(9)])


def sh_get_irradiance_at(normal: Floats, sh: Floats) -> Floats:
    """three.js's irradiance at a unit normal, its axes: y up, -z forward."""
    x, y, z = normal
    result = sh[0] * 0.886227
    result = result + sh[1] * 2.0 * 0.511664 * y
    result = result + sh[2] * 2.0 * 0.511664 * z
    result = result + sh[3] * 2.0 * 0.511664 * x
    result = result + sh[4] * 2.0 * 0.429043 * x * y
    result = result + sh[5] * 2.0 * 0.429043 * y * z
    result = result + sh[6] * (0.743125 * z * z - 0.247708)
    result = result + sh[7] * 2.0 * 0.429043 * x * z
    return np.asarray(result + sh[8] * 0.429043 * (x * x - y * y))


def three_lambert(normal: Floats, floats: tuple[float, ...], albedo: float) -> Floats:
    """What a MeshLambertMaterial of `albedo` under a LightProbe of intensity 1 radiates."""
    return albedo / np.pi * sh_get_irradiance_at(normal, from_array(floats))


def some_lights() -> list[Floats]:
    """[n, 3] with every coefficient in use."""
    random = np.random.default_rng(0)
    return [lights.lobe_and_sky((0.3, 0.8, -0.2)), random.normal(size=(16, 3)), random.normal(size=(36, 3))]


def test_three_shades_as_we_do() -> None:
    """In any room's axes: our shading at a world normal is three.js's at the normal turned into WebXR's axes."""
    for seed, light in enumerate(some_lights()):
        up, view = random_directions(2, seed)
        webxr = webxr_from_world(up, view)
        floats = webxr_floats(light, webxr)
        scale = np.abs(light).max()
        for normal in random_directions(50, 10 + seed):
            ours = 0.7 * lambert_transfer(normal, 3) @ light[:9]
            np.testing.assert_allclose(three_lambert(webxr @ normal, floats, 0.7), ours, atol=9 * SIX_DIGITS * scale)


def test_the_bands_beyond_nine_coefficients_are_what_three_leaves_out() -> None:
    """Band 3 shades nothing, band 4 at most 1 / 24 of its radiance: the picture differs by that and no more."""
    light = np.zeros((25, 3))
    light[:16] = np.random.default_rng(3).normal(size=(16, 3))
    floats = webxr_floats(light, np.eye(3))
    for normal in random_directions(20, 4):
        ours = lambert_transfer(normal, 5) @ light
        np.testing.assert_allclose(three_lambert(normal, floats, 1.0), ours, atol=9 * SIX_DIGITS * np.abs(light).max())
    assert abs(LAMBERT_BANDS[4]) < 1 / 20


def test_white_under_an_even_sky_is_as_bright_as_the_sky() -> None:
    floats = webxr_floats(lights.uniform((1.0, 2.0, 0.5)), np.eye(3))
    np.testing.assert_allclose(three_lambert(np.array([0.0, 1.0, 0.0]), floats, 1.0), [1.0, 2.0, 0.5], rtol=SIX_DIGITS)


def test_light_from_above_lights_what_faces_plus_y() -> None:
    """Axes as WebXR has them: whatever up is in the room, it is +y there; what the camera looks along is -z."""
    up, view = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])  # OpenCV's axes
    webxr = webxr_from_world(up, view)
    above = webxr_floats(lights.lobe(up), webxr)
    ahead = webxr_floats(lights.lobe(view), webxr)
    right = webxr_floats(lights.lobe((1.0, 0.0, 0.0)), webxr)
    faces = {name: np.array(n, float) for name, n in (("+y", (0, 1, 0)), ("-z", (0, 0, -1)), ("+x", (1, 0, 0)))}
    for floats, lit in ((above, "+y"), (ahead, "-z"), (right, "+x")):
        brightness = {name: three_lambert(n, floats, 1.0)[0] for name, n in faces.items()}
        assert max(brightness, key=lambda name: brightness[name]) == lit
        assert brightness[lit] > 1.5 * sorted(brightness.values())[1]


def test_get_at_is_the_radiance() -> None:
    """`LightProbe.sh.getAt` gives the radiance along a direction: the nine of our basis."""
    light = np.random.default_rng(5).normal(size=(9, 3))
    constants = np.array([0.282095, *[0.488603] * 3, 1.092548, 1.092548, 0.315392, 1.092548, 0.546274])
    for x, y, z in sphere_rule(6, 12)[0]:
        basis = constants * [1, y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y]
        sh = from_array(webxr_floats(light, np.eye(3)))
        ours = sh_basis(np.array([x, y, z]), 3) @ light
        np.testing.assert_allclose(basis @ sh, ours, atol=9 * SIX_DIGITS * np.abs(light).max())

"""Light that differs from object to object: each is shaded, and throws its shadow, by the light of its own place."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from server.maths.light_places import EVERYWHERE, LightPlaces
from server.objects.rasterize import VirtualSurface
from server.opencl.engine import Engine
from server.shading.adaptive import refine_real, refine_virtual
from server.shading.composite import CompositeInputs, composite
from server.shading.differential_rendering import light_points, shadow_real, shadow_virtual
from server.shading.reflect import reflect_surroundings
from server.shading.traced_scene import TracedScene, trace_scene, upload_light
from server.transfer.radiance_transfer import direction_sets, transfer_radiance
from tests.scenes import lights
from tests.scenes.analytic import Floats
from tests.scenes.composite_scene import camera_picture
from tests.scenes.meshes import pose
from tests.scenes.shaded_floor import FAR_M, STRIDE, UP, VOXEL_M, buffer, camera_of, floor_points, placed
from tests.scenes.solids import box, download4, fill_volume, float4, floor, upload_surface

SIDE = 24  # samples of the floor along an axis
BOXES = box((0.2, 0.2, 0.4), (0.3, 0.3, 0.5)), box((0.66, 0.2, 0.4), (0.76, 0.3, 0.5))
PLACES = LightPlaces(np.array([[0.25, 0.25, 0.45], [0.71, 0.25, 0.45]]), (0, 1))
SWAPPED = LightPlaces(PLACES.positions[::-1].copy(), (1, 0))
LIGHTS = (
    lights.lobe_and_sky((0.3, 0.9, 0.2), color=(1.0, 0.6, 0.3)),
    lights.lobe_and_sky((-0.2, 0.9, 0.1), sky=0.4, color=(0.2, 0.5, 1.0)),
)
RAYS = direction_sets(81, 4)
ABOVE = pose((0.48, 1.5, 0.48))


class Stage:
    """A floor below two boxes, as real surface; the same pixels as virtual surface of the nearer box."""

    def __init__(self, engine: Engine, light: Floats, places: LightPlaces = EVERYWHERE) -> None:
        self.engine = engine
        points = floor_points(side=SIDE)
        positions, normals = buffer(points, UP, (SIDE, SIDE), STRIDE)
        self.is_right = positions[..., 0] > PLACES.positions[:, 0].mean()
        self.camera, covered = camera_of(positions), np.ones(positions.shape[:2])
        self.surface = upload_surface(engine, positions[..., :3], normals[..., :3], covered > 0)
        space, height, width = engine.workspace, *covered.shape
        raised = positions[..., :3] + 0.1 * np.asarray(UP)
        raised[height // 2 :] += 0.1 * np.asarray(UP)  # an edge, which is refined
        self.virtual = VirtualSurface(
            space.upload("virtual_positions", float4(raised, covered)),
            space.upload("virtual_normals", float4(normals[..., :3], covered)),
            space.upload("virtual_colors", float4(0.5 * np.ones((*covered.shape, 3)), covered)),
            space.upload("virtual_index", self.is_right.astype(np.int32)),
            ((0, 0, width, height),) * 2,
            space.upload("virtual_materials", float4(np.full((*covered.shape, 3), 0.3), covered)),
        )
        volume = fill_volume(engine, (floor(),), VOXEL_M)
        self.transfer = transfer_radiance(engine, self.camera, volume, self.surface, STRIDE, RAYS, FAR_M)
        self.light = upload_light(engine, light, RAYS, places=places)
        objects = [placed(engine, solid) for solid in BOXES]
        self.scene: TracedScene = trace_scene(engine, volume, self.light, RAYS, FAR_M, objects)

    def composite(self) -> Floats:
        shown, radiance = camera_picture()
        height, width = self.is_right.shape
        shown, radiance = (np.resize(a, (height, width, *a.shape[2:])) for a in (shown, radiance))
        mixture = CompositeInputs(
            self.camera,
            np.eye(4),
            self.engine.workspace.upload("radiance", float4(radiance[..., :3], radiance[..., 3])),
            self.surface,
            VOXEL_M,
            self.light,
            self.virtual,
            shadow_virtual(self.engine, self.camera, self.virtual, self.scene),
        )
        return composite(self.engine, shown, mixture).astype(float)

    def refined_real(self) -> Floats:
        ratio = shadow_real(self.engine, self.camera, self.surface, self.transfer, self.scene)
        return download4(self.engine, refine_real(self.engine, self.camera, self.surface, self.scene, ratio))

    def points(self) -> Floats:
        return download4(self.engine, light_points(self.engine, self.scene).radiances)


OF_PIXELS: dict[str, Callable[[Stage], Floats]] = {
    "occluded": lambda on: download4(on.engine, shadow_virtual(on.engine, on.camera, on.virtual, on.scene).values),
    "refined": lambda on: download4(on.engine, refine_virtual(on.engine, on.camera, on.virtual, on.scene)),
    "reflected": lambda on: download4(
        on.engine, reflect_surroundings(on.engine, on.camera, ABOVE, on.virtual, on.scene)
    ),
    "ratio": lambda on: download4(
        on.engine, shadow_real(on.engine, on.camera, on.surface, on.transfer, on.scene).values
    ),
    "shaded": lambda on: download4(
        on.engine, shadow_real(on.engine, on.camera, on.surface, on.transfer, on.scene).shaded
    ),
    "refined ratio": Stage.refined_real,
    "picture": Stage.composite,
}


@pytest.mark.parametrize("name", OF_PIXELS)
def test_each_side_has_the_light_of_its_own_object(engine: Engine, name: str) -> None:
    of = OF_PIXELS[name]
    left, right = (of(Stage(engine, light)) for light in LIGHTS)
    both = of(Stage(engine, np.stack(LIGHTS), PLACES))
    swapped = of(Stage(engine, np.stack(LIGHTS[::-1]), SWAPPED))
    is_right = Stage(engine, LIGHTS[0]).is_right
    rows, cols = left.shape[:2]
    is_right = is_right[:: is_right.shape[0] // rows, :: is_right.shape[1] // cols][:rows, :cols]
    middle = np.zeros_like(is_right)
    step = np.flatnonzero(is_right[0])[0]
    middle[:, step - 4 : step + 4] = True  # samples are mixed, and R is interpolated
    everywhere = (both[..., -1] > 0) & (left[..., -1] > 0) & (right[..., -1] > 0) & ~middle  # not all is refined
    for side, alone in ((~is_right, left), (is_right, right)):
        assert (side & everywhere).sum() > 10
        np.testing.assert_allclose(both[side & everywhere], alone[side & everywhere], rtol=1e-5, atol=1e-6)
    assert np.abs(left - right)[everywhere].max() > 0.02
    np.testing.assert_array_equal(swapped, both)


def test_points_on_objects_have_the_light_of_the_nearest_place(engine: Engine) -> None:
    left, right = (Stage(engine, light).points() for light in LIGHTS)
    both = Stage(engine, np.stack(LIGHTS), PLACES).points()
    half = len(both) // 2  # of either box, which are alike
    np.testing.assert_array_equal(both[:half], left[:half])
    np.testing.assert_array_equal(both[half:], right[half:])
    assert np.abs(left - right).max() > 0.1


def test_places_of_one_light_change_nothing(engine: Engine) -> None:
    one, two = Stage(engine, LIGHTS[0]), Stage(engine, np.stack([LIGHTS[0]] * 2), PLACES)
    for name, of in OF_PIXELS.items():
        np.testing.assert_array_equal(of(one), of(two), err_msg=name)

"""The path-traced room: what each set is run with, and the objects' pixels under the true light."""

from __future__ import annotations

import numpy as np
import pytest

from client.options.source import open_source
from protocol.messages import Wishes
from server.maths.sh import dominant_direction, rotate_sh
from tests.bench.light.room import in_picture
from tests.bench.light.runs import Exposed
from tests.bench.truth.mitsuba_room import RoomSet, model_for, room_sets
from tests.bench.truth.object_shading import ObjectShading
from tests.data import data_folder
from tests.reference.sh import open_transfer

pytestmark = pytest.mark.data
FRAMES = 2


@pytest.fixture(scope="module")
def sets() -> dict[str, RoomSet]:
    return {item.name: item for item in room_sets(data_folder("mitsuba_room"))}


@pytest.fixture(scope="module")
def shading(sets: dict[str, RoomSet]) -> ObjectShading:
    pytest.importorskip("open3d", reason="open3d is not installed: make install-bench")
    item = sets["key_white_direct"]
    source = open_source(str(item.folder))
    poses = [source[index].world_from_camera for index in range(FRAMES)]
    return ObjectShading(item.room, source.camera, [pose for pose in poses if pose is not None])


def test_there_are_twelve(sets: dict[str, RoomSet]) -> None:
    assert len(sets) == 12
    assert all(item.folder.is_dir() and item.sh.shape == (16, 3) for item in sets.values())
    assert {item.light for item in sets.values() if not item.has_composites} == {"two"}
    np.testing.assert_array_equal(sets["key_white_gi"].sh, sets["key_tex_direct"].sh)


def test_composites_differ_from_pictures_at_the_objects(sets: dict[str, RoomSet], shading: ObjectShading) -> None:
    item = sets["key_tex_gi"]
    differs = np.abs(item.composite(0) - item.picture(0)).max(axis=-1) > 1e-3
    assert differs[shading.frames[0].mask].mean() > 0.95
    assert differs.mean() < 0.5


def test_a_set_is_run_with_what_it_calls_for(sets: dict[str, RoomSet]) -> None:
    found = model_for(sets["key_tex_gi"], Wishes(rays=7, albedo="constant", indirect="none"))
    assert (found.albedo, found.indirect, found.rays) == ("estimated", "observed", 7)
    plain = model_for(sets["key_white_direct"], Wishes(indirect="observed"))
    assert (plain.albedo, plain.indirect) == ("estimated", "none")


def test_the_true_light_shades_the_objects_as_the_path_tracer(sets: dict[str, RoomSet], shading: ObjectShading) -> None:
    """Direct and exactly of 16 coefficients: what is left are pixels at the objects' rims and the sampled shadows."""
    item = sets["key_white_direct"]
    for index in range(FRAMES):
        assert shading.error(item, index, 3.0 * item.sh) < 0.03
        assert shading.error(item, index, item.sh, ray_length_m=0.1) > 0.12
        assert shading.error(item, index, item.sh, ray_length_m=0.0) > 0.15


def test_nothing_hides_the_sky_within_no_reach(sets: dict[str, RoomSet], shading: ObjectShading) -> None:
    light, frame = sets["key_white_direct"].sh, shading.frames[0]
    open_sky = frame.albedo * (open_transfer(frame.normals, 4) @ light)
    np.testing.assert_allclose(shading.radiance(0, light, ray_length_m=0.0), np.maximum(open_sky, 0), rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(frame.normals, axis=1), 1, rtol=1e-6)


def test_a_turned_light_does_not(sets: dict[str, RoomSet], shading: ObjectShading) -> None:
    item = sets["key_white_direct"]
    axis = np.cross(dominant_direction(item.sh), (1.0, 0, 0))
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    quarter = np.eye(3) + cross + cross @ cross
    assert shading.error(item, 0, rotate_sh(item.sh, quarter)) > 0.15


def test_observed_light_explains_more_of_global_illumination(sets: dict[str, RoomSet], shading: ObjectShading) -> None:
    """Pictures in the light's units: meta.json says what 65535 stands for."""
    item = sets["key_white_gi"]
    units = open_source(str(item.folder)).meta["radiance_at_65535"]  # type: ignore[attr-defined]
    pictures = [units * item.picture(index) for index in range(FRAMES)]
    with_it, without = (shading.error(item, 0, item.sh, pictures=shown) for shown in (pictures, None))
    assert with_it < 0.1
    assert without > 1.5 * with_it


def test_the_true_light_in_the_units_of_the_picture(sets: dict[str, RoomSet], shading: ObjectShading) -> None:
    """As bright as the composite of the exposed picture, without any scale."""
    item = sets["key_white_direct"]
    source = Exposed(open_source(str(item.folder)), 0.5)
    shaded = shading.radiance(0, np.array(in_picture(item, source)))
    true = 0.5 * item.composite(0)[shading.frames[0].mask]
    assert float(shaded.mean()) == pytest.approx(float(true.mean()), rel=0.02)

"""What real surface leaves of the discs of a light is kept by cell of the world, until the discs have moved far."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.direct_lights import DirectLight, SplitLight, lamp_at
from server.objects.rasterize import Placed
from server.opencl.engine import Engine
from server.shading.kept_discs import STEADY, KeptDiscs
from server.shading.shadow_map import ShadowMaps, draw_shadow_maps, light_samples, trace_real
from server.shading.traced_scene import upload_light
from server.transfer.radiance_transfer import Cells, direction_sets
from server.transfer.sample_grid import SampleGrid
from server.volume.raycast import Surface
from server.volume.volume import Volume
from tests.scenes import lights
from tests.scenes.analytic import Floats
from tests.scenes.shaded_floor import placed
from tests.scenes.solids import box, download4, fill_volume, float4, floor, upload_surface

SIDE = 16
RAYS = direction_sets(81, 4)
FLOOR_Y = 0.1
BOARD = box((0.3, 0.5, 0.2), (0.6, 0.54, 0.5))
NOBODY = 0xFFFFFFFF
LIGHT = DirectLight(lights.unit((0.3, 1.0, 0.2)), np.ones(3), float(np.radians(15.0)))


def maps_of(engine: Engine, volume: Volume, disc: DirectLight) -> ShadowMaps:
    light = upload_light(engine, lights.uniform(), RAYS, split=SplitLight(lights.uniform(), (disc,)))
    return draw_shadow_maps(engine, volume, light, [placed(engine, box((0.8, 0.2, 0.8), (0.85, 0.3, 0.85)))], 10.0)


def shared_cells(engine: Engine, now: int) -> Cells:
    """Each cell has two samples beside each other, the last column none."""
    places = np.arange(SIDE * SIDE, dtype=np.int32).reshape(SIDE, SIDE) // 2
    places[:, -1] = -1
    space, count = engine.workspace, SIDE * SIDE // 2
    return Cells(
        space.upload("places", places),
        space.upload("ways", np.zeros(places.shape, np.uint8)),
        space.upload("claims", np.full(count, NOBODY, np.uint32)),
        space.upload("kept_parts", float4(np.full((count, 3), 0.25))),
        space.upload("kept_frames", np.zeros(count, np.int32)),
        now,
    )


def floor_under_a_board(engine: Engine) -> tuple[Volume, Surface, CameraModel, SampleGrid]:
    volume = fill_volume(engine, (floor(FLOOR_Y), BOARD), 0.02)
    x, z = np.meshgrid(np.linspace(0.2, 0.7, SIDE), np.linspace(0.1, 0.6, SIDE))
    points = np.stack([x, np.full_like(x, FLOOR_Y), z], axis=-1)
    surface = upload_surface(engine, points, np.broadcast_to([0.0, 1.0, 0.0], points.shape), np.ones(x.shape, bool))
    camera = CameraModel(width=SIDE, height=SIDE, fx=10.0, fy=10.0, cx=0.0, cy=0.0)
    return volume, surface, camera, SampleGrid(1, engine.workspace.upload("ones", float4(np.ones((SIDE, SIDE, 3)))))


@pytest.mark.parametrize("keeps", [False, True], ids=["with the samples", "alone"])
def test_parts_are_kept_until_the_discs_have_moved_far(engine: Engine, keeps: bool) -> None:
    volume, surface, camera, samples = floor_under_a_board(engine)

    def traced(disc: DirectLight, cells: Cells | None = None) -> Floats:
        maps = maps_of(engine, volume, disc)
        parts = trace_real(engine, camera, surface, samples, maps, cells, keeps=keeps)
        if not keeps:
            light_samples(engine, camera, surface, parts, maps, cells)
        return download4(engine, parts.values).astype(float)

    def shared(parts: Floats) -> Floats:
        """As the first sample of each cell has it."""
        firsts = np.repeat(parts[:, ::2], 2, axis=1)
        firsts[:, -1] = parts[:, -1]
        return firsts

    def frames(cells: Cells) -> NDArray[np.int32]:
        return np.asarray(engine.download(cells.disc_frames).reshape(SIDE, -1)[:, :-1])

    exact = traced(LIGHT).copy()
    assert 0.05 < (exact[..., 0] < 0.5).mean() < 0.95
    assert (exact != shared(exact)).any()
    cells = shared_cells(engine, 1)
    np.testing.assert_array_equal(traced(LIGHT, cells), exact)
    assert (frames(cells) == 1).all()
    assert (engine.download(cells.claims) == NOBODY).all()

    brighter = replace(LIGHT, irradiance=np.array([2.0, 1.0, 0.5]))
    np.testing.assert_array_equal(traced(brighter, replace(cells, now=2)), shared(exact))
    assert (frames(cells) == 1).all()

    aside = replace(LIGHT, direction=lights.unit((0.29, 1.0, 0.2)), half_angle_rad=float(np.radians(14.0)))
    np.testing.assert_array_equal(traced(aside, replace(cells, now=2)), shared(exact))

    moved = replace(LIGHT, direction=lights.unit((-0.3, 1.0, 0.2)))
    other = traced(moved).copy()
    assert np.abs(other - exact).max() > 0.3
    np.testing.assert_array_equal(traced(moved, replace(cells, now=3)), other)
    assert (frames(cells) == 3).all()
    np.testing.assert_array_equal(traced(moved, replace(cells, now=4)), shared(other))


def test_a_disc_that_moves_slowly_is_followed() -> None:
    """Turned by 0.09 of its radius in each frame: what was traced two frames ago holds, what is older does not."""
    kept, angles = KeptDiscs(), np.radians(1.4) * np.arange(12)
    discs = [replace(LIGHT, direction=np.array([np.sin(a), np.cos(a), 0.0])) for a in angles]
    assert [kept.since([disc], 10 + i) for i, disc in enumerate(discs)] == [10, 10, 10, *range(11, 20)]


def test_discs_that_grow_come_or_are_exchanged_are_others() -> None:
    lamp = lamp_at(np.array([0.5, 2.0, 0.5]), 0.3, np.ones(3))
    kept = KeptDiscs()
    assert kept.since([lamp, LIGHT], 1) == 1
    assert kept.since([lamp.seen_from(np.zeros(3)), LIGHT], 2) == 1  # the same one, told for another place
    assert kept.since([replace(lamp, irradiance=5 * lamp.irradiance), LIGHT], 3) == 1
    assert kept.since([lamp_at(np.array([0.5, 2.0, 0.55]), 0.3, np.ones(3)), LIGHT], 4) == 1
    assert kept.since([lamp_at(np.array([0.5, 2.0, 0.5]), 0.4, np.ones(3)), LIGHT], 5) == 5
    assert kept.since([LIGHT, lamp], 6) == 6
    assert kept.since([LIGHT], 7) == 7
    assert kept.since([], 8) == 8
    assert kept.since([], 9) == 8
    assert kept.since([], 3) == 3  # another sequence of frames


def test_maps_are_drawn_anew_where_an_object_or_a_disc_has_moved(engine: Engine) -> None:
    volume = fill_volume(engine, (floor(FLOOR_Y),), 0.02)
    small, large = (
        placed(engine, box((0.4, 0.2, 0.4), (0.45, 0.3, 0.45))),
        placed(engine, box((0.4, 0.2, 0.4), (0.5, 0.3, 0.5))),
    )
    lamp = lamp_at(np.array([0.5, 2.0, 0.5]), 0.3, np.ones(3))

    def drawn(disc: DirectLight, objects: list[Placed]) -> tuple[int, Floats]:
        light = upload_light(engine, lights.uniform(), RAYS, split=SplitLight(lights.uniform(), (disc,)))
        engine.profile.begin()
        maps = draw_shadow_maps(engine, volume, light, objects, 10.0)
        count = engine.profile.launches
        return count, engine.download(maps.objects).view(np.float32).copy()

    turned = np.diag([1.0, 1.0, -1.0, 1.0]) @ small[1]
    brighter = replace(lamp, irradiance=2 * lamp.irradiance)
    aside = lamp_at(np.array([0.3, 2.0, 0.5]), 0.3, np.ones(3))
    pictures = []
    for disc, objects in (
        (lamp, [small]),
        (aside, [small]),
        (lamp, [(small[0], turned)]),
        (lamp, [large]),
        (lamp, [small, large]),
    ):
        count, picture = drawn(disc, objects)
        assert count > 0
        assert all((picture != other).any() for other in pictures)
        pictures.append(picture)
        count, again = drawn(brighter if disc is lamp else disc, objects)
        assert count == 0
        np.testing.assert_array_equal(again, picture)


def test_a_disc_stays_where_it_was_drawn_until_it_has_moved(engine: Engine) -> None:
    """In brightness it is followed at once; after --cache off and in a still view, in all."""
    volume = fill_volume(engine, (floor(FLOOR_Y),), 0.02)
    thing = placed(engine, box((0.4, 0.2, 0.4), (0.45, 0.3, 0.45)))
    beside = np.eye(4)
    beside[0, 3] = 0.02
    lamp = lamp_at(np.array([0.5, 2.0, 0.5]), 0.3, np.ones(3))

    def drawn(disc: DirectLight, place: Placed = thing, *, follows_discs: bool = False) -> tuple[bool, DirectLight]:
        light = upload_light(engine, lights.uniform(), RAYS, split=SplitLight(lights.uniform(), (disc,)))
        engine.profile.begin()
        maps = draw_shadow_maps(engine, volume, light, [place], 10.0, follows_discs=follows_discs)
        return engine.profile.launches > 0, maps.discs[0]

    def moved(radii: float, irradiance: float = 1.0) -> DirectLight:
        return lamp_at(np.array([0.5 + 0.3 * radii, 2.0, 0.5]), 0.3, np.full(3, irradiance))

    assert drawn(lamp)[0]
    is_new, disc = drawn(moved(0.9 * STEADY, irradiance=2.0))
    assert not is_new
    assert disc.center_m is not None
    np.testing.assert_array_equal(disc.center_m, lamp.center_m)
    seen = moved(0.9 * STEADY, irradiance=2.0).seen_from(np.array([0.425, 0.25, 0.425]))
    np.testing.assert_allclose(disc.irradiance, seen.irradiance, rtol=1e-5)
    assert not drawn(moved(-0.9 * STEADY))[0]  # about where it was drawn, not about where it was last

    for there, place, follows in (
        (moved(1.1 * STEADY), thing, False),
        (moved(1.1 * STEADY + 0.01), thing, True),
        (moved(1.1 * STEADY), (thing[0], beside @ thing[1]), False),
    ):
        is_new, disc = drawn(there, place, follows_discs=follows)
        assert is_new
        assert disc.center_m is not None
        np.testing.assert_array_equal(disc.center_m, there.center_m)

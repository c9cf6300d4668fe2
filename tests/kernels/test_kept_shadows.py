"""What virtual things take from the light is kept by cell of the world: on real surface and on virtual."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.objects.rasterize import Placed, VirtualSurface
from server.opencl.engine import Engine
from server.shading.differential_rendering import VIRTUAL_STRIDE, shadow_real, shadow_virtual
from server.shading.kept_shadows import STEADY, TURNS, KeptShadows, ShadowCause, SplitSh, light_difference
from server.shading.shadow_cells import RealShadows, VirtualOcclusions, places_for
from server.shading.traced_scene import TracedScene, trace_scene, upload_light
from server.transfer.radiance_transfer import Transfer, direction_sets, transfer_radiance
from server.volume.raycast import Surface
from server.volume.volume import Volume
from tests.reference.kept_shadows import shadow_cell_of
from tests.scenes import lights
from tests.scenes.analytic import Floats
from tests.scenes.shaded_floor import (
    FAR_M,
    FLOOR,
    LIGHT,
    PLATE,
    STRIDE,
    UP,
    VOXEL_M,
    buffer,
    camera_of,
    floor_points,
    placed,
)
from tests.scenes.solids import box, download4, fill_volume, float4, floor, upload_surface

SIDE = 24
EYE = np.array([0.48, 1.3, 0.9])
RAYS = direction_sets(81, 4)
STEADILY = 0.5 * STEADY * np.linalg.norm(LIGHT) * np.eye(16, 3, -3) / np.sqrt(3)
"""A change of the light that is half of what may be."""


@pytest.fixture(autouse=True)
def room_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """So many places that no two cells of these tests ask for the same."""
    for kind in (RealShadows, VirtualOcclusions):
        monkeypatch.setattr(kind, "places_a_sample", 512)


# ---- how long it is true -------------------------------------------------------------------------------------------


def split(rest: Floats, discs: Floats | None = None) -> SplitSh:
    """Of one place."""
    return SplitSh(rest[None], (np.zeros_like(rest) if discs is None else discs)[None])


def test_a_difference_of_lights_does_not_depend_on_their_level() -> None:
    assert light_difference(split(LIGHT), split(0.3 * LIGHT)) == pytest.approx(0, abs=1e-9)
    aside = lights.lobe_and_sky((-0.6, 0.7, 0.2))
    turned = light_difference(split(LIGHT), split(aside))
    assert turned > STEADY
    assert light_difference(split(2 * LIGHT), split(5 * aside)) == pytest.approx(turned)
    assert light_difference(split(LIGHT), split(LIGHT + STEADILY)) == pytest.approx(0.5 * STEADY, rel=0.1)
    assert light_difference(split(LIGHT), split(-LIGHT)) == pytest.approx(1)
    both = SplitSh(np.stack([LIGHT, LIGHT]), np.zeros((2, 16, 3)))
    assert light_difference(split(LIGHT), both) == np.inf
    one_turned = SplitSh(np.stack([LIGHT, aside]), np.zeros((2, 16, 3)))
    assert light_difference(one_turned, both) == pytest.approx(light_difference(split(aside), split(LIGHT)))
    dark = split(np.zeros_like(LIGHT))
    assert light_difference(split(LIGHT), dark) == np.inf
    assert light_difference(dark, split(LIGHT)) == np.inf
    assert light_difference(dark, dark) == 0


def test_a_rest_that_changes_beside_bright_discs_is_another_light() -> None:
    """Things send light of the discs, and R is of the rest: what they add to it changes as much."""
    lamp = 50 * lights.lobe((0.2, 1.0, 0.0))
    assert light_difference(split(LIGHT, lamp), split(2 * LIGHT, 2 * lamp)) == pytest.approx(0, abs=1e-9)
    assert light_difference(split(LIGHT, lamp), split(1.1 * LIGHT, lamp)) == pytest.approx(1 - 1 / 1.1, rel=0.01)
    faint = 1e-3 * lamp * np.linalg.norm(LIGHT) / np.linalg.norm(lamp)
    assert light_difference(split(LIGHT), split(LIGHT, faint)) == pytest.approx(1e-3, rel=0.01)


class Cells(NamedTuple):
    """[side, side] each."""

    first: NDArray[np.int64]
    """The first sample in each sample's cell."""
    place: NDArray[np.int64]

    @staticmethod
    def of(points: Floats, normals: Floats, which: NDArray[np.int_], eye: Floats, spacing: float, places: int) -> Cells:
        """points, normals: [n, 3]; which: [n] as of shadow_cell_of."""
        firsts: dict[tuple[int, int], int] = {}
        keyed = [
            shadow_cell_of(point, normal, int(thing), eye, spacing, places)
            for point, normal, thing in zip(points, normals, which, strict=True)
        ]
        first = np.array([firsts.setdefault(key, i) for i, (key, _) in enumerate(keyed)])
        side = round(len(points) ** 0.5)
        assert len({place for _, place in keyed}) == len(firsts)  # no two cells have one place
        return Cells(first.reshape(side, side), np.array([place for _, place in keyed]).reshape(side, side))

    def shared(self, values: Floats) -> Floats:
        """[side, side, n] as the first sample of each cell has them."""
        return np.asarray(values.reshape(-1, values.shape[-1])[self.first])

    def have_turn(self, now: int) -> NDArray[np.bool_]:
        """[side, side, 1]."""
        return (self.place % TURNS == now % TURNS)[..., None]


@dataclass(frozen=True)
class Stage:
    """A floor, and a plate above it that is not real."""

    engine: Engine
    volume: Volume
    surface: Surface
    camera: CameraModel
    transfer: Transfer
    plate: Placed

    @staticmethod
    def of(engine: Engine) -> Stage:
        positions, normals = buffer(floor_points(side=SIDE), UP, (SIDE, SIDE), STRIDE)
        camera, volume = camera_of(positions), fill_volume(engine, FLOOR, VOXEL_M)
        surface = upload_surface(engine, positions[..., :3], normals[..., :3], positions[..., 3] > 0)
        transfer = transfer_radiance(engine, camera, volume, surface, STRIDE, RAYS, FAR_M)
        return Stage(engine, volume, surface, camera, transfer, placed(engine, PLATE))

    def scene(self, light: Floats, objects: list[Placed] | None = None) -> TracedScene:
        on_device = upload_light(self.engine, light, RAYS)
        return trace_scene(self.engine, self.volume, on_device, RAYS, FAR_M, objects or [self.plate])

    def moved(self) -> Placed:
        aside = np.eye(4)
        aside[0, 3] = 0.05
        return self.plate[0], aside @ self.plate[1]

    def ratio(self, light: Floats, eye: Floats | None, objects: list[Placed] | None = None, step: int = 1) -> Floats:
        """[SIDE, SIDE, 4]."""
        engine, scene = self.engine, self.scene(light, objects)
        found = shadow_real(engine, self.camera, self.surface, self.transfer, scene, step=step, eye=eye)
        return download4(engine, found.values).astype(float)

    def cells(self, eye: Floats) -> Cells:
        """Of all samples."""
        spacing, places = STRIDE / self.camera.fx, places_for(RealShadows.places_a_sample * SIDE * SIDE)
        points = floor_points(side=SIDE).astype(np.float32).astype(float)
        return Cells.of(points, np.broadcast_to(UP, points.shape), np.full(SIDE * SIDE, -1), eye, spacing, places)


def test_what_shadows_are_of_is_remembered(engine: Engine) -> None:
    stage, kept = Stage.of(engine), KeptShadows()

    def since(light: Floats, objects: list[Placed] | None = None) -> int:
        cause = ShadowCause.of(stage.scene(light, objects))
        first = kept.since(cause)
        assert kept.since(cause) == first  # asking changes nothing
        kept.begin_frame(cause)
        return first

    assert [since(LIGHT), since(LIGHT), since(3 * LIGHT)] == [1, 1, 1]
    assert since(LIGHT + STEADILY) == 1
    assert since(LIGHT + 3 * STEADILY) == 4  # near the last one, not near those before
    assert since(LIGHT, [stage.moved()]) == 6
    assert since(LIGHT, [stage.moved()]) == 6
    assert since(LIGHT) == 8
    assert since(LIGHT, [stage.plate, placed(engine, PLATE)]) == 9
    assert since(lights.lobe_and_sky((-0.6, 0.7, 0.2)), [stage.plate, placed(engine, PLATE)]) == 10
    assert since(LIGHT) == 11


def test_shadows_of_other_rays_or_another_scan_are_others(engine: Engine) -> None:
    stage = Stage.of(engine)
    scene = stage.scene(LIGHT)
    cause, light = ShadowCause.of(scene), scene.light
    assert cause.is_near(ShadowCause.of(stage.scene(LIGHT)))
    others = [
        replace(scene, rays=direction_sets(33, 4)),
        replace(scene, ray_length_m=0.5 * FAR_M),
        replace(scene, volume=fill_volume(engine, FLOOR, 2 * VOXEL_M)),
        replace(scene, light=replace(light, surface_gain=1.0)),
    ]
    assert not any(cause.is_near(ShadowCause.of(other)) for other in others)
    assert not cause.is_near(replace(cause, by_views=True))


# ---- shadows on real surface ---------------------------------------------------------------------------------------


def test_shadows_are_kept_while_they_are_true(engine: Engine) -> None:
    stage = Stage.of(engine)
    cells = stage.cells(EYE)
    exact = stage.ratio(LIGHT, None)
    assert 0.05 < (exact[..., 0] < 0.9).mean() < 0.95
    assert SIDE < len(np.unique(cells.first)) < 0.8 * SIDE * SIDE
    assert np.abs(exact - cells.shared(exact)).max() > 0.02
    np.testing.assert_array_equal(stage.ratio(LIGHT, EYE), exact)

    np.testing.assert_array_equal(stage.ratio(LIGHT, EYE), np.where(cells.have_turn(2), exact, cells.shared(exact)))
    brighter = stage.ratio(2 * LIGHT, None)
    np.testing.assert_array_equal(
        stage.ratio(2 * LIGHT, EYE), np.where(cells.have_turn(3), brighter, cells.shared(exact))
    )
    before = stage.ratio(LIGHT, EYE, step=2)  # for the objects' own light: none is found anew, none kept
    np.testing.assert_allclose(before[::2, ::2], cells.shared(exact)[::2, ::2], atol=1e-6)
    nearly = LIGHT + STEADILY
    others = stage.ratio(nearly, None)
    assert np.abs(others - exact).max() > 1e-3
    found = stage.ratio(nearly, EYE)
    np.testing.assert_allclose(found, np.where(cells.have_turn(4), others, cells.shared(exact)), atol=1e-6)
    now_there = np.where(cells.have_turn(4), cells.shared(others), cells.shared(exact))
    np.testing.assert_allclose(stage.ratio(nearly, EYE), np.where(cells.have_turn(5), others, now_there), atol=1e-6)


@pytest.mark.parametrize("what", ["light", "object"])
def test_shadows_are_found_anew_when_they_are_others(engine: Engine, what: str) -> None:
    stage = Stage.of(engine)
    light = lights.lobe_and_sky((-0.6, 0.7, 0.2)) if what == "light" else LIGHT
    objects = [stage.moved()] if what == "object" else None
    exact = stage.ratio(light, None, objects)
    assert np.abs(exact - stage.ratio(LIGHT, EYE)).max() > 0.05
    np.testing.assert_array_equal(stage.ratio(light, EYE, objects), exact)
    now = engine.buffers(RealShadows).memory.now + 1
    cells = stage.cells(EYE)
    np.testing.assert_array_equal(
        stage.ratio(light, EYE, objects), np.where(cells.have_turn(now), exact, cells.shared(exact))
    )


def test_cells_that_ask_for_one_place_do_not_mix(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = Stage.of(engine)
    exact, cells = stage.ratio(LIGHT, None), stage.cells(EYE)
    monkeypatch.setattr(RealShadows, "places_a_sample", 0.1)
    for _ in range(3):
        found = stage.ratio(LIGHT, EYE)
    assert (found != exact).any()
    assert _is_of_another_of_its_cell(found, exact, cells).all()


def _is_of_another_of_its_cell(found: Floats, exact: Floats, cells: Cells) -> NDArray[np.bool_]:
    """Where a sample has what any in its cell found: another one may have filled it."""
    mine = cells.first.ravel()
    same = mine[:, None] == mine[None]
    equal = (found.reshape(-1, 1, 4) == exact.reshape(1, -1, 4)).all(-1)
    return np.asarray((same & equal).any(1).reshape(cells.first.shape))


def test_a_picture_of_another_size_begins_anew(engine: Engine) -> None:
    stage = Stage.of(engine)
    exact = stage.ratio(LIGHT, None)
    stage.ratio(LIGHT, EYE)
    table = engine.buffers(RealShadows)
    kept = table.places
    table.reserve(engine, 4 * SIDE * SIDE)
    assert table.places == 4 * kept
    table.reserve(engine, SIDE * SIDE)
    np.testing.assert_array_equal(stage.ratio(LIGHT, EYE), exact)


# ---- occlusion of virtual surface ----------------------------------------------------------------------------------

COUNT = 20


@dataclass(frozen=True)
class Top:
    """Samples on top of a virtual table, under something real."""

    engine: Engine
    camera: CameraModel
    points: Floats
    normals: Floats
    which: NDArray[np.int32]
    surface: VirtualSurface
    volume: Volume
    objects: list[Placed]

    @staticmethod
    def of(engine: Engine) -> Top:
        """Two objects; the normals of some samples are tilted."""
        x, z = np.meshgrid(np.linspace(0.35, 0.61, COUNT), np.linspace(0.35, 0.61, COUNT))
        points = np.stack([x, np.full_like(x, 0.22), z], -1)
        normals = np.broadcast_to(UP, points.shape).copy()
        normals[::3, 5:12] = lights.unit((0.2, 1.0, 0.6))
        positions, _ = buffer(points.reshape(-1, 3), UP, (COUNT, COUNT), VIRTUAL_STRIDE)
        which = np.zeros((COUNT, COUNT), np.int32)
        which[:, 11:] = 1

        def pixels(values: Floats) -> Floats:
            return np.repeat(np.repeat(values, VIRTUAL_STRIDE, 0), VIRTUAL_STRIDE, 1)

        space, covered = engine.workspace, np.ones(positions.shape[:2])
        surface = VirtualSurface(
            space.upload("virtual_positions", float4(positions[..., :3], covered)),
            space.upload("virtual_normals", float4(pixels(normals), covered)),
            space.upload("virtual_colors", float4(0.5 * np.ones((*covered.shape, 3)), covered)),
            space.upload("virtual_index", pixels(which).astype(np.int32)),
            ((0, 0, covered.shape[1], covered.shape[0]),),
        )
        tables = box((0.2, 0.2, 0.2), (0.55, 0.22, 0.76)), box((0.55, 0.2, 0.2), (0.76, 0.22, 0.76))
        overhang = box((0.3, 0.5, 0.3), (0.66, 0.6, 0.66))
        objects = [placed(engine, table) for table in tables]
        volume = fill_volume(engine, (floor(0.05), overhang), VOXEL_M)
        # Few pixels a metre: some cells have several samples.
        camera = CameraModel(width=2 * COUNT, height=2 * COUNT, fx=110.0, fy=110.0, cx=0.0, cy=0.0)
        return Top(engine, camera, points, normals.astype(np.float32).astype(float), which, surface, volume, objects)

    def taken(self, light: Floats, eye: Floats | None) -> Floats:
        """[COUNT, COUNT, 4]."""
        on_device = upload_light(self.engine, light, RAYS)
        scene = trace_scene(self.engine, self.volume, on_device, RAYS, FAR_M, self.objects)
        found = shadow_virtual(self.engine, self.camera, self.surface, scene, eye)
        return download4(self.engine, found.values).astype(float)

    def cells(self, eye: Floats) -> Cells:
        """Of all samples."""
        spacing, places = VIRTUAL_STRIDE / self.camera.fx, places_for(VirtualOcclusions.places_a_sample * COUNT * COUNT)
        points = self.points.reshape(-1, 3).astype(np.float32).astype(float)
        return Cells.of(points, self.normals.reshape(-1, 3), self.which.ravel(), eye, spacing, places)


def test_occlusion_is_kept_by_cell(engine: Engine) -> None:
    top = Top.of(engine)
    exact, cells = top.taken(LIGHT, None), top.cells(EYE)
    assert 40 < len(np.unique(cells.first)) < 300
    np.testing.assert_array_equal(top.taken(LIGHT, EYE), exact)

    before = cells.shared(exact)
    assert np.abs(before - exact).max() > 0.01
    assert 0.03 < cells.have_turn(2).mean() < 0.3
    mean = np.where(cells.have_turn(2), (before + exact) / 2, before)
    np.testing.assert_allclose(top.taken(LIGHT, EYE), mean, atol=1e-6)
    kept = cells.shared(mean)
    again = np.where(cells.have_turn(3), (kept + exact) / 2, kept)
    np.testing.assert_allclose(top.taken(2 * LIGHT, EYE), again * [2, 2, 2, 1], atol=2e-6)


def test_another_light_is_seen_at_once(engine: Engine) -> None:
    top, other = Top.of(engine), lights.lobe_and_sky((-0.6, 0.7, 0.2))
    top.taken(LIGHT, EYE)
    exact = top.taken(other, None)
    np.testing.assert_array_equal(top.taken(other, EYE), exact)
    moved = replace(top, objects=[top.objects[0], (top.objects[1][0], top.objects[1][1] + 0.01 * np.eye(4, 4, 3))])
    np.testing.assert_array_equal(moved.taken(other, EYE), moved.taken(other, None))


def test_what_is_kept_of_a_cell_comes_to_all_its_directions(engine: Engine) -> None:
    """Samples differ by their few directions. The mean of what a cell's samples found is nearer to all directions."""
    top, light = Top.of(engine), lights.uniform()
    first = top.cells(EYE).first
    alone = top.taken(light, None)[..., 0]
    for _ in range(4 * TURNS):
        kept = top.taken(light, EYE)[..., 0]
    dense = _dense(top, light)
    has_others = np.array([(first == f).sum() > 1 for f in first.ravel()]).reshape(first.shape)
    errors = [float(np.sqrt(np.mean((found - dense)[has_others] ** 2))) for found in (alone, kept)]
    assert errors[1] < 1.1 * errors[0]  # seen: .038 and .037; cells here are as wide as the samples' distance


def _dense(top: Top, light: Floats) -> Floats:
    """[COUNT, COUNT] by a thousand directions."""
    rays = direction_sets(1024, 4)
    on_device = upload_light(top.engine, light, rays)
    scene = trace_scene(top.engine, top.volume, on_device, rays, FAR_M, top.objects)
    return download4(top.engine, shadow_virtual(top.engine, top.camera, top.surface, scene).values)[..., 0].astype(
        float
    )

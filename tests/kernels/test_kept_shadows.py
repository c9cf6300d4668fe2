"""What virtual things take from the light is kept by cell of the world: on real surface and on virtual."""

from __future__ import annotations

from dataclasses import dataclass, replace
from unittest.mock import patch

import numpy as np
import pyopencl.array as cl_array
import pytest
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.objects.rasterize import Placed, VirtualSurface
from server.opencl.engine import Engine
from server.shading.differential_rendering import VIRTUAL_STRIDE, shadow_real, shadow_virtual
from server.shading.kept_changes import LEAST_CODES, STEPS, KeptChanges
from server.shading.kept_shadows import LONGEST, STEADY, KeptShadows, ShadowCause, SplitSh, light_differences
from server.shading.shadow_cells import RealShadows, ShadowCells, VirtualOcclusions, places_for
from server.shading.traced_scene import TracedScene, trace_scene, upload_light
from server.transfer.radiance_transfer import Cells, Transfer, direction_sets, transfer_radiance
from server.volume.raycast import Surface
from server.volume.volume import Volume
from tests.reference.kept_shadows import KeptTable, shadow_cell_of
from tests.reference.sh import open_transfer
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
AS_KEPT, ANEW, OF_ANOTHER = 0, 1, 2
"""As in ways.clh."""
TRACED_IN = 10
"""A frame in which two thirds of the samples trace their transfer anew."""
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


def light_difference(light: SplitSh, before: SplitSh) -> float:
    """Of one, among others."""
    nothing, two_places = split(np.zeros_like(LIGHT)), SplitSh(np.stack([LIGHT, LIGHT]), np.zeros((2, 16, 3)))
    _, found, _ = light_differences(light, [nothing, before, two_places])
    assert light_differences(light, [before]) == [found]
    return float(found)


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

    def ratio(
        self,
        light: Floats,
        eye: Floats | None,
        objects: list[Placed] | None = None,
        step: int = 1,
        ways: NDArray[np.uint8] | None = None,
    ) -> Floats:
        """[SIDE, SIDE, 4]. ways: [SIDE * SIDE] how samples came to their transfer."""
        engine, scene, transfer = self.engine, self.scene(light, objects), self.transfer
        if ways is not None:
            told = engine.workspace.upload("ways", ways.reshape(SIDE, SIDE))
            transfer = replace(transfer, cells=Cells(told, told, told, told, told, 1))
        found = shadow_real(engine, self.camera, self.surface, transfer, scene, step=step, eye=eye)
        return download4(engine, found.values).astype(float)

    def twin(self) -> KeptTable:
        """Of all samples, seen from EYE."""
        spacing, places = STRIDE / self.camera.fx, places_for(int(RealShadows.places_a_sample * SIDE * SIDE))
        points = floor_points(side=SIDE).astype(np.float32).astype(float)
        cells = [shadow_cell_of(point, UP, -1, EYE, spacing, places) for point in points]
        return KeptTable(cells, RealShadows.close, LONGEST)


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
    assert cause.has_same_things(ShadowCause.of(stage.scene(LIGHT)))
    others = [
        replace(scene, rays=direction_sets(33, 4)),
        replace(scene, ray_length_m=0.5 * FAR_M),
        replace(scene, volume=fill_volume(engine, FLOOR, 2 * VOXEL_M)),
        replace(scene, light=replace(light, surface_gain=1.0)),
    ]
    assert not any(cause.has_same_things(ShadowCause.of(other)) for other in others)
    assert not cause.has_same_things(replace(cause, by_views=True))


# ---- shadows on real surface ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("places_a_sample", "close"), [(512, 0.1), (512, 0.01), (0.1, 0.1)])
def test_shadows_are_kept_as_by_the_twin(
    engine: Engine, monkeypatch: pytest.MonkeyPatch, places_a_sample: float, close: float
) -> None:
    """Steady light, a level that rises, light that moves a little, and much. Samples differ, each by its directions: by
    more than .01 in most cells, which are found anew in each frame then. With few places cells share them."""
    monkeypatch.setattr(RealShadows, "places_a_sample", places_a_sample)
    monkeypatch.setattr(RealShadows, "close", close)
    stage = Stage.of(engine)
    twin, nearly, other = stage.twin(), LIGHT + STEADILY, lights.lobe_and_sky((-0.6, 0.7, 0.2))
    keys, places = {key for key, _ in twin.cells}, {place for _, place in twin.cells}
    assert SIDE < len(keys) < 0.8 * SIDE * SIDE
    assert (len(places) == len(keys)) == (places_a_sample == 512)
    exact = {id(light): stage.ratio(light, None)[..., :3].reshape(-1, 3) for light in (LIGHT, nearly, other)}
    assert 0.05 < (exact[id(LIGHT)][:, 0] < 0.9).mean() < 0.95
    assert np.abs(exact[id(nearly)] - exact[id(LIGHT)]).max() > 1e-3
    assert np.abs(exact[id(other)] - exact[id(LIGHT)]).max() > 0.05

    shares, since = [], 1
    for number, light in enumerate([LIGHT] * 20 + [nearly] * 4 + [other] * 12, 1):
        since = number if number in (1, 25) else since
        level = 2.0 if number > 10 else 1.0
        if number in (1, 12, 25, 30):  # for the objects' own light, before; nothing is kept
            blocks = stage.ratio(level * light, EYE, step=2)[::2, ::2, :3]
            shown = twin.step(exact[id(light)], since, fills=False).reshape(SIDE, SIDE, 3)
            np.testing.assert_allclose(blocks, shown[::2, ::2], atol=3e-6)
        found = stage.ratio(level * light, EYE)
        np.testing.assert_array_equal(found[..., 3], 1)
        expected = twin.step(exact[id(light)], since)
        np.testing.assert_allclose(found[..., :3].reshape(-1, 3), expected, atol=3e-6)
        shares.append(twin.anew / SIDE**2)
    assert shares[0] == shares[24] == 1
    assert (np.mean(shares[12:20]) < 0.3) == (places_a_sample == 512 and close == 0.1)


def counted(changes: list[float]) -> list[int]:
    """[STEPS] as count_change counts them."""
    limits = LEAST_CODES * 2.0 ** (np.arange(STEPS) / 2)
    return [int(n) for n in np.bincount(np.searchsorted(limits[:-1], changes), minlength=STEPS)]


def watch(monkeypatch: pytest.MonkeyPatch, of: type) -> list[list[list[int]]]:
    """What kernels will have counted, frame by frame."""
    told: list[list[list[int]]] = []

    def take(_self: KeptChanges, _engine: Engine, kind: type, counts: cl_array.Array, *_: float, **__: bool) -> None:
        assert kind is of
        told.append(counts.get().tolist())

    monkeypatch.setattr(KeptChanges, "take", take)
    return told


def as_counted(twin: KeptTable) -> list[list[int]]:
    """[2, 1 + STEPS] of the twin's last frame."""
    return [[twin.stands, *counted(twin.changes[False])], [twin.lent, *counted(twin.changes[True])]]


def test_changes_are_counted_as_by_the_twin(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    """Under a light that moves a little; at first with the transfer of others in half of the cells' samples, later with
    transfer that some trace anew: what was kept for them is found anew, too."""
    monkeypatch.setattr(RealShadows, "close", 0.1)
    stage, told = Stage.of(engine), watch(monkeypatch, RealShadows)
    twin = stage.twin()
    moved = [LIGHT + share * STEADILY for share in np.linspace(0, 1, 12)]

    expected, late, stood = [], 0, []
    for number, light in enumerate(moved):
        lent = np.arange(SIDE * SIDE) % SIDE < (SIDE // 2 if number < 4 else 0)
        traced = np.arange(SIDE * SIDE) % SIDE >= (SIDE // 3 if number == TRACED_IN else SIDE)
        ways = np.select([lent, traced], [OF_ANOTHER, ANEW], AS_KEPT).astype(np.uint8)
        exact = stage.ratio(light, None)[..., :3].reshape(-1, 3)
        shown = twin.step(exact, 1, lent=lent, traced=traced)
        np.testing.assert_allclose(stage.ratio(light, EYE, ways=ways)[..., :3].reshape(-1, 3), shown, atol=3e-6)
        expected.append(as_counted(twin))
        late += len(twin.changes[True])
        stood.append(twin.stands)
    assert late > SIDE
    assert 0 < stood[TRACED_IN] <= SIDE * SIDE // 3 < stood[TRACED_IN - 1]
    assert sum(expected[-1][0][1:]) > SIDE
    apart = np.abs(np.array(told) - expected)
    assert apart[:, :, 0].max() == 0
    assert apart.sum() <= 2 * 4  # a change at a limit counts beside it: seen in none


def test_shadows_of_a_thing_that_moves_are_found_anew(engine: Engine) -> None:
    stage = Stage.of(engine)
    exact = stage.ratio(LIGHT, None, [stage.moved()])
    assert np.abs(exact - stage.ratio(LIGHT, EYE)).max() > 0.05
    np.testing.assert_array_equal(stage.ratio(LIGHT, EYE, [stage.moved()]), exact)


def test_a_frame_that_was_given_up_leaves_no_claims(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RealShadows, "close", 0.1)
    stage = Stage.of(engine)
    exact = stage.ratio(LIGHT, None)
    with patch.object(ShadowCells, "keep", side_effect=ArithmeticError), pytest.raises(ArithmeticError):
        stage.ratio(LIGHT, EYE)
    twin = stage.twin()
    twin.now = engine.buffers(RealShadows).memory.now
    for _ in range(5):
        found = stage.ratio(LIGHT, EYE)[..., :3].reshape(-1, 3)
        np.testing.assert_allclose(found, twin.step(exact[..., :3].reshape(-1, 3), 1), atol=3e-6)
    assert twin.anew < 0.2 * SIDE**2


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

    def twin(self) -> KeptTable:
        """Of all samples, seen from EYE."""
        samples = VirtualOcclusions.places_a_sample * COUNT * COUNT
        spacing, places = VIRTUAL_STRIDE / self.camera.fx, places_for(int(samples))
        points = self.points.reshape(-1, 3).astype(np.float32).astype(float)
        each = zip(points, self.normals.reshape(-1, 3), self.which.ravel(), strict=True)
        cells = [shadow_cell_of(point, normal, int(which), EYE, spacing, places) for point, normal, which in each]
        return KeptTable(cells, VirtualOcclusions.close, LONGEST, takes=True)


@pytest.mark.parametrize("close", [0.3, VirtualOcclusions.close])
def test_occlusion_is_kept_as_by_the_twin(engine: Engine, monkeypatch: pytest.MonkeyPatch, close: float) -> None:
    """Of two objects, with normals of two kinds; relative to the light's level."""
    monkeypatch.setattr(VirtualOcclusions, "close", close)
    top = Top.of(engine)
    twin, exact, seen = top.twin(), top.taken(LIGHT, None), 0
    level = np.maximum(0.5 / np.sqrt(np.pi) * LIGHT[0], 0.0).mean()
    twin.open_ = open_transfer(top.normals.reshape(-1, 3), 4) @ LIGHT / level
    keys = [key for key, _ in twin.cells]
    assert 40 < len(set(keys)) < 300
    assert len({place for _, place in twin.cells}) == len(set(keys))
    assert len({(key, which) for key, which in zip(keys, top.which.ravel(), strict=True)}) == len(set(keys))
    told = watch(monkeypatch, VirtualOcclusions)
    for number in range(1, 16):
        brightness = 1.0 if number < 8 else 3.0
        expected = level * twin.step(exact[..., :3].reshape(-1, 3) / level, 1)
        found = top.taken(brightness * LIGHT, EYE)
        apart = np.abs(np.array(told[-1]) - as_counted(twin))
        assert apart[:, 0].max() == 0
        assert apart.sum() <= 4
        seen += sum(told[-1][0][1:])
        np.testing.assert_array_equal(found[..., 3], 1)
        np.testing.assert_allclose(found[..., :3].reshape(-1, 3), brightness * expected, atol=2e-5)
    assert seen > COUNT
    assert (twin.anew < 0.4 * len(keys)) == (close == 0.3)


def test_another_light_is_seen_at_once(engine: Engine) -> None:
    top, other = Top.of(engine), lights.lobe_and_sky((-0.6, 0.7, 0.2))
    top.taken(LIGHT, EYE)
    exact = top.taken(other, None)
    np.testing.assert_array_equal(top.taken(other, EYE), exact)
    moved = replace(top, objects=[top.objects[0], (top.objects[1][0], top.objects[1][1] + 0.01 * np.eye(4, 4, 3))])
    np.testing.assert_array_equal(moved.taken(other, EYE), moved.taken(other, None))

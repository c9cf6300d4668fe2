"""Adaptive refinement (thesis 6.1.1, step 1) against float64 and against what samples at every pixel give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.maths.rigid import inverse_rigid
from server.objects.rasterize import rasterize
from server.objects.virtual_object import VirtualObject
from server.opencl.engine import Engine
from server.shading import adaptive, differential_rendering
from server.shading.differential_rendering import RealShadow, shadow_real, shadow_virtual
from server.shading.traced_scene import trace_scene, upload_light
from server.transfer.radiance_transfer import Directions, direction_sets, transfer_radiance
from server.transfer.sample_grid import SampleGrid
from server.volume.raycast import Surface
from tests.reference import adaptive as twin
from tests.reference.composite import Buffer, Samples, upsample
from tests.scenes.analytic import look_at
from tests.scenes.meshes import shape_of
from tests.scenes.solids import SCENES, download4, fill_volume, float4
from tests.scenes.volumes import seen_surface

VOXEL_M = 0.01
CAMERA = CameraModel(width=61, height=49, fx=60.0, fy=60.0, cx=31.5, cy=23.5)
VIEW = look_at((0.25, 0.5, 0.05), (0.4, 0.15, 0.4))
STRIDE = 4
ROOM_M = 1000.0
SIZE = (CAMERA.height, CAMERA.width)
Floats = NDArray[np.float64]


class Stage:
    """A ball above a floor, a virtual box beside it, and a light from one side."""

    def __init__(self, engine: Engine, stride: int, rays: Directions | None = None) -> None:
        self.engine = engine
        self.volume = fill_volume(engine, SCENES["ball above a floor"], VOXEL_M)
        self.surface = seen_surface(engine, self.volume, CAMERA, VIEW)
        self.rays = rays or direction_sets(81, 4)
        plain = direction_sets(self.rays.count, 4)
        self.transfer = transfer_radiance(engine, CAMERA, self.volume, self.surface, stride, plain, ROOM_M)
        sh = np.zeros((16, 3))
        sh[:4] = [[3.0, 2.8, 2.6], [1.2, 1.2, 1.2], [0.5, 0.4, 0.3], [1.0, 0.9, 0.8]]
        placed = np.eye(4)
        placed[:3, 3] = (0.3, 0.17, 0.35)
        thing = VirtualObject.upload(engine, shape_of(trimesh.creation.box((0.06, 0.1, 0.06))))
        objects, light = [(thing, placed)], upload_light(engine, sh, self.rays)
        self.scene = trace_scene(engine, self.volume, light, self.rays, ROOM_M, objects)
        self.virtual = rasterize(engine, CAMERA, inverse_rigid(VIEW), objects)

    def ratio(self) -> RealShadow:
        return shadow_real(self.engine, CAMERA, self.surface, self.transfer, self.scene)

    def refined(self, ratio: RealShadow) -> Floats:
        found = adaptive.refine_real(self.engine, CAMERA, self.surface, self.scene, ratio)
        return download4(self.engine, found).astype(float)


def test_real_surface_loses_what_samples_at_every_pixel_lose(engine: Engine) -> None:
    """With a sample at every pixel R - R' is the same ray by ray; R itself is the mean over neighbours."""
    stage = Stage(engine, 1)
    coarse = stage.ratio()
    ratio = download4(engine, coarse.values).astype(float)
    refined = stage.refined(coarse)
    listed = refined[..., 3] > 0
    assert 100 < listed.sum() < 0.6 * listed.size
    transfer = engine.download(stage.transfer.coefficients).astype(float)
    light = download4(engine, stage.scene.light.table.array("coefficients"))[0, :, :3].astype(float)
    shaded = np.concatenate([transfer @ light, engine.download(stage.transfer.openness)[..., None] >= 0], -1)
    surface = buffer_of(engine, stage.surface)
    for y, x in np.argwhere(listed)[::23]:
        mean = upsample(Samples(1, shaded), surface, int(x), int(y), VOXEL_M)[:3]
        expected = (1 - ratio[y, x, :3]) * shaded[y, x, :3]
        np.testing.assert_allclose((1 - refined[y, x, :3]) * mean, expected, atol=1e-5)  # seen: 1e-7, rounding


def test_refined_rims_are_nearer_to_every_pixel(engine: Engine) -> None:
    """Where shading is refined, the picture's factor is nearer to that of samples at every pixel than without."""
    every, coarse = Stage(engine, 1), None
    dense = Samples(1, download4(engine, every.ratio().values).astype(float))
    stage = Stage(engine, STRIDE)
    coarse = stage.ratio()
    samples = Samples(STRIDE, download4(engine, coarse.values).astype(float))
    refined = Samples(1, stage.refined(coarse))
    surface = buffer_of(engine, stage.surface)
    errors = []
    for y, x in np.argwhere(refined.values[..., 3] > 0)[::7]:
        want = upsample(dense, surface, int(x), int(y), VOXEL_M)[:3]
        errors.append(
            [np.abs(upsample(s, surface, int(x), int(y), VOXEL_M)[:3] - want).mean() for s in (refined, samples)]
        )
    after, before = np.mean(errors, axis=0)
    assert after < 0.5 * before


def test_virtual_surface_near_edges_is_as_at_every_pixel(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = Stage(engine, STRIDE)
    arguments = (engine, CAMERA, stage.virtual, stage.scene)
    refined = download4(engine, adaptive.refine_virtual(*arguments))
    monkeypatch.setattr(differential_rendering, "VIRTUAL_STRIDE", 1)
    every = download4(engine, shadow_virtual(*arguments).values)
    positions = download4(engine, stage.virtual.position).astype(float)
    normals = download4(engine, stage.virtual.normal).astype(float)
    covered = positions[..., 3] > 0
    near = adaptive.grown(twin.edges(positions, normals, VOXEL_M), adaptive.MARGIN_PX)
    assert 20 < (near & covered).sum() < covered.sum()
    np.testing.assert_array_equal(refined[..., 3] > 0, near & covered)
    sums = 0.0 if engine.sharers == 1 else 1e-5  # in another order
    np.testing.assert_allclose(refined[near & covered], every[near & covered], rtol=sums)
    assert (every[near & covered][:, :3] > 0).any()


def test_what_virtual_things_hide_is_left_out(engine: Engine) -> None:
    """All that is shown, and a margin around it, is as without; what they are behind of is shown."""
    stage = Stage(engine, STRIDE)
    ratio, eye = stage.ratio(), VIEW[:3, 3]
    whole = stage.refined(ratio)
    real = download4(engine, stage.surface.positions).astype(float)
    half = np.arange(CAMERA.width) < CAMERA.width // 2
    share = np.where(half, 0.5, 1.5)[None, :, None]  # of the way to what is real
    covered = np.broadcast_to((np.arange(CAMERA.height) > 8)[:, None], SIZE).astype(float)
    places = engine.workspace.upload("test_places", float4(eye + share * (real[..., :3] - eye), covered))
    virtual = replace(stage.virtual, position=places)
    found = download4(engine, adaptive.refine_real(engine, CAMERA, stage.surface, stage.scene, ratio, virtual, eye))
    kept = adaptive.grown((covered == 0) | ~half, adaptive.SHOWN_MARGIN_PX)
    np.testing.assert_array_equal(found[kept], whole[kept].astype(np.float32))
    assert not found[~kept].any()
    assert (whole[~kept][:, 3] > 0).sum() > 10
    assert (whole[kept][:, 3] > 0).sum() > 10


def test_subsets_of_directions_are_the_whole_on_average(engine: Engine) -> None:
    """Each pixel traces one of four subsets; over the rims they say what all directions say."""
    stage = Stage(engine, STRIDE, direction_sets(324, 4))
    ratio = stage.ratio()
    every = stage.refined(ratio)
    some = Stage(engine, STRIDE, direction_sets(324, 4, 4)).refined(ratio)
    listed = (every[..., 3] > 0) & (some[..., 3] > 0)
    apart = (some - every)[listed][:, :3]
    assert listed.sum() > 100
    assert 0.001 < np.sqrt((apart**2).mean()) < 0.06
    assert np.abs(apart.mean(axis=0)).max() < 0.002  # seen: 0.0005


@pytest.mark.parametrize("stride", [1, 4, 8])
def test_varying_cells_are_the_twins(engine: Engine, stride: int) -> None:
    random = np.random.default_rng(3)
    rows, cols = 49 // stride, 61 // stride
    row, col = np.mgrid[:rows, :cols]
    step = ((col > cols // 2) ^ ((col > 3 * cols // 4) & (row // 5 % 2 == 1)))[..., None]  # up to the last column
    values = np.where(step, 0.7, 1.0) + random.uniform(-0.03, 0.03, (rows, cols, 3))
    valid = random.random((rows, cols)) < 0.8
    values = np.where(valid[..., None], values, 0.0).astype(np.float32).astype(float)
    grid = SampleGrid(stride, engine.workspace.upload("ratio", float4(values, valid)))
    found = adaptive.varying_cells(engine, grid, 4)
    expected, margin = twin.varying(np.concatenate([values, valid[..., None]], -1), adaptive.LEAST_CHANGE)
    clear = np.abs(margin) > 1e-5
    np.testing.assert_array_equal(found[clear], expected[clear])
    assert 0 < found.sum() < found.size or stride == 8


@pytest.mark.parametrize("stride", [1, 3, 4, 8])
def test_pixels_of_cells(stride: int) -> None:
    """Cell i begins at sample i - 1; pixel x is in the cell of the last sample at or before it."""
    width, height = 37, 29
    random = np.random.default_rng(1)
    cells = random.random((height // stride + 1, width // stride + 1)) < 0.5
    pixels = adaptive.pixels_of(cells, stride, width, height)
    for y, x in np.ndindex(height, width):
        row, col = (int(np.floor((a - stride // 2) / stride)) + 1 for a in (y, x))
        assert pixels[y, x] == cells[min(row, cells.shape[0] - 1), min(col, cells.shape[1] - 1)]


def test_grown() -> None:
    mask = np.zeros((9, 9), bool)
    mask[4, 4] = mask[0, 8] = True
    expected = np.zeros_like(mask)
    expected[2:7, 2:7] = expected[:3, 6:] = True
    np.testing.assert_array_equal(adaptive.grown(mask, 2), expected)


def buffer_of(engine: Engine, surface: Surface) -> Buffer:
    return Buffer(
        download4(engine, surface.positions).astype(float),
        download4(engine, surface.normals).astype(float),
        np.zeros((*SIZE, 3)),
    )

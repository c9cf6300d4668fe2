"""What objects can change at most, against the float64 twin, and that it holds for what they do change."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
import pytest

from protocol.frames import CameraModel
from server.culling import influence_bound
from server.culling.influence_bound import (
    UNKNOWN,
    FewSamples,
    MostSent,
    _bound_pixels,
    _bound_samples,
    _greatest,
    bound_influence,
)
from server.maths.direct_lights import DirectLight
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.shading.differential_rendering import shadow_real
from server.shading.traced_scene import DeviceLight, trace_scene, upload_light
from server.transfer.indirect import Indirect
from server.transfer.radiance_transfer import Transfer, direction_sets, own_sets
from server.volume.volume import Volume
from tests.reference import influence_bound as twin
from tests.reference.sh import open_transfer
from tests.scenes import lights
from tests.scenes.analytic import Floats
from tests.scenes.shaded_floor import placed
from tests.scenes.solids import box, download4, float4, upload_surface
from tests.scenes.tolerance import relative_tolerance

STRIDE, ROWS, COLS, RAYS = 2, 12, 16, 81
WIDTH, HEIGHT = STRIDE * COLS, STRIDE * ROWS
SPACING_M = 0.05
UP = np.array([0.0, 1.0, 0.0])
LIGHT = lights.lobe_and_sky((0.3, 0.8, 0.4))
MEAN_SENT = np.array([0.1, 0.2, 0.15])
MOST = MostSent(np.array([0.5, 0.7, 0.2]), np.array([0.3, 0.4, 0.35]))
BALLS = np.array([[0.8, 0.3, 0.6, 0.2], [0.1, 0.1, 0.1, 0.04], [0.5, -0.4, 0.5, 0.3]])
"""Above the floor, small and near it, and below its horizon."""


class Case:
    """Pixels of a floor, SPACING_M apart; what is free is dealt at random."""

    def __init__(self, engine: Engine, balls: Floats = BALLS, light: Floats = LIGHT) -> None:
        random = np.random.default_rng(3)
        self.engine, self.balls, self.light = engine, balls, light
        self.rays = direction_sets(RAYS, 4)
        row, col = np.mgrid[:HEIGHT, :WIDTH]
        self.points = np.stack([SPACING_M * col, 0.0 * col, SPACING_M * row], axis=-1)
        self.there = random.random((HEIGHT, WIDTH)) < 0.9
        self.free = random.random((ROWS, COLS, RAYS)) < 0.7
        self.openness = self.free.mean(axis=-1)
        self.transfer = self.openness[..., None] * open_transfer(UP, 4)
        self.camera = CameraModel(width=WIDTH, height=HEIGHT, fx=10.0, fy=10.0, cx=0.0, cy=0.0)
        normals = np.broadcast_to(UP, self.points.shape)
        self.surface = upload_surface(engine, self.points, normals, self.there)
        self.volume = Volume(engine, (0, 0, 0, 0.5, 0.5, 0.5), 0.02)
        space = engine.workspace
        bits = np.zeros((ROWS, COLS, 96), np.uint8)
        bits[..., :RAYS] = self.free
        words = np.packbits(bits, axis=-1, bitorder="little").view(np.uint32)
        self.device_transfer = Transfer(
            STRIDE,
            ROWS,
            COLS,
            4,
            space.upload("test_transfer", self.transfer.astype(np.float32)),
            space.upload("test_openness", self.openness.astype(np.float32)),
            space.array("unused_flatness", (1,), np.float32),
            space.upload("test_free", words),
        )
        hits = space.upload("test_hits", float4(np.zeros((ROWS, COLS, 3)), np.zeros((ROWS, COLS))))
        self.indirect = Indirect(hits, MEAN_SENT)

    def device_light(self) -> DeviceLight:
        return upload_light(self.engine, self.light, self.rays, indirect=self.indirect)

    def device_balls(self) -> np.ndarray:
        return self.balls.astype(np.float32).view(cl_types.float4)[:, 0]

    def bounds(self, every: int = 1) -> cl_array.Array:
        """Of the kernel."""
        return _bound_samples(
            self.engine,
            self.camera,
            self.surface,
            self.device_transfer,
            self.rays,
            1000.0,
            self.device_light(),
            self.indirect,
            self.device_balls(),
            MOST,
            every,
        )

    def expected(self, wider: float = 1.0) -> Floats:
        """[ROWS, COLS, 3] of the twin."""
        sets = self.engine.download(own_sets(self.engine, ROWS, COLS))[..., 0]
        mean = 0.5 / np.sqrt(np.pi) * self.light[0]
        found = np.zeros((ROWS, COLS, 3))
        for row, col in np.ndindex(ROWS, COLS):
            own = sets[row, col]
            hidden = 1 - self.openness[row, col]
            found[row, col] = twin.bound(
                self.points[STRIDE // 2 + row * STRIDE, STRIDE // 2 + col * STRIDE],
                UP,
                self.rays.directions[own, :, :3].astype(float),
                np.maximum(self.rays.basis[own].astype(float) @ self.light, 0.0),
                self.free[row, col],
                self.transfer[row, col] @ self.light + hidden * MEAN_SENT,
                mean,
                self.openness[row, col],
                self.balls * [1, 1, 1, wider],
                MOST.objects,
                MOST.real,
                MEAN_SENT,
            )
        return found


def assert_bounds(case: Case) -> Floats:
    """The twin's bounds are at most the kernel's, and these at most those of balls a fifth larger; the twin's."""
    found = case.engine.download(case.bounds()).view(np.float32).reshape(ROWS, COLS, 4)
    there = case.there[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
    assert (found[..., 3] == there).all()
    assert (found[~there] == 0).all()
    low, high = case.expected()[there], case.expected(wider=1.2)[there]
    assert (found[there][:, :3] >= low * (1 - 1e-5)).all()  # a bound
    assert (found[there][:, :3] <= high * (1 + 1e-5)).all()
    assert (np.abs(found[there][:, :3] - low) <= 1e-5 * (1 + low)).mean() > 0.97  # rays that pass a ball just so aside
    return low


def test_bounds_are_the_twins(engine: Engine) -> None:
    low = assert_bounds(Case(engine))
    assert (low > 0).any(axis=0).all()
    assert (low[:, 0] == 0).any()  # some samples are out of reach


def test_without_balls_only_bounces_are_asked_for(engine: Engine) -> None:
    case = Case(engine)
    whole = engine.download(case.bounds()).view(np.float32).reshape(ROWS, COLS, 4).copy()
    case.balls = BALLS[:0]
    found = engine.download(case.bounds()).view(np.float32).reshape(ROWS, COLS, 4)
    assert (found[..., 0] == 0).all()
    assert (found[..., 1] >= whole[..., 1]).all()  # objects that hide all send no less
    assert (found[..., 2:] == whole[..., 2:]).all()


def test_few_samples_are_some_of_all(engine: Engine) -> None:
    case = Case(engine)
    every = engine.download(case.bounds()).copy()
    assert (engine.download(case.bounds(4)) == every[::4, ::4]).all()


def test_what_is_below_the_horizon_is_out_of_reach(engine: Engine) -> None:
    case = Case(engine, BALLS[2:])
    found = _greatest(engine.download(case.bounds()))
    assert (found.change, found.sent) == (0.0, 0.0)
    assert found.bounced > 0


def test_in_the_dark_nothing_that_is_not_sent_is_taken(engine: Engine) -> None:
    """Without light, R is what is sent and no less than a billionth: finite, and free directions bring `unseen`."""
    assert_bounds(Case(engine, light=np.zeros((16, 3))))


def test_changes_are_measured_against_what_rendering_takes_for_r(device: Device, engine: Engine) -> None:
    """A bound over R holds for R' / R only if it is the same R, near objects and far from them."""
    case = Case(engine)
    bounds = engine.download(case.bounds()).view(np.float32).reshape(ROWS, COLS, 4).copy()
    solid = box((0.7, 0.2, 0.5), (0.9, 0.4, 0.7))
    scene = trace_scene(engine, case.volume, case.device_light(), case.rays, 1000.0, [placed(engine, solid)])
    shadow = shadow_real(engine, case.camera, case.surface, case.device_transfer, scene, case.indirect)
    shaded, ratio = (download4(engine, a)[..., :3].astype(float) for a in (shadow.shaded, shadow.values))
    there = bounds[..., 3] > 0
    touched = (ratio != 1).any(axis=-1)
    assert 0.1 < touched[there].mean() < 0.9
    hidden = (1 - case.openness)[..., None]
    expected = (hidden * MOST.real / shaded.clip(1e-9)).max(axis=-1)
    np.testing.assert_allclose(bounds[there][:, 2], expected[there], rtol=10 * relative_tolerance(device))


def _pixels(case: Case, light: DeviceLight, bounds: cl_array.Array, *, has_bounds: bool) -> Floats:
    return _bound_pixels(
        case.engine,
        case.camera,
        case.surface,
        case.device_transfer,
        case.volume,
        light,
        case.device_balls(),
        bounds,
        has_bounds,
        "bilateral",
    )


def test_pixels_are_means_of_samples(engine: Engine) -> None:
    """No pixel exceeds the greatest sample; where all samples are alike, all pixels are."""
    case = Case(engine)
    light, bounds = case.device_light(), case.bounds()
    most = engine.download(bounds).view(np.float32).reshape(-1, 4).max(axis=0)
    found = _pixels(case, light, bounds, has_bounds=True)
    assert (found[:3] <= most[:3]).all()
    assert (found[:3] > most[:3] / 40).all()
    even = engine.workspace.upload("test_even", float4(np.full((ROWS, COLS, 3), 0.25), np.ones((ROWS, COLS))))
    assert _pixels(case, light, even, has_bounds=True)[:3] == pytest.approx(0.25)
    assert (_pixels(case, light, bounds, has_bounds=False) == 0).all()


@pytest.mark.parametrize(
    ("direction", "reaches"),
    [
        ((0.0, 1.0, 0.0), True),
        ((3.0, 0.2, 0.0), False),
        ((0.3, -1.0, 0.0), False),
        ((-1.0, 0.6, 0.0), False),
        ((1.0, 0.6, 0.0), True),
    ],
)
def test_discs_reach_where_balls_stand_in_their_light(
    engine: Engine, direction: tuple[float, float, float], reaches: bool
) -> None:
    """A ball over the floor: its shadow lies under it, far away, nowhere, beside the picture and in it."""
    case = Case(engine, np.array([[1.4, 0.5, 0.6, 0.1]]))
    towards = np.array(direction) / np.linalg.norm(direction)
    disc = DirectLight(towards, np.ones(3), 0.1)
    light = case.device_light()
    light = DeviceLight(**{**light.__dict__, "discs": (disc,)})
    found = _pixels(case, light, case.bounds(), has_bounds=False)[3] > 0
    near = replace(disc, center_m=case.balls[0, :3] + 2 * towards, distance_m=2.0)
    light = DeviceLight(**{**light.__dict__, "discs": (near,)})
    assert _pixels(case, light, case.bounds(), has_bounds=False)[3] > 0  # its direction is not the same everywhere
    points = case.points[case.there]
    some = [twin.dims(towards, 0.1, case.balls[0], point, UP) for point in points[::3]]
    assert any(some) == reaches
    assert found == reaches


def test_while_all_is_visible_the_last_frame_decides(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the change fades one more frame is drawn whole; where it appears the frame itself says so."""
    now, launched = {"change": 0.0}, list[int]()

    def bound_samples(*arguments: Any) -> cl_array.Array:
        launched.append(arguments[-1])
        return engine.workspace.upload("bounds", np.array([[now["change"], 0.0, now["change"], 1.0]], np.float32))

    monkeypatch.setattr(influence_bound, "_bound_samples", bound_samples)
    monkeypatch.setattr(influence_bound, "balls_around", lambda _: np.zeros(1, cl_types.float4))
    few, given = FewSamples(), dict.fromkeys(("camera", "surface", "transfer", "volume", "rays", "indirect"))
    found = []
    for change in (1.0, 1e-4, 1e-4, 1.0, 1e-4):
        now["change"] = change
        found.append(
            bound_influence(
                engine,
                **given,  # type: ignore[arg-type]
                ray_length_m=1.0,
                light=SimpleNamespace(discs=()),  # type: ignore[arg-type]
                objects=(),
                most=MOST,
                seen_from=0.01,
                few_samples=few,
            )
        )
    faint = found[2]
    assert faint.change == pytest.approx(1e-4)
    assert found == [UNKNOWN, UNKNOWN, faint, UNKNOWN, UNKNOWN]
    assert launched == [4, 4, 4, 1, 4, 4]

"""The averages that H rests on, against the float64 twin and in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.frames import CameraModel
from server.light.light_estimation import ASSUMED_ALBEDO
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.shading.tone_mapping import EVERY, LEAST_LUMINANCE, AverageMemory, Averages, measure_averages
from server.shading.traced_scene import upload_light
from server.transfer.indirect import Indirect
from server.transfer.radiance_transfer import Transfer, direction_sets
from tests import lights
from tests.analytic import Floats
from tests.reference import tone_mapping as twin
from tests.reference.sh import open_transfer
from tests.solids import float4, upload_surface
from tests.tolerance import relative_tolerance

STRIDE, ROWS, COLS, RAYS = 2, 13, 17, 81
LIGHT = lights.lobe_and_sky((0.3, 0.8, 0.4))
UP = np.array([0.0, 1.0, 0.0])


class Case:
    """Samples [ROWS, COLS] of a floor, at pixels of a picture STRIDE times as large."""

    def __init__(self, seed: int = 5) -> None:
        random = np.random.default_rng(seed)
        self.radiance = random.uniform(0.0, 1.0, (ROWS, COLS, 4))
        self.radiance[..., 3] = random.choice([1.0, 0.0, -1.0], (ROWS, COLS), p=[0.6, 0.3, 0.1])
        self.has_surface = random.random((ROWS, COLS)) < 0.8
        self.openness = random.uniform(0.0, 1.0, (ROWS, COLS))
        self.openness[2] = 1.0
        self.transfer = self.openness[..., None] * open_transfer(UP, 4)
        self.hits = random.uniform(0.0, 5.0, (ROWS, COLS, 4))
        self.hits[4, ::2] = 0.0

    def measured(self, engine: Engine, light: Floats = LIGHT, *, indirect: bool = True) -> Averages:
        """Of the kernel."""
        space, rays = engine.workspace, direction_sets(RAYS, 4)
        everywhere = [_spread(a) for a in (self.radiance, self.has_surface[..., None])]
        shape = everywhere[0].shape[:2]
        camera = CameraModel(width=shape[1], height=shape[0], fx=10.0, fy=10.0, cx=0.0, cy=0.0)
        points, normals = np.zeros((*shape, 3)), np.broadcast_to(UP, (*shape, 3))
        surface = upload_surface(engine, points, normals, everywhere[1][..., 0] > 0)
        transfer = Transfer(
            STRIDE,
            ROWS,
            COLS,
            4,
            space.upload("test_transfer", self.transfer.astype(np.float32)),
            space.upload("test_openness", self.openness.astype(np.float32)),
            space.array("unused_flatness", (1,), np.float32),
            space.array("test_free", (ROWS, COLS, -(-RAYS // 32)), np.uint32),
        )
        hits = space.upload("test_hits", float4(self.hits[..., :3], self.hits[..., 3]))
        sent = Indirect(hits, np.array([0.1, 0.2, 0.3])) if indirect else None
        device_light = upload_light(engine, light, rays, indirect=sent, exposure=2.0)
        radiance = space.upload("test_radiance", float4(everywhere[0][..., :3], everywhere[0][..., 3]))
        return measure_averages(engine, camera, radiance, surface, transfer, rays, device_light, sent, 1000.0)

    def expected(self, light: Floats = LIGHT, *, indirect: bool = True) -> Averages:
        """Of the twin."""
        hits, unseen = (self.hits, 2.0 * np.array([0.1, 0.2, 0.3])) if indirect else (0 * self.hits, np.zeros(3))
        gain = 2.0 if indirect else 0.0
        return Averages(
            *twin.averages(
                self.radiance,
                self.has_surface,
                self.transfer,
                self.openness,
                hits,
                2.0 * light,
                unseen,
                gain,
                RAYS,
                EVERY,
            )
        )


def _spread(values: Floats) -> Floats:
    """Each sample's value at its pixel, nonsense beside it."""
    wide = np.full((STRIDE * ROWS, STRIDE * COLS, values.shape[-1]), 7.0)
    wide[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE] = values
    return wide


@pytest.mark.parametrize("indirect", [True, False])
def test_averages_are_the_twins(device: Device, engine: Engine, indirect: bool) -> None:
    case = Case()
    found, expected = case.measured(engine, indirect=indirect), case.expected(indirect=indirect)
    assert found.samples == expected.samples > 8
    # Sums of less than a hundred values in float32.
    tolerance = 10 * relative_tolerance(device)
    assert found.picture == pytest.approx(expected.picture, rel=tolerance)
    assert found.shading == pytest.approx(expected.shading, rel=tolerance)


def test_twice_the_picture_is_twice_the_gain(engine: Engine) -> None:
    case, brighter = Case(), Case()
    brighter.radiance[..., :3] *= 2
    assert brighter.measured(engine).gain == pytest.approx(2 * case.measured(engine).gain, rel=1e-5)


def test_a_surface_of_the_assumed_albedo_needs_no_gain(engine: Engine) -> None:
    """In the open its radiance is that albedo times R; every third sample, each of one value."""
    case = Case()
    case.openness[:], case.radiance[..., 3], case.has_surface[:] = 1.0, 1.0, True
    case.transfer[:] = open_transfer(UP, 4)
    case.radiance[..., :3] = ASSUMED_ALBEDO * 2.0 * (open_transfer(UP, 4) @ LIGHT)
    averages = case.measured(engine, indirect=False)
    assert averages.samples == len(range(0, ROWS, EVERY)) * len(range(0, COLS, EVERY))
    assert averages.gain == pytest.approx(1.0, rel=1e-5)


def test_the_memory_holds_still_and_follows_the_exposure() -> None:
    memory, frame = AverageMemory(), Averages(0.2, 0.5, 9)
    assert memory.update(Averages(0.0, 0.0, 0), 1.0).gain == 1.0  # nothing yet
    assert memory.update(frame, 1.0) == frame
    longer = memory.update(Averages(0.4, 1.0, 9), 2.0)
    assert (longer.picture, longer.shading) == pytest.approx((0.4, 1.0))
    black = memory.update(Averages(0.0, 0.5, 9), 1.0)
    assert black.gain == pytest.approx(frame.gain)
    jumped = memory.update(Averages(0.4, 0.5, 9), 1.0)
    assert frame.gain < jumped.gain < 1.5 * frame.gain


def test_what_cannot_be_matched_keeps_the_lights_scale(engine: Engine) -> None:
    """No usable pixel, no surface, a black picture, a black light: 1, and it is known that it is not a measurement."""
    cases = {name: Case() for name in ("clipped", "no surface", "black")}
    cases["clipped"].radiance[..., 3] = 0.0
    cases["no surface"].has_surface[:] = False
    cases["black"].radiance[..., :3] = 0.5 * LEAST_LUMINANCE
    for name, case in cases.items():
        averages = case.measured(engine)
        assert (averages.are_known, averages.gain) == (False, 1.0), name
    dark = Case().measured(engine, np.zeros((16, 3)), indirect=False)
    assert dark.shading == 0.0
    assert (dark.are_known, dark.gain) == (False, 1.0)

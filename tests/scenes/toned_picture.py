"""A picture with virtual surface in it, which tone mapping shows."""

from __future__ import annotations

import numpy as np

from protocol.frames import CameraModel
from server.opencl.engine import Engine
from server.shading.tone_mapping import EVERY, Averages, measure_averages
from server.shading.traced_scene import upload_light
from server.transfer.indirect import Indirect
from server.transfer.radiance_transfer import Transfer, direction_sets
from tests.reference import tone_mapping as twin
from tests.reference.sh import open_transfer
from tests.scenes import lights
from tests.scenes.analytic import Floats
from tests.scenes.solids import float4, upload_surface

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

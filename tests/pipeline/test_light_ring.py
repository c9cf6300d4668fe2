"""A ring of eight known lights around a scene whose exact geometry the pipeline does not know.

`test_known_light.py` shades what was reconstructed (E1). Here the picture is that of the true scene, so the estimate
also pays for the reconstruction: the far sides of objects, which no camera sees, let light through that the picture
lacks.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from client.sources.volume import Volume, default_volume, default_voxel
from client.synthetic.lighting.lights import RING_SIZE
from client.synthetic.source import SyntheticSource, open_synthetic
from protocol.messages import Light, Wishes
from server.client_session import ClientSession
from server.opencl.device import Device
from tests.scenes.lights import degrees_between
from tests.scenes.plain_light import PLAIN_LIGHT

FRAMES = range(0, 90, 18)
"""Half of the path: 70 degrees around the table."""
GREATEST_ERROR_DEG = 7.0
"""Seen: 2.6 to 6.4 degrees, and no more than 0.05 apart where one code in a hundred changes by one. With exact geometry
and 243 rays it is 0.5 to 2.4 (test_known_light.py): the rest is what the cameras did not see."""


def source_of(light: int) -> SyntheticSource:
    return open_synthetic(f"synthetic:table?light={light}&frames=90&size=320x240")


@cache
def volume_of_the_table() -> Volume:
    """The one that `run` would choose: a matter of depth and poses, whatever the light."""
    source = source_of(0)
    return default_volume(source, range(len(source)))


def estimates(device: Device, source: SyntheticSource) -> list[Light]:
    """The light after each of FRAMES, of one albedo as the table is."""
    volume_m = volume_of_the_table()
    wishes = Wishes(preset="reg4", volume_m=volume_m, voxel_m=default_voxel(volume_m), up=source.up, **PLAIN_LIGHT)
    pipeline = ClientSession(device, source.camera, wishes)
    found = [pipeline.process(source[index]).light for index in FRAMES]
    pipeline.close()
    return found


@pytest.mark.parametrize("light", range(RING_SIZE))
def test_dominant_direction(device: Device, light: int) -> None:
    source = source_of(light)
    errors = []
    for index, found in zip(FRAMES, estimates(device, source), strict=True):
        errors.append(degrees_between(found.dominant_direction, source.truth(index).light_direction))
        assert np.isfinite(found.sh).all()
        assert found.dominant_intensity > 0
    assert errors[-1] < GREATEST_ERROR_DEG, np.round(errors, 1)

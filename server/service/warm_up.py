"""Warm-up before the first session: compiles all kernels by processing small frames, then runs the self-check."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from msgspec import structs

from protocol.frames import RgbdFrame
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.maths.directional_fit import directional_sh
from server.opencl.device import Device
from server.scene.placement import Placement
from server.service.self_check import CAMERA, check_answers, triangle

_LAMP = np.outer(directional_sh(np.array([0.0, -1.0, 0.0]), 0.2, 4), np.ones(3))
SHARP_LIGHT = tuple((float(r), float(g), float(b)) for r, g, b in _LAMP)


def warm_up(device: Device) -> None:
    """Process an object under light that is estimated, also as in the thesis and with one albedo, and under a given
    sharp light, with all kinds of presets.

    Raises CheckFailed if the self-check finds a wrong result.
    """
    wishes = Wishes(volume_m=(-1, -1, 0, 1, 1, 2), voxel_m=0.02, answer="layer")
    compile_for(device, wishes)
    compile_for(device, structs.replace(wishes, as_thesis=True))
    compile_for(device, structs.replace(wishes, albedo="constant", indirect="none"))  # with a search for lamps
    compile_for(device, structs.replace(wishes, preset="art4"))
    compile_for(device, structs.replace(wishes, preset="gr15fast", light=SHARP_LIGHT))
    check_answers(device)


def compile_for(device: Device, wishes: Wishes) -> None:
    """The kernels that sessions with these wishes need, by small frames with an object."""
    pipeline = ClientSession(device, CAMERA, wishes)
    pipeline.place_object("warm-up", triangle(), Placement(position_m=(0.0, 0.0, 0.8)))
    frame = RgbdFrame(
        index=0,
        timestamp_s=0.0,
        color=np.full((48, 64, 3), 128, np.uint8),
        depth=np.full((48, 64), 1000, np.uint16),
        world_from_camera=np.eye(4),
    )
    pipeline.process(frame, watched=True)  # a layer and a picture
    another = replace(frame, index=1, color=np.full((48, 64, 3), 96, np.uint8))  # of another exposure
    pipeline.process(another, watched=True)
    pipeline.close()

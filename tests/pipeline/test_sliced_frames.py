"""A frame whose launches are cut into slices is the same frame, to the last bit."""

from __future__ import annotations

import pyopencl as cl
import pytest

from protocol.messages import Wishes
from server.client_session import ClientSession
from server.opencl.device import Device
from server.opencl.pacing import Pacer
from server.pipeline import FrameResult
from server.scene.mesh import load_mesh
from server.scene.placement import Placement
from server.scene.vase import vase_glb
from tests.scenes.rooms import CAMERA, frame_at, view_at, wishes

FRAMES = 3


class Counting(Pacer):
    """Counts what is enqueued."""

    enqueued_slices = 0

    def enqueued(self, kernel: str, items: int, steps: int, event: cl.Event) -> None:
        self.enqueued_slices += 1
        super().enqueued(kernel, items, steps, event)


def results(device: Device, asked: Wishes, pacer: Counting) -> list[FrameResult]:
    """A vase in the room."""
    session = ClientSession(device, CAMERA, asked)
    session._engine.pacer = session._room.engine.pacer = pacer
    session.place_object("vase", load_mesh(vase_glb(), "glb"), Placement((-0.9, 0.6, 1.0)))
    frames = [session.process(frame_at(view_at(index), index, given=view_at(index))) for index in range(FRAMES)]
    session.close()
    return frames


@pytest.mark.parametrize("preset", ["reg4", "art4", "gr15fast"])
def test_slices_change_nothing(device: Device, preset: str) -> None:
    asked = wishes("given", preset=preset)
    few, many = Counting(), Counting(slice_s=1e-5)
    whole, sliced = results(device, asked, few), results(device, asked, many)
    assert many.enqueued_slices > 3 * few.enqueued_slices, "otherwise nothing was cut"
    for one, other in zip(whole, sliced, strict=True):
        assert (one.color == other.color).all()
        assert one.light == other.light
        assert one.plan == other.plan
        assert one.timings.launches == other.timings.launches, "of the frame, not of the machine"

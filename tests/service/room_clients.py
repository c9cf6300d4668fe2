"""Clients of a room."""

from __future__ import annotations

from protocol.frames import RgbdFrame
from protocol.images import encode_color, encode_depth
from protocol.messages import Composite, Frame
from tests.scenes.rooms import frame_at, view_at
from tests.service.wire import Wire


def message_of(frame: RgbdFrame) -> Frame:
    assert frame.world_from_camera is not None
    return Frame(
        frame=frame.index,
        timestamp_s=frame.timestamp_s,
        world_from_camera=tuple(frame.world_from_camera.ravel().tolist()),
        color=encode_color(frame.color, "png"),
        depth=encode_depth(frame.depth),
    )


def answered(wire: Wire, step: int) -> Composite:
    wire.say(message_of(frame_at(view_at(step), step, given=view_at(step))))
    composite = wire.hear_until(Composite)[-1]
    assert isinstance(composite, Composite)
    return composite

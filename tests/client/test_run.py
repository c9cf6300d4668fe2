"""The in-process loop, against a double of the pipeline."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from client.commands.run import process_frames
from client.errors import RunError
from client.objects.object_file import object_id
from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Plan, Timings
from tests.client.lights import light_of

CAMERA = CameraModel(width=32, height=24, fx=30, fy=30, cx=15.5, cy=11.5)


def frame_of(index: int) -> RgbdFrame:
    return RgbdFrame(index, index / 30, np.zeros((24, 32, 3), np.uint8), np.zeros((24, 32), np.uint16), np.eye(4))


class Double:
    """Paints the frame's number, and refuses frame 5."""

    def process(self, frame: RgbdFrame) -> SimpleNamespace:
        if frame.index == 5:
            raise ValueError("the pose is not rigid")
        return SimpleNamespace(
            color=np.full((24, 32, 3), frame.index, np.uint8),
            light=light_of(frame.index),
            world_from_camera=np.eye(4),
            tracking="given",
            timings=Timings(total=frame.index),
            plan=Plan(run=(), left_out=()),
            notes=(f"note {frame.index}",),
        )


def test_results_keep_their_frame() -> None:
    outputs = list(process_frames(Double(), map(frame_of, (3, 4)), CAMERA))
    assert [o.frame for o in outputs] == [3, 4]
    assert [o.timestamp_s for o in outputs] == [3 / 30, 4 / 30]
    assert [int(o.color[0, 0, 0]) for o in outputs] == [3, 4]
    assert [o.light.frame for o in outputs] == [3, 4]
    assert [o.timings.total for o in outputs] == [3, 4]
    assert [o.notes for o in outputs] == [("note 3",), ("note 4",)]
    assert [o.captured.color.max() for o in outputs] == [0, 0]


def test_frames_are_read_one_at_a_time() -> None:
    read = []

    def frames() -> object:
        for index in range(3):
            read.append(index)
            yield frame_of(index)

    outputs = process_frames(Double(), frames(), CAMERA)
    next(outputs)
    assert read == [0]


def test_refused_frame_is_named() -> None:
    outputs = process_frames(Double(), map(frame_of, (4, 5, 6)), CAMERA)
    next(outputs)
    with pytest.raises(RunError, match="frame 5: the pose is not rigid"):
        next(outputs)


def test_object_ids_differ() -> None:
    assert len({object_id(i) for i in range(9)}) == 9

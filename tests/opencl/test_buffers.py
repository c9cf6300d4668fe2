"""Device memory: the same name and shape is the same memory, and a steady stream allocates nothing."""

from __future__ import annotations

import gc
import threading
from typing import Any

import numpy as np
import pyopencl as cl
import pytest

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.opencl.buffers import BufferDescription, BufferGroup, KeyedBufferDescription, StageBuffers, Workspace
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.scene.placement import Placement
from tests.scenes.analytic import look, plane, room
from tests.scenes.meshes import soup_of


class _Inner(StageBuffers):
    """Of a stage that another one calls."""

    sums = BufferDescription(np.float32)


class _Stage(StageBuffers):
    """Of a stage in these tests."""

    sums = BufferDescription(np.float32)
    levels = KeyedBufferDescription(np.int32)
    inner = BufferGroup(_Inner)


@pytest.fixture
def workspace(engine: Engine) -> Workspace:
    """An empty workspace."""
    return engine.workspace


def test_same_name_and_shape_is_the_same_memory(workspace: Workspace) -> None:
    first = workspace.array("a", (3, 5), np.float32)
    first.fill(np.float32(4))
    again = workspace.array("a", (3, 5), np.float32)
    assert again is first
    assert (again.get() == 4).all()
    assert workspace.array("b", (3, 5), np.float32) is not first
    assert workspace.bytes_held == 2 * 3 * 5 * 4


def test_nothing_is_made_before_the_first_use(engine: Engine) -> None:
    sums = engine.buffers(_Stage).sums
    assert sums.current is None
    made = sums.array((3,))
    assert sums.current is made


def test_copy_into(engine: Engine) -> None:
    """From a byte on, and no farther than the part is long."""
    whole = engine.workspace.upload("whole", np.arange(10, dtype=np.int32))
    engine.copy_into(whole, 12, engine.workspace.upload("part", np.array([70, 80], np.int32)))
    np.testing.assert_array_equal(engine.download(whole), [0, 1, 2, 70, 80, 5, 6, 7, 8, 9])


def test_the_same_values_are_copied_once(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    copied: list[int] = []
    copy = Workspace.copy
    monkeypatch.setattr(Workspace, "copy", lambda *given: (copied.append(given[2].size), copy(*given)))
    sums = engine.buffers(_Stage).sums
    steps = [
        np.zeros(4),
        np.zeros(4),
        np.arange(4),
        np.arange(4),
        np.arange(6),
        np.arange(4),
        np.arange(6),
        np.zeros(6),
    ]
    for values in steps:
        np.testing.assert_array_equal(engine.download(sums.refresh(values.astype(np.float32))), values)
    assert copied == [4, 4, 6, 4, 6, 6]


@pytest.mark.parametrize("shape", [(5, 3), (3, 6), (15,)])
def test_another_shape_replaces_it(engine: Engine, shape: tuple[int, ...]) -> None:
    sums = engine.buffers(_Stage).sums
    first = sums.array((3, 5))
    other = sums.array(shape)
    assert other is not first
    assert (other.shape, other.dtype) == (shape, np.dtype(np.float32))
    assert engine.workspace.bytes_held == other.nbytes


def test_a_stage_has_one_buffer_for_each_description_and_key(engine: Engine) -> None:
    stage = engine.buffers(_Stage)
    assert stage is engine.buffers(_Stage)
    assert stage.sums is stage.sums
    assert stage.levels[1] is stage.levels[1]
    made = [stage.sums, stage.levels[0], stage.levels[1], stage.inner.sums, _Stage(engine.workspace).sums]
    assert len({id(buffer.array((4,))) for buffer in made}) == len(made)
    assert engine.workspace.bytes_held == 4 * 4 * len(made)


def test_memory_goes_with_its_owner(engine: Engine) -> None:
    owner = _Stage(engine.workspace)
    owner.sums.array((4,))
    assert engine.workspace.bytes_held == 16
    del owner
    gc.collect()
    assert engine.workspace.bytes_held == 0


def test_values_of_another_type_are_refused(engine: Engine) -> None:
    with pytest.raises(TypeError, match="float32, not float64"):
        engine.buffers(_Stage).sums.upload(np.zeros(3))


def test_a_constant_is_copied_once(engine: Engine) -> None:
    sums = engine.buffers(_Stage).sums
    first = sums.constant(np.ones(3, np.float32))
    assert sums.constant(np.zeros(3, np.float32)) is first
    assert (first.get() == 1).all()
    assert (sums.constant(np.zeros(4, np.float32)).get() == 0).all()


def test_upload_copies_into_the_same_memory(workspace: Workspace) -> None:
    first = workspace.upload("a", np.arange(6, dtype=np.int32).reshape(2, 3))
    again = workspace.upload("a", np.asfortranarray(10 * np.arange(6, dtype=np.int32).reshape(2, 3)))
    assert again is first
    np.testing.assert_array_equal(first.get(), [[0, 10, 20], [30, 40, 50]])


def test_upload_waits_for_nothing_and_values_may_change(engine: Engine) -> None:
    gate = cl.UserEvent(engine.device.context)
    cl.enqueue_barrier(engine.queue, wait_for=[gate])
    opener = threading.Timer(10.0, gate.set_status, [cl.command_execution_status.COMPLETE])  # if it waits after all
    opener.start()
    values = np.arange(1000, dtype=np.int32)
    array = engine.workspace.upload("a", values)
    values[:] = -1
    waited = gate.command_execution_status == cl.command_execution_status.COMPLETE
    opener.cancel()
    if not waited:
        gate.set_status(cl.command_execution_status.COMPLETE)
    np.testing.assert_array_equal(engine.download(array), np.arange(1000))
    assert not waited


def test_constant_copies_once(workspace: Workspace) -> None:
    values = np.arange(4, dtype=np.float32)
    first = workspace.constant("c", values)
    first.fill(np.float32(9))
    assert (workspace.constant("c", values).get() == 9).all()
    np.testing.assert_array_equal(workspace.constant("c", np.ones(5, np.float32)).get(), np.ones(5))


def test_constant_of_another_type_is_another(workspace: Workspace) -> None:
    workspace.constant("c", np.ones(4, np.float32))
    assert workspace.constant("c", np.full(4, 7, np.int32)).get().tolist() == [7] * 4


def test_release_gives_everything_back(workspace: Workspace) -> None:
    array = workspace.array("a", (1 << 20,), np.float32)
    memory = array.base_data
    workspace.release()
    assert workspace.bytes_held == 0
    with pytest.raises(cl.LogicError):
        memory.release()  # was released already
    assert workspace.array("a", (4,), np.float32).shape == (4,)


def test_a_steady_stream_allocates_nothing(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """50 equal frames with a virtual object, once unused bricks were looked for."""
    made: list[int] = []

    class CountedBuffer(cl.Buffer):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            made.append(self.size)

    monkeypatch.setattr(cl, "Buffer", CountedBuffer)
    camera = CameraModel(width=72, height=56, fx=60.0, fy=60.0, cx=35.5, cy=27.5, distortion=(0.01, 0, 0, 0, 0))
    scene = [room((-0.9, -0.7, -0.5), (0.9, 0.7, 1.5)), plane((0, 0.4, 0), (0, -1, 0.1))]
    depth = np.rint(1000 * look(scene, camera, np.eye(4)).depth_m).astype(np.uint16)
    color = np.random.default_rng(0).integers(30, 220, (*depth.shape, 3)).astype(np.uint8)
    pipeline = ClientSession(device, camera, Wishes(volume_m=(-1, -1, 0, 1, 1, 2), voxel_m=0.04))
    corners = [[[0, 0, 0], [0.3, 0, 0], [0, 0.3, 0]], [[0, 0, 0], [0, 0.3, 0], [0, 0, 0.3]]]
    pipeline.place_object("thing", soup_of(corners), Placement(position_m=(0.0, 0.3, 0.9)))
    for index in range(120):
        if index == 70:  # the view has settled
            assert made
            made.clear()
        pipeline.process(RgbdFrame(index, index / 30, color, depth, np.eye(4)))
    assert made == []
    pipeline.close()


def test_a_write_past_the_end_fails_the_test(engine: Engine) -> None:
    """By one element: the guards that tests put behind every buffer (tests/guards.py) are seen to be written."""
    array = engine.buffers(_Stage).sums.array((5,))
    cl.enqueue_copy(engine.queue, array.base_data, np.zeros(6, np.float32))
    with pytest.raises(AssertionError, match=r"past the end of a buffer \(5,\) of float32"):
        engine.close()

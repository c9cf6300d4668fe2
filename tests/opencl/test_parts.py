"""Several arrays in one buffer."""

from __future__ import annotations

import numpy as np
import pytest

from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine
from server.opencl.parts import pack, part_alignment_bytes, place

ARRAYS = {
    "codes": np.arange(7, dtype=np.uint8),
    "nothing": np.zeros((0, 4), np.float32),
    "values": np.arange(12, dtype=np.float32).reshape(3, 4) / 8,
    "numbers": -np.arange(300, dtype=np.int32),
}


class _Buffers(StageBuffers):
    """Of these tests."""

    one = BufferDescription(np.uint8)


def test_each_part_holds_its_values_and_begins_where_it_says(engine: Engine) -> None:
    parts = engine.buffers(_Buffers).one.refresh_parts(ARRAYS)
    alignment = part_alignment_bytes(engine.device.cl_device)
    whole = engine.download(parts.memory)
    for name, values in ARRAYS.items():
        start = parts.starts[name]
        assert start % alignment == 0
        assert whole[start : start + values.nbytes].tobytes() == values.tobytes()
    for name in ("codes", "values", "numbers"):
        np.testing.assert_array_equal(engine.download(parts.array(name)), ARRAYS[name])


def test_what_is_written_to_a_part_is_read_from_the_whole(engine: Engine) -> None:
    parts = engine.buffers(_Buffers).one.parts({"first": ((5,), np.int32), "second": ((2, 3), np.float32)})
    parts.array("first").fill(np.int32(-3))
    parts.array("second").fill(np.float32(0.25))
    whole, start = engine.download(parts.memory), parts.starts["second"]
    assert (whole[:20].view(np.int32) == -3).all()
    assert (whole[start : start + 24].view(np.float32) == 0.25).all()


def test_the_same_shapes_are_the_same_memory(engine: Engine) -> None:
    one = engine.buffers(_Buffers).one
    first = one.refresh_parts(ARRAYS)
    again = one.refresh_parts(ARRAYS | {"codes": np.ones(9, np.uint8)})
    assert again.memory is first.memory, "a part that grows by little took new memory"
    assert (engine.download(again.array("codes")) == 1).all()


@pytest.mark.parametrize("alignment", [64, 128, 512])
def test_parts_do_not_overlap(alignment: int) -> None:
    shapes = {name: (values.shape, values.dtype) for name, values in ARRAYS.items()}
    starts, size = place(shapes, alignment)
    ends = [starts[name] + values.nbytes for name, values in ARRAYS.items()]
    assert all(end <= start for end, start in zip(ends, [*starts.values()][1:], strict=False))
    assert ends[-1] <= size == len(pack(ARRAYS, starts, size))

"""What the host reads of a frame comes in few copies, and each read has what it was begun for."""

from __future__ import annotations

import numpy as np
import pyopencl.array as cl_array
import pytest
from numpy.typing import DTypeLike, NDArray

from server.opencl.engine import Engine
from server.opencl.pending_read import PendingRead


def written(engine: Engine, values: NDArray) -> cl_array.Array:
    """An array to read, which commands that are queued before whatever follows fill with `values`."""
    array = engine.array_to_read(values.shape, values.dtype)
    engine.copy_into(array, 0, engine.workspace.upload(f"values {values.dtype} {values.shape}", values))
    return array


def numbers(shape: tuple[int, ...], dtype: DTypeLike, seed: int = 0) -> NDArray:
    return np.random.default_rng(seed).integers(0, 100, shape).astype(dtype)


def begun(engine: Engine, *wanted: NDArray) -> list[PendingRead]:
    return [engine.begin_download(written(engine, values)) for values in wanted]


def test_results_of_a_frame_come_with_one_copy(engine: Engine) -> None:
    wanted = [
        numbers((3, 5), np.uint8),
        numbers((7,), np.float32),
        numbers((2, 2, 9), np.int32),
        numbers((1,), np.int64),
    ]
    reads = begun(engine, *wanted)
    before = engine.profile.copies
    for read, values in zip(reads, wanted, strict=True):
        result = read.result()
        assert result.dtype == values.dtype
        np.testing.assert_array_equal(result, values)
    assert engine.profile.copies == before + 1
    assert engine.profile.reads <= 1


def test_what_is_not_begun_yet_comes_with_a_later_copy(engine: Engine) -> None:
    early, late = numbers((50,), np.int32), numbers((60,), np.int32, 1)
    before_it, waiting = engine.array_to_read((60,), np.int32), written(engine, early)
    read = engine.begin_download(waiting)
    np.testing.assert_array_equal(read.result(), early)
    engine.copy_into(before_it, 0, engine.workspace.upload("late", late))
    np.testing.assert_array_equal(engine.begin_download(before_it).result(), late)
    np.testing.assert_array_equal(read.result(), early)


def test_a_read_that_nobody_has_waited_for_has_its_frame_s_values(engine: Engine) -> None:
    reads, wanted = [], []
    for frame in range(6):
        engine.profile.begin()
        wanted.append(numbers((1000,), np.float32, frame))
        reads += begun(engine, wanted[-1])
    assert len({read.start for read in reads}) == 1, "the same memory"
    for read, values in zip(reads, wanted, strict=True):
        np.testing.assert_array_equal(read.result(), values)


def test_sending_begins_the_copy_before_what_follows(engine: Engine) -> None:
    values = numbers((64,), np.int32)
    array = written(engine, values)
    read = engine.begin_download(array)
    engine.send_reads()
    engine.fill(array, -1)
    np.testing.assert_array_equal(read.result(), values)
    copies = engine.profile.copies
    engine.send_reads()
    assert engine.profile.copies == copies, "nothing was left"


def test_a_page_grows_until_it_holds_a_frame(engine: Engine) -> None:
    wanted = [numbers((size,), np.float32, size) for size in (10, 100_000, 300_000, 5, 1_000_000, 20)]
    copies = []
    for _ in range(4):
        engine.profile.begin()
        for read, values in zip(begun(engine, *wanted), wanted, strict=True):
            np.testing.assert_array_equal(read.result(), values)
        copies.append(engine.profile.copies - 2 * len(wanted))
    assert copies[-1] == 1 < copies[0]
    held = engine.bytes_held
    engine.profile.begin()
    begun(engine, *wanted)
    assert engine.bytes_held == held


def test_what_was_written_before_a_page_was_full_is_read(engine: Engine) -> None:
    engine.profile.begin()
    early, late = numbers((100,), np.float32), numbers((3_000_000,), np.float32, 1)
    first, second = written(engine, early), written(engine, late)  # more than a page holds at first
    for array, values in ((first, early), (second, late)):
        np.testing.assert_array_equal(engine.begin_download(array).result(), values)


def test_memory_is_bounded_where_no_frame_begins(engine: Engine) -> None:
    values = numbers((1 << 20,), np.uint8)
    for _ in range(64):
        begun(engine, values)
    assert engine.bytes_held < 70 << 20
    np.testing.assert_array_equal(begun(engine, values)[0].result(), values)


def test_engines_side_by_side_share_a_copy(engine: Engine) -> None:
    beside = Engine(engine.device, beside=engine)
    wanted = [numbers((30,), np.int32), numbers((40,), np.int32, 1)]
    reads = [*begun(engine, wanted[0]), *begun(beside, wanted[1])]
    before = engine.profile.copies
    for read, values in zip(reads, wanted, strict=True):
        np.testing.assert_array_equal(read.result(), values)
    assert engine.profile.copies == before + 1
    beside.close()


@pytest.mark.parametrize("shape", [(0,), (3, 0)])
def test_nothing_can_be_read(engine: Engine, shape: tuple[int, ...]) -> None:
    assert engine.begin_download(engine.array_to_read(shape, np.float32)).result().shape == shape

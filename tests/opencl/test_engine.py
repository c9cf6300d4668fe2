"""Launching kernels: sizes that are no multiples of a group, and Python values as arguments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyopencl.cltypes as cl_types
import pytest

from server.opencl import program
from server.opencl.device import Device
from server.opencl.engine import Engine, float4, float16, int4
from tests.scenes.volumes import vectors

SOURCE = """
kernel void count_visits(const int width, const int height, const int depth, global int *visits) {
    const int x = get_global_id(0), y = get_global_id(1), z = get_global_id(2);
    if (x >= width || y >= height || z >= depth) return;
    visits[(z * height + y) * width + x] += 1;
}

kernel void echo(const int whole, const float part, const int flag, const float4 vector, const int4 counts,
                 const float16 matrix, const ushort small, global float *result) {
    if (get_global_id(0) > 0) return;
    const float values[10] = {whole, part, flag, vector.x, vector.w, counts.y, matrix.s0, matrix.s3, matrix.sf, small};
    for (int i = 0; i < 10; i++) result[i] = values[i];
}
"""


@pytest.fixture(autouse=True)
def kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """These kernels in place of the real ones."""
    (tmp_path / "engine_test.cl").write_text(SOURCE)
    monkeypatch.setattr(program, "KERNEL_FOLDER", tmp_path)


@pytest.mark.parametrize("size", [(1,), (64,), (65,), (1, 1), (16, 4), (17, 5), (97, 71), (1, 1, 1), (9, 8, 3)])
def test_every_item_runs_once(engine: Engine, size: tuple[int, ...]) -> None:
    full = (*size, 1, 1)[:3]
    visits = engine.workspace.upload("visits", np.zeros(full[::-1], np.int32))
    engine.launch(engine.kernel("engine_test.cl", "count_visits"), size, *full, visits)
    assert (engine.download(visits) == 1).all()


def test_nothing_to_do_is_not_launched(engine: Engine) -> None:
    visits = engine.workspace.upload("visits", np.zeros(1, np.int32))
    engine.launch(engine.kernel("engine_test.cl", "count_visits"), (0, 5), 0, 5, 1, visits)
    assert engine.profile.collect().kernels == {}


def test_the_second_queue_waits_where_it_is_told_to_and_is_closed_with_the_first(device: Device) -> None:
    engine = Engine(device)
    other, visits = engine.concurrent, engine.workspace.array("visits", (1 << 20,), np.int32)
    assert engine.concurrent is other
    for number in range(1, 4):
        engine.workspace.copy(visits, np.full(len(visits), number, np.int32))
        other.wait_for(engine.mark())
        other.launch(other.kernel("engine_test.cl", "count_visits"), (len(visits),), len(visits), 1, 1, visits)
        assert (other.download(visits) == number + 1).all()
    held = engine.bytes_held
    other.workspace.array("own", (100,), np.int32)
    assert engine.bytes_held == held + 400
    assert engine.profile.launches == 3
    engine.finish()
    engine.close()
    assert other.workspace.bytes_held == 0


def test_arguments_arrive(engine: Engine) -> None:
    matrix = np.arange(16.0).reshape(4, 4) / 4
    result = engine.workspace.array("result", (10,), np.float32)
    vectors_and_counts = (float4(1.5, 0, 0, -2.5), int4(0, 77, 0, 0))
    kernel = engine.kernel("engine_test.cl", "echo")
    engine.launch(kernel, (1,), -3, 0.25, True, *vectors_and_counts, float16(matrix), np.uint16(9), result)
    np.testing.assert_array_equal(engine.download(result), [-3, 0.25, 1, 1.5, -2.5, 77, 0, 0.75, 3.75, 9])


def test_vector_arrays_keep_their_components(engine: Engine) -> None:
    values = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    array = engine.workspace.upload("vectors", values.view(cl_types.float4)[..., 0])
    np.testing.assert_array_equal(vectors(engine.download(array)), values)


@pytest.mark.parametrize("dtype", [np.int32, np.uint32, np.uint8, np.float32])
def test_filling_sets_all_of_a_slice_and_nothing_else(engine: Engine, dtype: type[np.generic]) -> None:
    values = engine.workspace.upload("values", np.arange(1000).astype(dtype))
    engine.fill(values[100:900], 7)
    engine.fill(values[:0], 9)
    expected = np.arange(1000).astype(dtype)
    expected[100:900] = 7
    np.testing.assert_array_equal(engine.download(values), expected)
    assert engine.profile.launches == 0


def test_a_kernel_is_retrieved_once(engine: Engine) -> None:
    first = engine.kernel("engine_test.cl", "echo", A=1, B=2)
    assert engine.kernel("engine_test.cl", "echo", B=2, A=1) is first
    assert engine.kernel("engine_test.cl", "echo", A=1) is not first


def test_engines_do_not_share_kernels(engine: Engine) -> None:
    """A kernel object carries its arguments: two threads must not set them on one."""
    other = Engine(engine.device)
    assert other.kernel("engine_test.cl", "echo") is not engine.kernel("engine_test.cl", "echo")
    other.close()


def test_close_gives_the_memory_back(engine: Engine) -> None:
    engine.workspace.array("large", (1000,), np.float32)
    engine.close()
    assert engine.workspace.bytes_held == 0
    engine.close()

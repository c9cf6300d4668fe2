"""Device structs: declared once, laid out alike on the host and on the device."""

from __future__ import annotations

import numpy as np
import pytest
from pyopencl.tools import match_dtype_to_c_struct

from server.opencl.device import Device
from server.opencl.engine import Engine, float16, int4
from server.opencl.structs import GRID, STRUCTS, VOLUME_SHAPE, Struct, struct_text
from tests.scenes.own_kernel import own_kernel

OUTER = Struct("Outer", count="int", inner=Struct("Inner", place="float4", size="int"), matrix="float16", last="float")


def offsets_on(engine: Engine, struct: Struct, before: str) -> list[int]:
    """Byte of each field on the device, and at last the size of all."""
    names = struct.dtype.names or ()
    lines = "".join(f"    found[{i}] = (int)((char *)&value.{n} - (char *)&value);\n" for i, n in enumerate(names))
    body = f"    {struct.name} value;\n{lines}    found[{len(names)}] = sizeof(value);\n"
    source = f"{before}kernel void measure(global int *found) {{\n{body}}}\n"
    kernel = own_kernel(engine.device, source, "measure")
    found = engine.workspace.array(f"found_{struct.name}", (len(names) + 1,), np.int32)
    engine.launch(kernel, (1,), found, local=(1,))
    return [int(value) for value in engine.download(found)]


def offsets_of(struct: Struct) -> list[int]:
    fields = struct.dtype.fields or {}
    return [*(fields[name][1] for name in struct.dtype.names or ()), struct.dtype.itemsize]


@pytest.mark.parametrize("struct", STRUCTS, ids=lambda struct: struct.name)
def test_the_device_lays_a_struct_out_as_the_host(engine: Engine, struct: Struct) -> None:
    assert offsets_on(engine, struct, struct_text()) == offsets_of(struct)


def test_gaps_before_wide_fields_and_at_the_end(engine: Engine) -> None:
    """Vectors begin at multiples of their size, and the size of all is one of the widest."""
    inner = "typedef struct { float4 place; int size; } Inner;\n"
    assert offsets_of(OUTER) == offsets_on(engine, OUTER, inner + OUTER.c_text) == [0, 16, 64, 128, 192]


@pytest.mark.parametrize("struct", [GRID, VOLUME_SHAPE], ids=lambda struct: struct.name)
def test_pyopencl_finds_the_same_layout(device: Device, struct: Struct) -> None:
    fields = struct.dtype.fields or {}
    packed = np.dtype([(name, fields[name][0]) for name in struct.dtype.names or ()])
    matched, _ = match_dtype_to_c_struct(device.cl_device, struct.name, packed)
    assert (offsets_of(struct)[:-1], struct.dtype.itemsize) == (
        [matched.fields[name][1] for name in matched.names],
        matched.itemsize,
    )


def test_a_field_that_is_missing_or_unknown_is_refused() -> None:
    with pytest.raises(TypeError, match="Grid has the fields cols, rows, stride, width; missing or unknown: width"):
        GRID(cols=1, rows=2, stride=3)
    with pytest.raises(TypeError, match="missing or unknown: depth"):
        GRID(cols=1, rows=2, stride=3, width=4, depth=5)


@pytest.mark.parametrize("field", ["float3", "double", "Grid *"])
def test_types_that_hosts_and_devices_differ_in_are_refused(field: str) -> None:
    with pytest.raises(KeyError):
        Struct("Other", field=field)


def test_values_arrive_in_a_kernel(engine: Engine) -> None:
    """By value, beside other arguments, and from structs in structs."""
    source = (
        "typedef struct { float4 place; int size; } Inner;\n"
        + OUTER.c_text
        + """
kernel void copy(const int first, const Outer outer, const float last, global float *result) {
    const int i = get_global_id(0);
    if (i >= 23) return;
    const Inner inner = outer.inner;
    const float values[7] = {first, outer.count, inner.place.x, inner.place.w, inner.size, outer.last, last};
    float matrix[16];
    vstore16(outer.matrix, 0, matrix);
    result[i] = i < 7 ? values[i] : matrix[i - 7];
}
"""
    )
    kernel = own_kernel(engine.device, source, "copy")
    result = engine.workspace.array("copied", (23,), np.float32)
    matrix = np.arange(100.0, 116.0).reshape(4, 4)
    inner = OUTER.dtype.fields["inner"][0]  # type: ignore[index]
    for number in (3, -8):  # the second launch passes other values to the same kernel
        place = np.zeros((), inner)
        place["place"], place["size"] = (0.5, 1.5, 2.5, number), 4 * number
        outer = OUTER(count=number, inner=place, matrix=float16(matrix), last=-0.25)
        engine.launch(kernel, (23,), 7, outer, 9.5, result)
        expected = [7, number, 0.5, number, 4 * number, -0.25, 9.5, *matrix.ravel()]
        np.testing.assert_array_equal(engine.download(result), expected)


def test_the_text_declares_a_struct_after_those_that_it_holds() -> None:
    text = struct_text()
    assert text.index("} Grid;") < text.index("    Grid samples;") < text.index("} SceneParameters;")
    assert text.count("typedef struct") == len(STRUCTS)


def test_structs_are_small_enough_for_any_device() -> None:
    """OpenCL 1.2 promises 1024 bytes for all arguments of a kernel together; 40 others have 8 each."""
    assert max(struct.dtype.itemsize for struct in STRUCTS) <= 1024 - 40 * 8


def test_a_grid_keeps_its_numbers() -> None:
    grid = GRID(cols=7, rows=5, stride=3, width=22)
    assert grid.tolist() == (7, 5, 3, 22)
    shape = VOLUME_SHAPE(bricks=int4(1, 2, 3, 0), voxel_m=0.5, truncation_m=2.0, gaps_at=64)
    assert (shape["bricks"].tolist(), float(shape["voxel_m"]), int(shape["gaps_at"])) == ((1, 2, 3, 0), 0.5, 64)

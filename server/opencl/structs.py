"""Device structs: what kernels take by value beside their buffers. Each is declared once, as a NumPy dtype.

The C text is made from the same declaration and stands in front of every program (program.py). OpenCL 1.2 allows no
pointers in the structs of kernel arguments, so buffers stay arguments of their own. Vectors of three are left out: C
gives a float3 the size of a float4.
"""

from __future__ import annotations

import numpy as np
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

_TYPES: dict[str, np.dtype] = {
    "int": np.dtype(np.int32),
    "float": np.dtype(np.float32),
    "int4": cl_types.int4,
    "float4": cl_types.float4,
    "float16": cl_types.float16,
}


class Struct:
    """A C struct of 32-bit scalars, vectors and other structs; called with all fields by name, it gives a value."""

    def __init__(self, name: str, **fields: str | Struct) -> None:
        """Each field is the name of an OpenCL C type, or a struct. Raises KeyError for a type that is not shared."""
        self.name = name
        dtypes = [field.dtype if isinstance(field, Struct) else _TYPES[field] for field in fields.values()]
        alignments = [
            field.alignment if isinstance(field, Struct) else _TYPES[field].itemsize for field in fields.values()
        ]
        self.alignment = max(alignments)
        """Bytes. C aligns scalars and vectors to their size, and a struct as its most aligned field."""
        offsets, end = [], 0
        for dtype, alignment in zip(dtypes, alignments, strict=True):
            offsets.append(_rounded(end, alignment))
            end = offsets[-1] + dtype.itemsize
        size = _rounded(end, self.alignment)
        self.dtype = np.dtype({"names": [*fields], "formats": dtypes, "offsets": offsets, "itemsize": size})
        types = {field: of.name if isinstance(of, Struct) else of for field, of in fields.items()}
        members = "".join(f"    {of} {field};\n" for field, of in types.items())
        self.c_text = f"typedef struct {{\n{members}}} {name};\n"

    def __call__(self, **values: object) -> np.void:
        """A kernel argument. Raises TypeError where a field is missing or unknown."""
        names = self.dtype.names or ()
        if values.keys() != set(names):
            wrong = ", ".join(sorted(values.keys() ^ set(names)))
            raise TypeError(f"{self.name} has the fields {', '.join(names)}; missing or unknown: {wrong}")
        filled: NDArray[np.void] = np.zeros(1, self.dtype)
        for field, value in values.items():
            filled[field] = value
        result: np.void = filled[0]
        return result


def _rounded(count: int, step: int) -> int:
    return -(-count // step) * step


GRID = Struct("Grid", cols="int", rows="int", stride="int", width="int")
"""Samples of a picture `width` wide: sample (row, col) lies at pixel stride / 2 + stride * (row, col)."""

VOLUME_SHAPE = Struct("VolumeShape", bricks="int4", voxel_m="float", truncation_m="float", gaps_at="int")
"""Of include/volume.clh. gaps_at: byte of the ray tables at which the gaps begin, behind the solid cells."""

STRUCTS = (GRID, VOLUME_SHAPE)
"""All of them; a struct comes after those that it holds."""


def struct_text() -> str:
    """C declarations of all structs, for the front of a program's source."""
    return '#line 1 "structs.py"\n' + "".join(struct.c_text for struct in STRUCTS)

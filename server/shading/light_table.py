"""The table of a light on the device, which shading looks radiance up in. Kernel: light_table.cl."""

from __future__ import annotations

import math

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from server.maths.light_places import LightPlaces
from server.opencl.buffers import DeviceBuffer
from server.opencl.engine import Engine
from server.opencl.parts import Parts, pack
from server.opencl.structs import LIGHT_TABLE
from server.transfer.radiance_transfer import Directions

_LOCAL = (64, 1)


class _Tabulated:
    """What the tables of an engine hold: a light that stays is not tabulated again."""

    def __init__(self) -> None:
        self.of: dict[DeviceBuffer, tuple[cl_array.Array, Directions, bytes]] = {}


def tabulate_light(
    engine: Engine,
    buffer: DeviceBuffer,
    rays: Directions,
    sh: NDArray[np.float64],
    whole: NDArray[np.float64],
    places: LightPlaces,
) -> Parts:
    """The table, laid out as in include/light_table.clh, in `buffer` of uint8, which nothing else writes.

    sh, whole: [places, bands^2, 3] radiance, without and with the discs.
    """
    given = {
        "coefficients": _float4(sh),
        "whole": _float4(whole),
        "positions": _float4(places.positions),
        "owners": np.array(places.owners or (0,), np.int32),
    }
    shapes = {part: (values.shape, values.dtype) for part, values in given.items()}
    table = buffer.parts(shapes | {"arriving": ((len(sh), *rays.basis.shape[:2]), cl_types.float4)})
    packed = pack(given, table.starts, table.starts["arriving"])
    known, content = engine.state(_Tabulated).of, packed.tobytes()
    memory, of_rays, before = known.get(buffer, (None, None, None))
    if memory is not table.memory or of_rays is not rays or before != content:
        known.pop(buffer, None)  # until the table is whole
        engine.workspace.copy(table.memory, packed)
        kernel = engine.kernel("shading/light_table.cl", "tabulate_arriving", BANDS=math.isqrt(sh.shape[1]))
        layout = table_layout(table)
        size = int(layout["directions"]), len(sh)
        engine.launch(kernel, size, layout, table.memory, rays.on_device(engine), local=_LOCAL)
        known[buffer] = table.memory, rays, content
    return table


def table_layout(table: Parts) -> np.void:
    """LightTable of structs.py."""
    places, sets, per_set = table.shapes["arriving"][0]
    starts = {f"{part}_at": start for part, start in table.starts.items()}
    return LIGHT_TABLE(places=places, directions=sets * per_set, **starts)


def _float4(rgb: NDArray[np.floating]) -> NDArray[np.float32]:
    """[..., 3] -> [...] float4 with w = 0."""
    padded = np.zeros((*rgb.shape[:-1], 4), np.float32)
    padded[..., :3] = rgb
    return padded.view(cl_types.float4)[..., 0]

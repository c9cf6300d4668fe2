"""The virtual layer of a frame, without the camera's picture (thesis 7.2.1). Kernel: layer.cl."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine
from server.opencl.structs import LAYER_PARAMETERS
from server.shading.composite import CompositeInputs, launch_mixture, mixture_parameters, srgb_table

DEPTH_SCALE_M = 0.001
"""Metres per unit of a layer's depth: up to 65 m. Rounding by half a unit shifts a point at 0.5 m by a tenth of a pixel
when the camera moves by 10 cm."""
NEUTRAL = 128
"""Code of unchanged real surface."""


@dataclass(frozen=True)
class LayerPart:
    """A box of the picture. The layer is empty outside of it."""

    x: int
    """First column of the box."""
    y: int
    color: NDArray[np.uint8]
    """[h, w, 4] sRGB and coverage (255: the whole pixel), or [h, w, 3] square roots of factors times 128."""
    depth: NDArray[np.uint16]
    """[h, w] depth along the camera's z in units of DEPTH_SCALE_M; 0: empty."""


@dataclass(frozen=True)
class Layer:
    """picture = coverage * virtual + (1 - coverage) * ratio * camera, all linear."""

    virtual: LayerPart | None = None
    """None: no virtual surface is visible."""
    ratio: LayerPart | None = None
    """None: real surface is unchanged."""
    depth_scale_m: float = DEPTH_SCALE_M


NOTHING = Layer()


class _Buffers(StageBuffers):
    layer = BufferDescription(np.uint8)
    """Colours, ratios and depths, one after the other: downloaded part by part."""


def compose_layer(engine: Engine, mixture: CompositeInputs) -> Layer:
    """The layer that, mixed with the camera's picture, gives the picture of `composite`."""
    if mixture.is_nothing:
        return NOTHING
    size = (mixture.camera.height, mixture.camera.width)
    layer = engine.buffers(_Buffers).layer.parts(
        {
            "virtual": ((*size, 4), np.uint8),
            "virtual_depth": (size, np.uint16),
            "ratio": ((*size, 3), np.uint8),
            "real_depth": (size, np.uint16),
        },
    )
    parameters = LAYER_PARAMETERS(
        mixture=mixture_parameters(mixture),
        depth_scale_m=DEPTH_SCALE_M,
        **{f"{part}_at": layer.starts[part] for part in ("virtual_depth", "ratio", "real_depth")},
    )
    launch_mixture(engine, "layer.cl", "compose_layer", mixture, parameters, srgb_table(engine), layer.memory)
    seen = changed = None
    if mixture.virtual is not None:
        color = engine.download(layer.array("virtual"))
        seen = _cropped(color, engine.download(layer.array("virtual_depth")), color[..., 3] > 0)
    if mixture.ratio is not None:
        factors = engine.download(layer.array("ratio"))
        changed = _cropped(
            factors, engine.download(layer.array("real_depth")), (factors != NEUTRAL).any(axis=-1), margin=1
        )
    return Layer(seen, changed)


def _cropped(
    color: NDArray[np.uint8], depth: NDArray[np.uint16], counts: NDArray[np.bool_], margin: int = 0
) -> LayerPart | None:
    """The bounding box of the pixels in `counts`, with `margin` pixels around it; None without any."""
    rows, cols = (np.flatnonzero(counts.any(axis=axis)) for axis in (1, 0))
    if not rows.size:
        return None
    top, left = max(rows[0] - margin, 0), max(cols[0] - margin, 0)
    box = slice(top, rows[-1] + 1 + margin), slice(left, cols[-1] + 1 + margin)
    near = cv2.dilate(counts[box].astype(np.uint8), np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)) > 0
    return LayerPart(int(left), int(top), np.ascontiguousarray(color[box]), np.where(near, depth[box], np.uint16(0)))

"""Encodes a frame's result as the message that answers it. Layer depth is slightly lossy (protocol/README.md)."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.images import encode_color, encode_depth
from protocol.messages import ColorImage, Composite, Frame, Layer, LayerPatch, Plan

if TYPE_CHECKING:
    from server.pipeline import FrameResult
    from server.shading.layer import LayerPart

Codec = Literal["zdelta", "zstd-delta"]

JPEG_QUALITY = 90
STEPS_PER_M = 400
"""Inverse depth is rounded to 1/400 per metre. Half a step shifts a pixel by 0.07 px at any distance (focal length
525 px, camera moved by 10 cm). Finer differences are mostly noise."""
_FAST = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)
_BGR_FROM = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}


def composite_message(frame: Frame, result: FrameResult, plan: Plan, *, lossless: bool) -> Composite:
    """The composite for `frame`, as PNG if `lossless`, else as JPEG."""
    assert result.color is not None
    color = encode_color(result.color, "png" if lossless else "jpeg", quality=JPEG_QUALITY)
    return Composite(color=color, **_drawn(frame, result, plan))


def layer_message(frame: Frame, result: FrameResult, plan: Plan) -> Layer:
    """The layer for `frame`. Depth uses Zstandard only if the client sent Zstandard: browsers cannot decode it."""
    layer = result.layer
    assert layer is not None
    reads_zstd = frame.depth is not None and frame.depth.codec.startswith("zstd")
    codec: Codec = "zstd-delta" if reads_zstd else "zdelta"
    return Layer(
        virtual=_patch(layer.virtual, codec, layer.depth_scale_m),
        ratio=_patch(layer.ratio, codec, layer.depth_scale_m),
        depth_scale_m=layer.depth_scale_m,
        **_drawn(frame, result, plan),
    )


def _drawn(frame: Frame, result: FrameResult, plan: Plan) -> dict[str, Any]:
    """Fields that composite and layer share."""
    return {
        "frame": frame.frame,
        "timestamp_s": frame.timestamp_s,
        "world_from_camera": tuple(result.world_from_camera.ravel().tolist()),
        "tracking": result.tracking,
        "timings": result.timings,
        "plan": plan,
        "notes": result.notes,
        "placed": result.placed,
    }


def _patch(part: LayerPart | None, codec: Codec, depth_scale_m: float) -> LayerPatch | None:
    """One part of a layer. Deterministic: equal parts give equal bytes."""
    if part is None:
        return None
    height, width = part.depth.shape
    color = ColorImage(width=width, height=height, data=_png(part.color), codec="png")
    depth = encode_depth(_rounded(depth_scale_m)[part.depth], codec)
    return LayerPatch(x=part.x, y=part.y, color=color, depth=depth)


@lru_cache(maxsize=4)
def _rounded(scale_m: float) -> NDArray[np.uint16]:
    """[65536] lookup table: depth rounded to whole steps of inverse depth. 0 (no depth) stays 0."""
    units = STEPS_PER_M / scale_m
    depth = np.arange(1, 65536)
    steps = np.maximum(np.rint(units / depth), 1)
    return np.append(0, np.rint(units / steps).clip(0, 65535)).astype(np.uint16)


def _png(color: NDArray[np.uint8]) -> bytes:
    """[h, w, 3] RGB or [h, w, 4] RGBA."""
    done, data = cv2.imencode(".png", cv2.cvtColor(color, _BGR_FROM[color.shape[2]]), _FAST)
    if not done:
        raise ValueError(f"OpenCV could not encode a layer of {color.shape} as PNG")
    found: bytes = data.tobytes()
    return found

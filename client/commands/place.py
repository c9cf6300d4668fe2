"""`probeless place`: a page with frames of a source, in which a click says where an object is to stand."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.display.layers import shown_picture
from client.errors import OutputError
from client.results.camera_pictures import encode_camera_picture
from client.sources.frame_source import ENDLESS, Source
from protocol.frames import CameraModel, RgbdFrame

PAGE = Path(__file__).parents[1] / "web" / "dist" / "place.html"
_DATA = "<!--data-->"
"""Where the data goes in the built page."""
MOST_FRAMES = 12
"""Shown of a source, evenly spread: enough to find a place, and a page of some megabytes."""
DEPTH_STEP = 4
"""Of how many pixels, across and down, one has its depth in the page."""


def frames_to_show(frames: range, most: int = MOST_FRAMES) -> list[int]:
    """Positions of at most `most` frames, evenly spread, the first among them; of a camera the first alone."""
    if frames.stop >= ENDLESS:
        return [frames.start]
    count = min(most, len(frames))
    return [frames[round(i * (len(frames) - 1) / max(1, count - 1))] for i in range(count)]


def write_place_page(path: Path, source: Source, spec: str, indices: Sequence[int], file: str = "FILE") -> None:
    """Write the page. `spec`: the source as typed, `file`: of the object. Raises SourceError, OutputError."""
    shown = [_frame(source[index], index, source.camera) for index in indices]
    size = {"width": source.camera.width, "height": source.camera.height, "step": DEPTH_STEP}
    data = json.dumps({"source": spec, "object": file, **size, "frames": shown}, separators=(",", ":"))
    page = PAGE.read_text(encoding="utf-8").replace(_DATA, data.replace("<", "\\u003c"), 1)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path} cannot be written ({error.strerror}): name another folder with --out") from error


def _frame(frame: RgbdFrame, index: int, camera: CameraModel) -> dict[str, Any]:
    jpeg = encode_camera_picture(shown_picture(frame.color, camera))
    depth = None if camera.depth is not None or camera.is_distorted else _depth_mm(frame.depth, camera)
    return {
        "index": index,
        "picture": f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}",
        "depth": None if depth is None else base64.b64encode(depth.astype("<u2").tobytes()).decode(),
    }


def _depth_mm(depth: NDArray[np.uint16], camera: CameraModel) -> NDArray[np.uint16]:
    """[ceil(h / step), ceil(w / step)] millimetres, 0: none."""
    near = depth[::DEPTH_STEP, ::DEPTH_STEP]
    return np.asarray(np.clip(np.rint(near * (1000.0 * camera.depth_scale_m)), 0, 65535), np.uint16)

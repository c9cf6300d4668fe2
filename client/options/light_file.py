"""Lights from files: `light.json` (ground truth), `light.jsonl` (output of this program) and panoramas."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from client.errors import OptionError
from protocol.limits import MAX_SH_BANDS
from protocol.messages import Rgb
from server.light.panorama import PanoramaError, panorama_sh, read_panorama

_COUNTS = tuple(bands * bands for bands in range(1, MAX_SH_BANDS + 1))

PANORAMAS = (".hdr", ".exr")
"""Endings of files that hold one."""

Coefficients = tuple[Rgb, ...]


def read_light(path: Path, radiance_of_white: float = 1.0) -> Coefficients:
    """Radiance SH in world axes of `{"sh": [[r, g, b], ...]}`, or of the last line of a `light.jsonl`.

    `sh_all` has precedence over `sh`. A line with `exposure` is divided by it, which gives the units of the session's
    first picture. Other files are divided by `radiance_of_white`, the radiance of a white pixel. Raises OptionError.
    """
    if path.suffix.lower() in PANORAMAS and path.is_file():
        raise OptionError(f"--light {path}: is a panorama; give it with --panorama")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise OptionError(f"--light {path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    return _coefficients(path, _document(path, text), radiance_of_white)


def read_panorama_light(path: Path, bands: int) -> Coefficients:
    """Radiance SH of a lat-long panorama, in WebXR's axes. Raises OptionError."""
    try:
        light = panorama_sh(read_panorama(path), bands)
    except PanoramaError as error:
        raise OptionError(f"--panorama {error}") from error
    return tuple((float(r), float(g), float(b)) for r, g, b in light)


def _document(path: Path, text: str) -> Any:
    """JSON of the whole file, or of its last line."""
    lines = [line for line in text.splitlines() if line.strip()]
    for candidate in (text, lines[-1] if lines else ""):
        try:
            return json.loads(candidate)
        except ValueError:
            continue
    raise OptionError(f"--light {path}: not JSON")


def _coefficients(path: Path, document: Any, radiance_of_white: float) -> Coefficients:
    rows = document.get("sh_all") or document.get("sh") if isinstance(document, dict) else None
    try:
        values = np.array(rows, np.float64)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.ndim != 2 or values.shape[1] != 3 or len(values) not in _COUNTS or not np.isfinite(values).all():
        raise OptionError(
            f'--light {path}: expected {{"sh": ...}} with {", ".join(map(str, _COUNTS))} finite [r, g, b]'
        )
    unit = _exposure(path, document) if document.keys() & {"frame", "exposure"} else radiance_of_white
    return tuple((float(r), float(g), float(b)) for r, g, b in values / unit)


def _exposure(path: Path, document: dict[str, Any]) -> float:
    exposure = document.get("exposure", 1.0)
    if type(exposure) not in (int, float) or not 0 < exposure < math.inf:
        raise OptionError(f"--light {path}: exposure is {exposure!r}, expected a positive number")
    return float(exposure)

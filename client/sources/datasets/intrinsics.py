"""Camera models in data-set files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from client.errors import SourceError
from client.sources.pictures import read_color
from client.sources.poses import float_of, read_text
from protocol.frames import CameraModel


def from_matrix_file(path: Path, picture: Path) -> CameraModel:
    """Camera of a text file with a 3x3 matrix; the size is that of `picture`. Raises SourceError."""
    numbers = [float_of(word, str(path)) for word in read_text(path).split()]
    if len(numbers) != 9:
        raise SourceError(f"{path}: intrinsics need 9 numbers, found {len(numbers)}")
    matrix = np.array(numbers).reshape(3, 3)
    return make(path, *size_of(picture), matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])


def from_open3d_json(path: Path) -> CameraModel:
    """Camera of Open3D's pinhole JSON (`width height intrinsic_matrix`, column-major). Raises SourceError."""
    values = read_json(path)
    matrix = values.get("intrinsic_matrix")
    if not isinstance(matrix, list) or len(matrix) != 9 or "width" not in values or "height" not in values:
        raise SourceError(f"{path}: expected width, height and an intrinsic_matrix of 9 numbers")
    return make(path, values["width"], values["height"], matrix[0], matrix[4], matrix[6], matrix[7])


def make(path: Path, width: Any, height: Any, fx: Any, fy: Any, cx: Any, cy: Any, **more: Any) -> CameraModel:
    """CameraModel of values read from `path`. Raises SourceError with `path`."""
    try:
        return CameraModel(
            width=int(width), height=int(height), fx=float(fx), fy=float(fy), cx=float(cx), cy=float(cy), **more
        )
    except (TypeError, ValueError) as error:
        raise SourceError(f"{path}: {error}") from error


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in `path`. Raises SourceError."""
    try:
        values = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise SourceError(f"{path}: is not JSON (line {error.lineno}: {error.msg})") from error
    if not isinstance(values, dict):
        raise SourceError(f"{path}: expected a JSON object")
    return values


def size_of(picture: Path) -> tuple[int, int]:
    """(width, height) of a picture. Raises SourceError."""
    height, width = read_color(picture).shape[:2]
    return width, height

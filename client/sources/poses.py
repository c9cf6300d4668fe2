"""Camera poses in data-set files: 4x4 text, TUM lines, Redwood logs. All are world_from_camera in metres."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from client.errors import SourceError

ROTATION_TOLERANCE = 5e-3
"""Largest accepted entry of R^T R - I; rounded or averaged poses in files stay below 1e-3."""


def rigid(matrix: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """`matrix` [4, 4] with an orthonormalised rotation. Raises SourceError with `where` if it is not rigid."""
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise SourceError(f"{where}: the pose has NaN or is not a 4x4 matrix")
    rotation = matrix[:3, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise SourceError(f"{where}: the pose is not a rotation and a translation")
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise SourceError(f"{where}: the pose's last row is not 0 0 0 1")
    u, _, vt = np.linalg.svd(rotation)
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = u @ vt, matrix[:3, 3]
    return result


def read_matrix(path: Path) -> NDArray[np.float64]:
    """world_from_camera [4, 4] of a text file with 16 numbers. Raises SourceError."""
    numbers = [float_of(word, f"{path}") for word in read_text(path).split()]
    if len(numbers) != 16:
        raise SourceError(f"{path}: a pose needs 16 numbers, found {len(numbers)}")
    return rigid(np.array(numbers).reshape(4, 4), str(path))


def read_tum(path: Path) -> list[tuple[float, NDArray[np.float64]]]:
    """[(timestamp_s, world_from_camera)] of `timestamp tx ty tz qx qy qz qw` lines. Raises SourceError."""
    poses = []
    for number, words in numbered_lines(path):
        where = f"{path}, line {number}"
        if len(words) != 8:
            raise SourceError(f"{where}: expected 'timestamp tx ty tz qx qy qz qw', found {len(words)} words")
        values = np.array([float_of(word, where) for word in words])
        poses.append((float(values[0]), from_quaternion(values[1:4], values[4:8], where)))
    return poses


def read_log(path: Path) -> dict[int, NDArray[np.float64]]:
    """{frame: world_from_camera} of a Redwood trajectory log (a line of three integers, then four rows)."""
    lines = list(numbered_lines(path))
    if len(lines) % 5:
        raise SourceError(f"{path}: a trajectory log has blocks of 5 lines, found {len(lines)} lines")
    poses = {}
    for block in (lines[i : i + 5] for i in range(0, len(lines), 5)):
        where = f"{path}, line {block[0][0]}"
        rows = [[float_of(word, where) for word in words] for _, words in block[1:]]
        if len(block[0][1]) != 3 or any(len(row) != 4 for row in rows):
            raise SourceError(f"{where}: expected three integers and a 4x4 matrix")
        poses[int(float_of(block[0][1][0], where))] = rigid(np.array(rows), where)
    return poses


def quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternion (x, y, z, w) of a rotation [3, 3]; w >= 0, or the first non-zero component positive if w is 0."""
    r = rotation
    # Dividing by the largest of the four candidates avoids division by small numbers.
    candidates = np.array(
        [
            [1 + r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
            [r[0, 1] + r[1, 0], 1 - r[0, 0] + r[1, 1] - r[2, 2], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 - r[0, 0] - r[1, 1] + r[2, 2], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], 1 + np.trace(r)],
        ]
    )
    best = candidates[np.argmax(np.diag(candidates))]
    leading = next(x for x in best[[3, 0, 1, 2]] if x != 0)
    unit: NDArray[np.float64] = best / np.copysign(np.linalg.norm(best), leading)
    return unit


def read_text(path: Path) -> str:
    """The file's text. Raises SourceError."""
    try:
        return path.read_text("utf-8")
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise SourceError(f"{path}: is not a text file") from error


def numbered_lines(path: Path) -> list[tuple[int, list[str]]]:
    """[(line number, words)] of all lines except comments and empty lines."""
    lines = ((number, line.split("#")[0].split()) for number, line in enumerate(read_text(path).splitlines(), 1))
    return [(number, words) for number, words in lines if words]


def float_of(word: str, where: str) -> float:
    """Parse a number. Raises SourceError with `where`."""
    try:
        return float(word)
    except ValueError:
        raise SourceError(f"{where}: {word!r} is not a number") from None


def from_quaternion(translation: NDArray[np.float64], xyzw: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """[4, 4] of a translation [3] and a quaternion (x, y, z, w). Raises SourceError with `where`."""
    norm = np.linalg.norm(xyzw)
    if not np.isfinite((*translation, norm)).all() or abs(norm - 1) > 0.01:
        raise SourceError(f"{where}: the pose has NaN or its quaternion is not of length 1")
    x, y, z, w = xyzw / norm
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = translation
    return matrix

"""Virtual objects of the command line, and their mesh files packed for one message."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from client.errors import ObjectError
from client.objects import obj_to_glb
from client.objects.glb import check_glb, gltf_to_glb
from protocol.limits import MAX_MESH_BYTES
from protocol.messages import ObjectFormat

FORMATS = ("glb", "gltf", "obj", "ply", "stl")
LARGEST_SCALE = 1000.0
_USE = "FILE[@x,y,z[,scale[,yaw_deg]]]"


@dataclass(frozen=True)
class ObjectFile:
    """One `--object`."""

    path: Path
    position_m: tuple[float, float, float] | None
    """World position of the bottom centre of the model's box; None: the vertices are world coordinates."""
    scale: float = 1.0
    yaw_deg: float = 0.0


def parse_object(text: str) -> ObjectFile:
    """Parse `FILE[@x,y,z[,scale[,yaw_deg]]]`; FILE may contain an @. Raises ObjectError."""
    if "@" not in text or Path(text).is_file():
        return ObjectFile(_existing(text), None)
    name, _, place = text.rpartition("@")
    numbers = _numbers(text, place)
    scale = numbers[3] if len(numbers) > 3 else 1.0
    if not 0 < scale <= LARGEST_SCALE:
        raise ObjectError(f"--object {text}: the scale must be more than 0 and at most {LARGEST_SCALE:g}")
    yaw_deg = numbers[4] if len(numbers) > 4 else 0.0
    return ObjectFile(_existing(name), (numbers[0], numbers[1], numbers[2]), scale, yaw_deg)


def pack_mesh(path: Path) -> tuple[ObjectFormat, bytes]:
    """(format, bytes) of a mesh file for one message: glb, obj, ply or stl.

    GLB, PLY, STL and OBJ without materials are unchanged; glTF, and OBJ with materials and textures, become one GLB
    with the same vertices. Raises ObjectError if the file is not a mesh or too large.
    """
    suffix = path.suffix.lower().lstrip(".")
    if suffix not in FORMATS:
        raise ObjectError(f"{path}: not a mesh this program reads; use {', '.join(FORMATS)}")
    data = read_bytes(path)
    format_, data = _PACKERS[suffix](path, data)
    if len(data) > MAX_MESH_BYTES:
        raise ObjectError(
            f"{path}: {len(data)} bytes is more than the {MAX_MESH_BYTES} a mesh may have with its "
            "textures; simplify it, or make those smaller"
        )
    return format_, data


def read_bytes(path: Path) -> bytes:
    """The file's bytes. Raises ObjectError."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise ObjectError(f"{path}: cannot be read ({error.strerror})") from error


def _existing(name: str) -> Path:
    path = Path(name).expanduser()
    if not path.is_file():
        raise ObjectError(f"--object {name}: no such file; expected {_USE}")
    return path


def _numbers(text: str, place: str) -> list[float]:
    try:
        numbers = [float(word) for word in place.split(",")]
    except ValueError:
        raise ObjectError(f"--object {text}: {place!r} is not numbers; expected {_USE}") from None
    if not 3 <= len(numbers) <= 5 or not all(math.isfinite(x) for x in numbers):
        raise ObjectError(f"--object {text}: {place!r} must be 3 to 5 finite numbers; expected {_USE}")
    return numbers


def _pack_glb(path: Path, data: bytes) -> tuple[ObjectFormat, bytes]:
    check_glb(path, data)
    return "glb", data


def _pack_gltf(path: Path, data: bytes) -> tuple[ObjectFormat, bytes]:
    return "glb", gltf_to_glb(path, data)


def _pack_obj(path: Path, data: bytes) -> tuple[ObjectFormat, bytes]:
    text = data.decode("utf-8", errors="replace")
    kinds = {line.split(maxsplit=1)[0] for line in text.splitlines() if line.strip()}
    if not {"v", "f"} <= kinds:
        raise ObjectError(f"{path}: is no OBJ mesh, it has no vertices or no faces")
    libraries = obj_to_glb.libraries(path, text)
    # Common readers misread negative indices, so they are resolved here.
    if libraries or obj_to_glb.has_negative_indices(text):
        return "glb", obj_to_glb.convert(path, text, libraries)
    return "obj", data


def _pack_ply(path: Path, data: bytes) -> tuple[ObjectFormat, bytes]:
    header = data[:65536]
    if not header.startswith(b"ply") or b"end_header" not in header or b"element vertex" not in header:
        raise ObjectError(f"{path}: is no PLY mesh, its header is not PLY's")
    return "ply", data


def _pack_stl(path: Path, data: bytes) -> tuple[ObjectFormat, bytes]:
    triangles = int.from_bytes(data[80:84], "little") if len(data) >= 84 else 0
    binary = triangles > 0 and len(data) >= 84 + 50 * triangles
    text = data.lstrip().startswith(b"solid") and b"facet" in data
    if not (binary or text):
        raise ObjectError(f"{path}: is no STL mesh, or it is truncated")
    return "stl", data


_PACKERS = {"glb": _pack_glb, "gltf": _pack_gltf, "obj": _pack_obj, "ply": _pack_ply, "stl": _pack_stl}

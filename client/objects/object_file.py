"""Virtual objects of the command line, and their mesh files packed for one message."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from msgspec import structs

from client.errors import ObjectError
from client.objects import obj_to_glb
from client.objects.glb import check_glb, gltf_to_glb
from protocol.limits import MAX_MESH_BYTES
from protocol.messages import Light, ObjectFormat, Spot, SpotKind

FORMATS = ("glb", "gltf", "obj", "ply", "stl")
LARGEST_SCALE = 1000.0
_USE = (
    "FILE[@PLACE[,SIZE[,yaw_deg]]] with PLACE x,y,z, pixel:U,V[:FRAME], floor, table or auto and SIZE a scale or 0.3m"
)
_OBJECT_ID = re.compile(r"object-(\d+)")  # as object_id


@dataclass(frozen=True)
class ObjectFile:
    """One `--object`."""

    path: Path
    position_m: tuple[float, float, float] | None
    """World position of the bottom centre of the model's box; None, without `spot`: the vertices are world
    coordinates."""
    scale: float = 1.0
    yaw_deg: float = 0.0
    spot: Spot | None = None
    """In place of `position_m`: found in the frames."""
    height_m: float | None = None
    """In place of `scale`."""


def parse_object(text: str) -> ObjectFile:
    """Parse `FILE[@PLACE[,SIZE[,yaw_deg]]]`; FILE may contain an @. Raises ObjectError.

    PLACE: `x,y,z`, `pixel:U,V[:FRAME]`, `floor`, `table` or `auto`. SIZE: a scale, or a height such as `0.3m`; with
    `auto` only a height.
    """
    if "@" not in text or Path(text).is_file():
        return ObjectFile(_existing(text), None)
    name, _, place = text.rpartition("@")
    spot, words = _spot(text, place)
    position = None
    if spot is None:
        x, y, z, *words = [*words, "", "", ""] if len(words) < 3 else words
        position = (_number(text, x), _number(text, y), _number(text, z))
    if len(words) > 2:
        raise ObjectError(f"--object {text}: too many numbers; expected {_USE}")
    scale, height_m = _size(text, words[0]) if words else (1.0, None)
    if spot is not None and spot.on == "auto" and words and height_m is None:
        raise ObjectError(f"--object {text}: auto chooses the size; leave the scale out, or give a height such as 0.3m")
    yaw_deg = _number(text, words[1]) if len(words) > 1 else 0.0
    return ObjectFile(_existing(name), position, scale, yaw_deg, spot, height_m)


def object_id(number: int) -> str:
    """Name of the n-th `--object` in the session; the same in `run` and `stream`."""
    return f"object-{number}"


def as_asked(light: Light) -> Light:
    """`light` with the lights at objects numbered as their `--object` stand, and in that order.

    A server has them in the order in which they were placed: one that waits for its spot comes last. Objects of others
    keep their numbers.
    """
    at = [structs.replace(one, index=_number_of(one.object, one.index)) for one in light.at]
    return structs.replace(light, at=tuple(sorted(at, key=lambda one: one.index if one.of == "object" else -1)))


def _number_of(name: str | None, number: int) -> int:
    """Of the `--object` with this name, else `number`."""
    found = _OBJECT_ID.fullmatch(name or "")
    return int(found[1]) if found else number


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


def _spot(text: str, place: str) -> tuple[Spot | None, list[str]]:
    """The spot that `place` names, if it names one, and the words after it."""
    first, *words = place.split(",")
    if first in {"floor", "table", "auto"}:
        return Spot(on=cast(SpotKind, first)), words
    if not first.startswith("pixel:"):
        return None, [first, *words]
    v, colon, frame = (words[0] if words else "").partition(":")
    pixel = _number(text, first.removeprefix("pixel:")), _number(text, v)
    if colon and not frame.isdecimal():
        raise ObjectError(f"--object {text}: {frame!r} is no number of a frame; expected {_USE}")
    return Spot(on="pixel", pixel=pixel, frame=int(frame) if colon else None), words[1:]


def _size(text: str, word: str) -> tuple[float, float | None]:
    """Scale, and height in metres if the word is one."""
    size = _number(text, word.removesuffix("m"))
    if not 0 < size <= LARGEST_SCALE:
        raise ObjectError(f"--object {text}: the scale or height must be more than 0 and at most {LARGEST_SCALE:g}")
    return (1.0, size) if word.endswith("m") else (size, None)


def _number(text: str, word: str) -> float:
    try:
        number = float(word)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ObjectError(f"--object {text}: {word!r} is no finite number; expected {_USE}")
    return number


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

"""Objects that a server offers its clients: the model files of one folder, and a vase of its own.

The folder is read anew whenever somebody asks, so that what is put there is there. Names are those of the listing and
nothing else: a name that leads elsewhere is none of them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal, cast, get_args

from protocol.limits import MAX_MESH_BYTES
from server.scene.vase import vase_glb

Format = Literal["glb", "obj", "ply", "stl"]
FORMATS = get_args(Format)
MAX_OBJECTS = 1000
"""Of the folder, by name; the rest is not offered."""
MEDIA_TYPES = {"glb": "model/gltf-binary", "obj": "model/obj", "ply": "application/octet-stream", "stl": "model/stl"}


class NoObject(LookupError):
    """There is no object of that name; one line."""


@dataclass(frozen=True)
class Offered:
    """One object of the library."""

    name: str
    """With its format, as the file's."""
    format: Format
    size_bytes: int


@dataclass(frozen=True)
class ObjectFile:
    """An object's bytes."""

    data: bytes
    media_type: str

    @property
    def etag(self) -> str:
        """Another one whenever the bytes are others."""
        return f'"{hashlib.sha256(self.data).hexdigest()[:32]}"'


class ObjectLibrary:
    """Used from any thread."""

    def __init__(self, folder: Path | None = None) -> None:
        """`folder`: None for the vase alone."""
        self._folder = None if folder is None else folder.resolve()
        self._own: dict[str, Callable[[], bytes]] = {"vase.glb": cache(vase_glb)}

    def listing(self) -> list[Offered]:
        """By name. Files that are no models, and those larger than a message takes, are left out."""
        own = [Offered(name, _format(name), len(make())) for name, make in self._own.items()]
        found = [
            Offered(path.name, _format(path.name), size)
            for path in self._files()
            if path.name not in self._own and 0 < (size := _size(path)) <= MAX_MESH_BYTES
        ]
        return sorted([*own, *sorted(found, key=_name)[:MAX_OBJECTS]], key=_name)

    def read(self, name: str) -> ObjectFile:
        """Raises NoObject."""
        if name in self._own:
            return ObjectFile(self._own[name](), MEDIA_TYPES[_format(name)])
        path = next((path for path in self._files() if path.name == name), None)
        try:
            if path is not None:
                with path.open("rb") as file:
                    data = file.read(MAX_MESH_BYTES + 1)
                if len(data) <= MAX_MESH_BYTES:
                    return ObjectFile(data, MEDIA_TYPES[_format(name)])
        except OSError:
            pass  # it was taken away just now, or may not be read: as if it were not there
        raise NoObject("there is no such object on this server: GET /v1/objects lists those that are")

    def _files(self) -> list[Path]:
        """Regular files of the folder that are called like models; links are followed within it."""
        folder = self._folder
        if folder is None:
            return []
        try:
            entries = list(folder.iterdir())
        except OSError:
            return []  # the folder was taken away
        models = [entry for entry in entries if entry.suffix[1:].lower() in FORMATS and not entry.name.startswith(".")]
        return [entry for entry in models if entry.is_file() and entry.resolve().is_relative_to(folder)]


def _name(offered: Offered) -> str:
    return offered.name


def _format(name: str) -> Format:
    return cast(Format, name.rpartition(".")[2].lower())


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0

"""Objects that a server offers to its clients: the model files of one folder and a built-in vase.

The folder is read on each request, so that new files appear at once. Only names of the listing are served; a path that
leads out of the folder never matches one.
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
"""Files of the folder that are offered: the first ones by name."""
MEDIA_TYPES = {"glb": "model/gltf-binary", "obj": "model/obj", "ply": "application/octet-stream", "stl": "model/stl"}


class NoObject(LookupError):
    """No object has this name; the message is one line."""


@dataclass(frozen=True)
class Offered:
    """Listing entry of one object."""

    name: str
    """File name with extension."""
    format: Format
    size_bytes: int


@dataclass(frozen=True)
class ObjectFile:
    """Content of an object."""

    data: bytes
    media_type: str

    @property
    def etag(self) -> str:
        """Digest of the content, for HTTP caching."""
        return f'"{hashlib.sha256(self.data).hexdigest()[:32]}"'


class ObjectLibrary:
    """Thread-safe."""

    def __init__(self, folder: Path | None = None) -> None:
        """`folder`: None offers only the vase."""
        self._folder = None if folder is None else folder.resolve()
        self._own: dict[str, Callable[[], bytes]] = {"vase.glb": cache(vase_glb)}

    def listing(self) -> list[Offered]:
        """All objects, sorted by name. Files of other types and files too large for a message are skipped."""
        own = [Offered(name, _format(name), len(make())) for name, make in self._own.items()]
        found = [
            Offered(path.name, _format(path.name), size)
            for path in self._files()
            if path.name not in self._own and 0 < (size := _size(path)) <= MAX_MESH_BYTES
        ]
        return sorted([*own, *sorted(found, key=_name)[:MAX_OBJECTS]], key=_name)

    def read(self, name: str) -> ObjectFile:
        """The object's content. Raises NoObject."""
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
            pass  # removed meanwhile or not readable: treated as absent
        raise NoObject("there is no such object on this server: GET /v1/objects lists those that are")

    def _files(self) -> list[Path]:
        """Regular files of the folder with a model's extension. Links are followed only within the folder."""
        folder = self._folder
        if folder is None:
            return []
        try:
            entries = list(folder.iterdir())
        except OSError:
            return []  # the folder was removed
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

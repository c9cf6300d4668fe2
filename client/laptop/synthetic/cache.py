"""Baked tables on disk: made once per scene and version of this code, made again where the file is unusable."""

from __future__ import annotations

import hashlib
import os
import tempfile
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_dir

Tables = dict[str, NDArray]
_UNUSABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)


def cached(name: str, compute: Callable[[], Tables]) -> Tables:
    """What `compute` returns, from the cache where it is there and whole; a cache that cannot be written is no error."""
    path = folder() / f"{name}-{code_version()}.npz"
    try:
        return _load(path)
    except _UNUSABLE:
        tables = compute()
    try:
        _store(path, tables)
    except OSError:
        pass  # read-only or full: the next start computes again
    return tables


def folder() -> Path:
    """Where the tables are kept."""
    return Path(user_cache_dir("probeless")) / "synthetic"


@cache
def code_version() -> str:
    """Changes whenever a source file of this package does."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


def _load(path: Path) -> Tables:
    with np.load(path, allow_pickle=False) as archive:
        tables = {key: archive[key] for key in archive.files}
    if bytes(tables.pop("digest")) != _digest(tables):
        raise ValueError("damaged")
    return tables


def _store(path: Path, tables: Tables) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
        np.savez(file, digest=np.frombuffer(_digest(tables), np.uint8), **tables)
    os.replace(file.name, path)
    for other in path.parent.glob(f"{path.name.split('-')[0]}-*.npz"):
        if other != path:
            other.unlink(missing_ok=True)


def _digest(tables: Tables) -> bytes:
    digest = hashlib.sha256()
    for key in sorted(tables):
        digest.update(
            f"{key} {tables[key].dtype} {tables[key].shape}".encode() + np.ascontiguousarray(tables[key]).data
        )
    return digest.digest()

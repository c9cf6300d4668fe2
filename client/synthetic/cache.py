"""Disk cache of precomputed tables, per scene and version of this code; unusable files are computed again."""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_dir

from client.progress import note

Tables = dict[str, NDArray[Any]]
KEPT_VERSIONS = 4
_UNUSABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)


def cached(name: str, compute: Callable[[], Tables]) -> Tables:
    """The result of `compute`, from the cache if it is there and intact. An unwritable cache is ignored."""
    path = folder() / f"{name}-{code_version()}.npz"
    with contextlib.suppress(*_UNUSABLE):
        return _load(path)
    with _alone(path):
        with contextlib.suppress(*_UNUSABLE):
            return _load(path)  # another process has computed it meanwhile
        if sys.stderr.isatty():
            note(f"computing shadows of the synthetic scene {name}, once")
        tables = compute()
        with contextlib.suppress(OSError):
            _store(path, tables)
    return tables


@contextlib.contextmanager
def _alone(path: Path) -> Iterator[None]:
    """One process at a time computes the file; where files cannot be locked, each does."""
    try:
        import fcntl

        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.with_suffix(".lock").open("w")
    except (ImportError, OSError):
        yield
        return
    with file:
        fcntl.flock(file, fcntl.LOCK_EX)  # released when the file is closed
        yield
        path.with_suffix(".lock").unlink(missing_ok=True)


def folder() -> Path:
    """Folder of the cache."""
    return Path(user_cache_dir("probeless")) / "synthetic"


@cache
def code_version() -> str:
    """Hash of the source files of this package."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


def _load(path: Path) -> Tables:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        tables = {key: archive[key] for key in archive.files}
    if bytes(tables.pop("digest")) != _digest(tables):
        raise ValueError("damaged")
    return tables


def _store(path: Path, tables: Tables) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
        np.savez(file, allow_pickle=False, digest=np.frombuffer(_digest(tables), np.uint8), **tables)
    os.replace(file.name, path)
    versions = sorted(path.parent.glob(f"{path.name.rpartition('-')[0]}-*.npz"), key=lambda p: p.stat().st_mtime)
    for old in versions[:-KEPT_VERSIONS]:
        old.unlink(missing_ok=True)


def _digest(tables: Tables) -> bytes:
    digest = hashlib.sha256()
    for key in sorted(tables):
        digest.update(
            f"{key} {tables[key].dtype} {tables[key].shape}".encode() + np.ascontiguousarray(tables[key]).data
        )
    return digest.digest()

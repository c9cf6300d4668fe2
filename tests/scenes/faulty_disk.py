"""A disk that fails at a chosen moment: it is full, or the power is cut."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest

MODULES = (
    "server.service.saving.checksummed_files",
    "server.service.saving.save_slot",
    "server.service.saving.room_store",
)


class PowerCut(BaseException):
    """Nothing of the program runs any more."""


class FaultyDisk:
    """Takes the place of `os` in what saves rooms. Counts what changes the disk, and fails at one of these."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.steps = 0
        self.fails_at = 0
        """Number of the step; 0: none."""
        self.error: BaseException = PowerCut()
        self.only_writes = False
        """Count nothing else."""
        self._paths: dict[int, Path] = {}
        self._unsynced: set[Path] = set()
        self._replaced: list[tuple[Path, bytes | None]] = []
        for module in MODULES:
            patch.setattr(f"{module}.os", self)
        unlink, mkdir = Path.unlink, Path.mkdir
        patch.setattr(Path, "unlink", lambda *given, **how: self._step() or unlink(*given, **how))
        patch.setattr(Path, "mkdir", lambda *given, **how: self._step() or mkdir(*given, **how))

    def __getattr__(self, name: str) -> Any:
        return getattr(os, name)

    def fail_at(self, step: int, error: BaseException) -> None:
        """At the `step`-th from now on."""
        self.steps, self.fails_at, self.error = 0, step, error

    def open(self, path: Path, flags: int, mode: int = 0o777) -> int:
        """As os.open."""
        if flags & os.O_CREAT:
            self._step()
        file = os.open(path, flags, mode)
        self._paths[file] = Path(path)
        return file

    def write(self, file: int, data: memoryview) -> int:
        """As os.write; where it fails, half of it is there."""
        self._unsynced.add(self._paths[file])
        try:
            self._step(is_write=True)
        except BaseException:
            os.write(file, data[: len(data) // 2])
            raise
        return os.write(file, data)

    def fsync(self, file: int) -> None:
        """As os.fsync."""
        self._step()
        self._unsynced.discard(self._paths[file])
        if self._paths[file].is_dir():
            self._replaced.clear()

    def replace(self, old: Path, new: Path) -> None:
        """As os.replace."""
        self._step()
        self._replaced.append((new, new.read_bytes() if new.is_file() else None))
        os.replace(old, new)

    def cut(self) -> None:
        """Take back what had not reached the disk for sure."""
        for path in self._unsynced:
            if path.exists():
                os.truncate(path, path.stat().st_size // 2)
        for path, before in reversed(self._replaced):
            if before is None:
                path.rename(path.with_name("was-not-renamed"))
            else:
                path.write_bytes(before)
        self.fails_at = 0

    def _step(self, *, is_write: bool = False) -> None:
        if self.only_writes and not is_write:
            return
        self.steps += 1
        if self.steps == self.fails_at:
            raise self.error


def full() -> OSError:
    """As of a disk without room."""
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

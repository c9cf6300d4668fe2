"""Parts of a suite that are done, kept until the suite is: a run that was stopped goes on where it was."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from tests.bench.report.report import Row, Unmeasured, commit

ROOT = Path(__file__).resolve().parents[3]
CODE = ("cl_kernels", "client", "protocol", "server", "tests/bench")
LIBRARIES = (
    "flip-evaluator",
    "numpy",
    "open3d",
    "opencv-contrib-python-headless",
    "pocl-binary-distribution",
    "pyopencl",
)


class UnmeasurableError(Exception):
    """This machine cannot measure a part; one line with the reason."""


@dataclass
class Part:
    """What one part of a suite measured."""

    rows: list[Row] = field(default_factory=list)
    unmeasured: list[Unmeasured] = field(default_factory=list)
    sizes: dict[str, int] = field(default_factory=dict)
    """How many frames, trials or messages it took."""
    details: dict[str, Any] = field(default_factory=dict)
    """What pictures are drawn from; JSON."""

    def add(self, name: str, value: float, unit: str, goal: str = "") -> None:
        """A row, or a note that there is no figure where `value` is not finite."""
        if math.isfinite(value):
            self.rows.append(Row(name, float(value), unit, goal))
        else:
            self.leave_out(name, "the figure is not finite")

    def leave_out(self, name: str, reason: str) -> None:
        """Say that `name` was not measured."""
        self.unmeasured.append(Unmeasured(name, reason))


class Finished:
    """Finished parts as JSON files in `folder`/parts, of this code, device, size of run and these libraries only."""

    def __init__(self, folder: Path, device: str, quick: bool) -> None:
        self._folder = folder / "parts"
        self._key = {
            "commit": commit(),
            "code": code_digest(ROOT / name for name in CODE),
            "device": device,
            "quick": quick,
            "libraries": {name: _version(name) for name in LIBRARIES},
        }

    def part(self, name: str, measure: Callable[[], Part], say: Callable[[str], None]) -> Part:
        """The part called `name`: as it was finished before, or measured now and kept."""
        kept = self._read(name)
        if kept is not None:
            say(f"{name}: finished before, taken from {self._path(name)}")
            return kept
        say(f"{name} ...")
        started = time.monotonic()
        try:
            part = measure()
        except UnmeasurableError as error:
            part = Part()
            part.leave_out(name, str(error))
        say(f"{name}: {time.monotonic() - started:.0f} s")
        self._folder.mkdir(parents=True, exist_ok=True)
        self._path(name).write_text(json.dumps({"key": self._key, "part": asdict(part)}, indent=1))
        return part

    def forget(self) -> None:
        """The suite is complete: the next run measures anew."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def _path(self, name: str) -> Path:
        return self._folder / f"{name.replace(' ', '_').replace('/', '_')}.json"

    def _read(self, name: str) -> Part | None:
        try:
            stored = json.loads(self._path(name).read_text())
        except (OSError, ValueError):  # none yet, or a run was stopped while writing it
            return None
        if stored.get("key") != self._key:
            return None
        part = stored["part"]
        rows = [Row(**row) for row in part["rows"]]
        return Part(rows, [Unmeasured(**item) for item in part["unmeasured"]], part["sizes"], part["details"])


def code_digest(folders: Iterable[Path]) -> str:
    """Of all Python and OpenCL sources below: a commit does not tell what is changed in the checkout."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted(p for p in folder.rglob("*") if p.suffix in {".py", ".cl", ".clh"}):
            digest.update(path.relative_to(folder).as_posix().encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None

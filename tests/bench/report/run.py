"""What every part of a suite is told, and where the public data sets are."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from client.options.source import open_source
from client.sources.frame_source import Source
from server.opencl.device import Device
from tests.bench.report.finished import ROOT, UnmeasurableError

Say = Callable[[str], None]


@dataclass(frozen=True)
class Run:
    """What every part is told."""

    device: Device
    quick: bool
    say: Say

    def of(self, quick: int, full: int) -> int:
        """How many: the one of this size of run."""
        return quick if self.quick else full


def data_folder(name: str) -> Path:
    """Folder of a public data set. Raises UnmeasurableError."""
    base = Path(os.environ.get("PROBELESS_DATA", ROOT.parent / "shared" / "data"))
    if not (base / name).exists():
        raise UnmeasurableError(f"public data set {name} is not at {base} (set PROBELESS_DATA)")
    return base / name


def data_source(name: str) -> Source:
    """A public data set as a source. Raises UnmeasurableError."""
    return open_source(str(data_folder(name)))

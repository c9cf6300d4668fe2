"""Where the public data sets are, for tests that need them."""

import os
from pathlib import Path

import pytest

from tests.absent import NO_DATA

ROOT = Path(__file__).resolve().parents[1]


def data_folder(name: str) -> Path:
    """Folder or file `name` of the public data; skips the test, with the reason, where it is absent."""
    base = Path(os.environ.get("PROBELESS_DATA", ROOT.parent / "shared" / "data"))
    path = base / name
    if not path.exists():
        pytest.skip(f"{NO_DATA} {name} is not at {base} (set PROBELESS_DATA)")
    return path

"""Options that need a package that `make install` does not install: checked before a run begins."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from client.errors import OptionError

RECORDING_SUFFIX = ".rrd"


def check_extras(video: bool, rerun: Path | None) -> None:
    """Raises OptionError for `--video` and `--rerun` where their package is missing, and for another suffix."""
    if video and find_spec("av") is None:
        raise OptionError("--video needs PyAV, which is not installed: make install-video, or pip install av")
    if rerun is None:
        return
    if rerun.suffix != RECORDING_SUFFIX:
        raise OptionError(f"--rerun {rerun}: expected a file whose name ends with {RECORDING_SUFFIX}")
    if find_spec("rerun") is None:
        raise OptionError(
            "--rerun needs rerun-sdk, which is not installed: make install-rerun, or pip install rerun-sdk"
        )

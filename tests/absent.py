"""What a test may be skipped for. With PROBELESS_EXPECT=all, as in CI, any other skip is a failure."""

from __future__ import annotations

import os

import pytest

NO_DATA = "public data set"
NO_HARDWARE = "this machine's hardware: "
NO_TOOLCHAIN = "no toolchain that the project does not install: "
"""How reasons begin that CI accepts."""


def is_unexpected(reason: str) -> bool:
    """Whether everything that can be installed is expected here, and this could have been."""
    text = reason.removeprefix("Skipped: ")
    return os.environ.get("PROBELESS_EXPECT") == "all" and not text.startswith((NO_DATA, NO_HARDWARE, NO_TOOLCHAIN))


def fail_unexpected_skip(report: pytest.TestReport | pytest.CollectReport) -> None:
    """Turn a skip that is not accepted here into a failure."""
    if report.skipped and not hasattr(report, "wasxfail") and isinstance(report.longrepr, tuple):
        reason = report.longrepr[2]
        if is_unexpected(reason):
            report.outcome = "failed"
            report.longrepr = f"skipped, though PROBELESS_EXPECT=all: {reason}"

"""Processor time of benchmarks: other processes of this one count, those that end do not break it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.bench.report import processor
from tests.bench.report.processor import ProcessorTime

SPIN = "import time\nwhile time.process_time() < 0.5: pass\nprint(flush=True)\ninput()"
"""Works, says so, and waits."""


def spun() -> subprocess.Popen[str]:
    child = subprocess.Popen([sys.executable, "-c", SPIN], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    child.stdout.readline()
    return child


@pytest.mark.skipif(not processor.PROC.is_dir(), reason="no /proc")
def test_what_a_child_spends_counts() -> None:
    spent = ProcessorTime()
    child = spun()
    assert 400 < spent.ms() < 5000
    assert ProcessorTime().ms() < 200, "what it spent before does not"
    child.communicate("\n")
    assert spent.ms() < 400, "one that has ended does not"


def test_without_proc_the_own_time_counts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(processor, "PROC", tmp_path / "none")
    spent = ProcessorTime()
    sum(range(1_000_000))
    assert spent.ms() > 0

"""Metrics keep to Prometheus's rules for names, and say which process and which version they are of."""

from __future__ import annotations

import os
import shutil
import subprocess
from importlib.metadata import version
from pathlib import Path

import pytest

from protocol.messages import Composite
from tests.service.fakes import frame_message
from tests.service.http import get, rows
from tests.service.promlint import problems
from tests.service.wire import Wire


def test_names_keep_to_prometheus_rules(start_server, tmp_path: Path) -> None:
    server = start_server(data=tmp_path)
    wire = Wire(server.url)
    wire.greet()
    wire.say(frame_message(0))
    wire.hear_until(Composite)
    text = get(server, "/metrics").text
    assert problems(text) == []
    assert text.count("# TYPE probeless_") >= 20
    assert "_created" not in text
    if shutil.which("promtool"):
        subprocess.run(["promtool", "check", "metrics"], input=text.encode(), check=True)
    wire.hang_up()


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("# HELP a_ms x\n# TYPE a_ms gauge\na_ms 1\n", "a_ms: unit is not a base unit"),
        ("# HELP removed x\n# TYPE removed counter\nremoved 1\n", "removed: a counter ends in _total"),
        ("# HELP a_total x\n# TYPE a_total gauge\na_total 1\n", "a_total: gauge, but ends in _total"),
        ("# TYPE a gauge\na 1\n", "a: no help"),
        ("# HELP a_gauge x\n# TYPE a_gauge gauge\na_gauge 1\n", "a_gauge: type in the name"),
        ("# HELP a_created x\n# TYPE a_created gauge\na_created 1\n", "a_created: a series of times of creation"),
        ("# HELP a_count x\n# TYPE a_count gauge\na_count 1\n", "a_count: ends like a histogram's sample"),
        ("# HELP aB x\n# TYPE aB gauge\naB 1\n", "aB: not in snake case"),
    ],
)
def test_rules_find_what_is_wrong(line: str, problem: str) -> None:
    assert problem in problems(line)


def test_they_say_which_process_and_which_version(server) -> None:
    found = rows(server)
    assert found["probeless_build_info", version("probeless")] == 1
    own = len(os.listdir("/proc/self/fd"))
    assert found["process_open_fds",] == pytest.approx(own, abs=50)  # of this process, in which the server runs
    for name in ("process_cpu_seconds_total", "process_resident_memory_bytes", "process_start_time_seconds"):
        assert found[name,] > 0

"""The token is for a person on the console and never in a log of JSON."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.data import ROOT
from tests.service.fakes import PATIENCE_S

TOKEN = "a-token-of-this-test"
PROGRAM = f"""
import sys
from server.service.edge.authenticator import Authenticator
from server.service.monitoring.console import console_of
from server.service.monitoring.event_log import log_events
from server.service.serve import listen, serve_on
from server.service.service import Service
from tests.service.fakes import FAKE_DEVICE, Lab, fake_mesh

log_events(sys.argv[1])
console = console_of(sys.argv[1], is_token_given=sys.argv[2] == "given")
service = Service(FAKE_DEVICE, pipeline_factory=Lab().build, mesh_loader=fake_mesh)
listener, guard = listen(sys.argv[3], 0), Authenticator("{TOKEN}")
sys.exit(serve_on(listener, service, console.say, guard, shows_token=console.shows_token))
"""


def said(log: str, token: str, keys: Path, *, one_stream: bool, host: str = "127.0.0.1") -> tuple[str, str]:
    """What a server says on standard output and standard error from its start to its end."""
    errors = subprocess.STDOUT if one_stream else subprocess.PIPE
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, log, token, host],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=errors,
        text=True,
        env=os.environ | {"PROBELESS_KEYS": str(keys)},
    )
    try:
        lines = []
        for line in process.stdout:
            lines.append(line)
            if "ready: open" in line:
                break
        process.send_signal(signal.SIGTERM)
        rest = process.stdout.read()  # not communicate, which leaves out what has been read ahead
        err = "" if one_stream else process.stderr.read()
        process.wait(PATIENCE_S)
    finally:
        process.kill()
        process.wait()
        for stream in (process.stdout, process.stderr):
            if stream is not None:
                stream.close()
    assert process.returncode == 0
    return "".join(lines) + rest, err


@pytest.mark.parametrize(("host", "lines"), [("127.0.0.1", 1), ("0.0.0.0", 3)])
def test_a_person_sees_it_in_every_line_that_others_need(host: str, lines: int, tmp_path: Path) -> None:
    out, err = said("text", "made up", tmp_path, one_stream=True, host=host)
    assert sum(TOKEN in line for line in out.splitlines()) == lines
    assert err == ""


def test_a_person_sees_one_that_was_made_up_beside_a_log_of_json(tmp_path: Path) -> None:
    out, err = said("json", "made up", tmp_path, one_stream=False)
    assert out.count(TOKEN) == 1
    assert TOKEN not in err
    assert [json.loads(line) for line in err.splitlines()]


def test_one_that_was_given_is_not_said_beside_a_log_of_json(tmp_path: Path) -> None:
    out, err = said("json", "given", tmp_path, one_stream=False)
    assert TOKEN not in out + err


@pytest.mark.parametrize("token", ["made up", "given"])
def test_where_the_console_is_the_log_all_is_json_without_it(token: str, tmp_path: Path) -> None:
    out, _ = said("json", token, tmp_path, one_stream=True)
    events = [json.loads(line)["event"] for line in out.splitlines()]
    assert TOKEN not in out
    assert events[0].startswith("probeless serves at http://127.0.0.1:")
    assert events[-1] == "stopped"
    [where] = [event for event in events if event.startswith("its token is in ")]
    assert Path(where.removeprefix("its token is in ")).parent == tmp_path

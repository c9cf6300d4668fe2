"""What the server writes of what happens, and what it measures: one line an event, complete and honest."""

from __future__ import annotations

import io
import json
import logging
import socket
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from protocol.messages import Bye, Hello, Wishes
from server.opencl.device_memory import DeviceMemory
from server.opencl.profile import Profile
from server.service.graceful_shutdown import GOODBYE
from server.service.monitoring.event_log import JsonLines, TextLines, about, facts_of
from tests.data import ROOT
from tests.service.fakes import CAMERA, EXPLODE_MM, PATIENCE_S, frame_message
from tests.service.http import rows
from tests.service.wire import Wire


@pytest.fixture
def written() -> Iterator[io.StringIO]:
    """Everything that is logged, as JSON lines."""
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.setFormatter(JsonLines())
    logger = logging.getLogger("server")
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    yield stream
    logger.removeHandler(handler)
    logger.setLevel(before)


def events(stream: io.StringIO) -> list[dict]:
    return [json.loads(line) for line in stream.getvalue().splitlines()]


def record(**options: object) -> logging.LogRecord:
    return logging.makeLogRecord({"msg": "a %s", "args": ("thing",), "levelname": "INFO", "name": "server.x"} | options)


def test_a_line_says_what_it_is_about() -> None:
    with about(session="session-1"), about(room="kitchen"):
        line = JsonLines().format(record(code=4401))
        text = TextLines().format(record(code=4401))
    fields = json.loads(line)
    assert fields.pop("time").endswith("+00:00")
    assert fields == {
        "level": "info",
        "event": "a thing",
        "logger": "server.x",
        "session": "session-1",
        "room": "kitchen",
        "code": 4401,
    }
    assert text.endswith("info: a thing session=session-1 room=kitchen code=4401")
    assert facts_of(record()) == {}


def test_what_ray_puts_on_records_is_not_told() -> None:
    assert facts_of(record(_ray_timestamp_ns=1)) == {}


def test_what_a_client_says_cannot_make_lines_of_its_own() -> None:
    hostile = record(reason='x\n{"event": "forged"}\r\nINFO', args=("\nforged",))
    assert JsonLines().format(hostile).count("\n") == 0
    assert TextLines().format(hostile).count("\n") == 0


@pytest.mark.parametrize("sent", ["\n", "\r", "\x1b[2J", "\x00", "\x7f", "\x85", "\x9b", "\u2028", "\u202e", "\ud800"])
def test_what_a_client_says_cannot_control_the_terminal(sent: str) -> None:
    hostile = record(msg=f"a{sent}", args=(), client=f"b{sent}")
    assert TextLines().format(hostile).isprintable()
    assert json.loads(JsonLines().format(hostile))["client"] == f"b{sent}"


def test_what_a_client_says_cannot_add_fields() -> None:
    text = TextLines().format(record(client='x session=session-9 said="yes"'))
    assert text.endswith(r' client="x session=session-9 said=\"yes\""')
    assert TextLines().format(record(client="")).endswith(' client=""')


def test_an_errors_words_cannot_begin_a_line() -> None:
    error = ValueError("x\n12:00:00 info: forged\x1b[2J")
    first, *rest = TextLines().format(record(exc_info=(ValueError, error, None))).split("\n")
    assert "a thing" in first
    assert rest
    assert all(line.startswith("    ") and line.isprintable() for line in rest)


def test_numbers_that_json_does_not_have_are_words() -> None:
    line = JsonLines().format(record(wait_s=float("nan"), most_s=float("inf")))
    fields = json.loads(line, parse_constant=pytest.fail)
    assert (fields["wait_s"], fields["most_s"]) == ("nan", "inf")


LOUD = """
import logging, threading, uvicorn, warnings
import numpy as np
from server.service.monitoring.event_log import log_events
log_events("json")
config = uvicorn.Config(None, log_config=None, log_level="warning")  # as serve.py
np.zeros(1) / np.zeros(1)
warnings.warn("two\\nlines", stacklevel=1)
logging.getLogger("uvicorn.error").warning("Invalid HTTP request received.")
thread = threading.Thread(target=lambda: 1 / 0, name="worker")
thread.start()
thread.join()
class Loud:
    def __del__(self):
        raise ValueError("at the end")
Loud()
"""


def test_json_logs_are_json_whoever_speaks() -> None:
    done = subprocess.run([sys.executable, "-c", LOUD], cwd=ROOT, capture_output=True, text=True, check=True)
    said = [json.loads(line) for line in done.stderr.splitlines()]
    assert [event["logger"] for event in said] == [
        "py.warnings",
        "py.warnings",
        "uvicorn.error",
        "server.service.monitoring.event_log",
        "server.service.monitoring.event_log",
    ]
    assert "RuntimeWarning: invalid value" in said[0]["event"]
    assert said[3]["error"] == "ZeroDivisionError: division by zero"
    assert said[3]["of"] == "worker"
    assert said[4]["error"] == "ValueError: at the end"


def test_an_error_says_its_stage() -> None:
    profile = Profile()
    try:
        with profile.stage("rendering"), profile.stage("input"):
            raise RuntimeError("no memory")
    except RuntimeError as error:
        fields = json.loads(JsonLines().format(record(exc_info=(type(error), error, None))))
    assert fields["stage"] == "input"
    assert fields["error"] == "RuntimeError: no memory"
    assert "in stage rendering" in fields["traceback"]


def test_a_sessions_life_is_written_with_its_name(dial, written, lab) -> None:
    wire = dial()
    session = wire.greet().session
    wire.say(Bye())
    assert wire.ending()[0] == 1000
    assert lab.closed.wait(PATIENCE_S)
    while len(events(written)) < 2:  # the server ends the session after it has closed the socket
        pass
    opened, closed = events(written)
    assert (opened["event"], opened["client"], opened["picture"]) == ("session opened", "test", "48x32")
    assert closed["event"] == "session closed"
    assert opened["session"] == closed["session"] == session
    assert opened["address"] == "127.0.0.1"


def test_a_failing_session_is_written_with_its_name_and_error(dial, written) -> None:
    wire = dial()
    session = wire.greet().session
    wire.say(frame_message(0, EXPLODE_MM))
    assert wire.ending()[0] == 1011
    failed = next(event for event in events(written) if event["level"] == "error")
    assert failed["session"] == session
    assert failed["error"] == "RuntimeError: secret internals"
    assert "Traceback" in failed["traceback"]


def reason_of_the_end(stream: io.StringIO) -> str:
    deadline_s = time.monotonic() + PATIENCE_S
    while not (closed := [event for event in events(stream) if event["event"] == "session closed"]):
        assert time.monotonic() < deadline_s
        time.sleep(0.01)
    return closed[0]["reason"]


def test_the_end_of_a_session_has_its_reason(dial, written) -> None:
    wire = dial()
    wire.greet()
    wire.say(Bye())
    assert reason_of_the_end(written) == "the client left"


def test_a_lost_connection_is_the_reason(dial, written) -> None:
    wire = dial()
    wire.greet()
    wire.socket.socket.shutdown(socket.SHUT_RDWR)
    assert reason_of_the_end(written) == "the connection was lost"


def test_a_client_that_does_not_come_back_is_the_reason(dial, written) -> None:
    wire = dial()
    wire.say(Hello(client="test", camera=CAMERA, keep_s=0.1))
    wire.hear()
    wire.socket.socket.shutdown(socket.SHUT_RDWR)
    assert reason_of_the_end(written) == "the connection was lost, the client has not come back"


def test_a_refusal_and_a_failure_are_the_reason(dial, written) -> None:
    wire = dial()
    wire.greet()
    wire.socket.send("text")
    assert "text message" in reason_of_the_end(written)
    written.seek(written.truncate(0))
    wire = dial()
    wire.greet()
    wire.say(frame_message(0, EXPLODE_MM))
    assert reason_of_the_end(written) == "the server failed: RuntimeError"


def test_a_stopping_server_is_the_reason(start_server, written) -> None:
    server = start_server()
    wire = Wire(server.url)
    wire.greet()
    server.stop()
    assert reason_of_the_end(written) == GOODBYE
    wire.hang_up()


@pytest.mark.parametrize(
    ("options", "code"), [({"subprotocols": ("probeless-v999",)}, 1002), ({"path": "/elsewhere"}, 1008)]
)
def test_every_refusal_has_its_address(server, written, options, code) -> None:
    wire = Wire(server.url, **options)
    assert wire.ending()[0] == code
    refused = next(event for event in events(written) if event["event"] == "client refused")
    assert (refused["code"], refused["address"]) == (code, "127.0.0.1")
    assert rows(server)["probeless_refused_total", str(code)] == 1


def test_a_refusal_is_written_and_counted(server, dial, written) -> None:
    wire = dial()
    wire.say(Hello(client="test", camera=CAMERA, wishes=Wishes(preset="auto")))
    code, reason, _ = wire.ending()
    refused = next(event for event in events(written) if event["event"] == "client refused")
    assert (refused["code"], refused["reason"], refused["address"]) == (code, reason, "127.0.0.1")
    assert rows(server)["probeless_refused_total", "1008"] == 1


def test_metrics_say_readiness_and_memory(server) -> None:
    found = rows(server)
    assert found["probeless_ready",] == 1
    assert found["probeless_device_memory_bytes",] == 4096
    for kind in ("mesh", "picture"):
        assert found["probeless_parser_deaths_total", kind] == 0


class Block:
    """Some memory."""

    def __init__(self, bytes_held: int) -> None:
        self.bytes_held = bytes_held


def test_memory_is_counted_while_it_is_held() -> None:
    memory, kept = DeviceMemory(), Block(3)
    memory.add(kept)
    memory.add(Block(5))
    passing = Block(7)
    memory.add(passing)
    assert memory.bytes_held == 10
    del passing
    assert memory.bytes_held == 3

"""What the server writes of what happens, and what it measures: one line an event, complete and honest."""

from __future__ import annotations

import io
import json
import logging
from collections.abc import Iterator

import pytest

from protocol.messages import Bye, Hello, Wishes
from server.opencl.device_memory import DeviceMemory
from server.opencl.profile import Profile
from server.service.event_log import JsonLines, TextLines, about, facts_of
from tests.service.fakes import CAMERA, EXPLODE_MM, PATIENCE_S, frame_message
from tests.service.http import rows


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


def test_what_a_client_says_cannot_make_lines_of_its_own() -> None:
    hostile = record(reason='x\n{"event": "forged"}\r\nINFO', args=("\nforged",))
    assert JsonLines().format(hostile).count("\n") == 0
    assert TextLines().format(hostile).count("\n") == 0


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


def test_a_refusal_is_written_and_counted(server, dial, written) -> None:
    wire = dial()
    wire.say(Hello(client="test", camera=CAMERA, wishes=Wishes(preset="auto")))
    code, reason, _ = wire.ending()
    refused = next(event for event in events(written) if event["event"] == "client refused")
    assert (refused["code"], refused["reason"]) == (code, reason)
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

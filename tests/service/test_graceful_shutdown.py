"""Leaving in order: nobody new, everybody told, everything saved, in time; by SIGTERM with status 0."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
import threading
import time
from unittest.mock import MagicMock, patch

import httpx
import pytest
from websockets.protocol import State
from websockets.server import ServerProtocol

from protocol.messages import Acknowledged, Bye, Composite, Dropped, Error, Quality
from server.service.edge.lingering_close import LingeringCloseWebSocket
from server.service.graceful_shutdown import DRAINING, GOODBYE, GracefulShutdown
from server.service.serve import BackgroundServer
from tests.data import ROOT
from tests.service.fakes import PATIENCE_S, frame_message
from tests.service.http import get
from tests.service.serve_fake import SERVE_FAKE
from tests.service.wire import Wire


def stopping(server: BackgroundServer) -> threading.Thread:
    """A thread in which the server stops."""
    thread = threading.Thread(target=server.stop)
    thread.start()
    return thread


def test_everybody_is_told_goodbye_with_1012(start_server) -> None:
    server = start_server()
    capturing, watching, silent = (Wire(server.url) for _ in range(3))
    capturing.greet()
    watching.watch()
    stopped = stopping(server)
    for wire in (capturing, watching, silent):
        code, reason, messages = wire.ending()
        assert (code, reason) == (1012, GOODBYE)
        assert messages[-1] == Bye(reason=GOODBYE)
    stopped.join(PATIENCE_S)
    assert not stopped.is_alive()


@pytest.mark.parametrize("state", list(State))
def test_a_connection_that_is_closing_does_not_keep_the_server_from_leaving(state: State) -> None:
    """uvicorn sends a close frame, which websockets refuses where the client's is being answered."""
    connection = LingeringCloseWebSocket.__new__(LingeringCloseWebSocket)
    connection.handshake_complete, connection.close_sent, connection.queue = True, False, MagicMock()
    connection.transport, connection.conn = MagicMock(), ServerProtocol()
    connection.conn._state = state
    with patch.object(LingeringCloseWebSocket, "stop_keepalive"):
        connection.shutdown()
    connection.transport.close.assert_called_once()
    assert connection.transport.write.called == (state is State.OPEN)


def test_while_a_session_ends_nobody_new_is_taken_and_health_says_so(start_server, lab, monkeypatch) -> None:
    server = start_server()
    monkeypatch.setattr("server.service.serve.DRAIN_PATIENCE_S", 10 * PATIENCE_S)
    monkeypatch.setattr("server.service.graceful_shutdown.ANSWER_PATIENCE_S", 0.0)
    lab.hold = True
    wire = Wire(server.url)
    wire.greet()
    wire.say(frame_message(0))
    lab.next_entered()
    stopped = stopping(server)
    assert wire.ending()[0] == 1012
    late = Wire(server.url)
    code, reason, messages = late.ending()
    assert (code, reason) == (1013, DRAINING)
    assert messages == [Error(reason=DRAINING, fatal=True)]
    health = get(server, "/healthz")
    assert health.status_code == 503
    assert health.json()["draining"] is True
    assert health.json()["ready"] is False
    lab.release()
    stopped.join(PATIENCE_S)
    assert lab.closed.is_set()


def test_frames_on_the_way_are_answered_before_the_goodbye(start_server, lab, monkeypatch) -> None:
    monkeypatch.setattr("server.service.serve.DRAIN_PATIENCE_S", 10 * PATIENCE_S)
    monkeypatch.setattr("server.service.graceful_shutdown.ANSWER_PATIENCE_S", PATIENCE_S)
    server = start_server()
    lab.hold = True
    wire = Wire(server.url)
    wire.greet()
    wire.say(frame_message(0), frame_message(1))
    lab.next_entered()
    wire.say(Quality(request=1, preset="no such preset"))  # answered by the reader, after it has read the frames
    assert isinstance(wire.hear(), Acknowledged)
    stopped = stopping(server)
    lab.release(2)
    code, reason, messages = wire.ending()
    assert [message.frame for message in messages if isinstance(message, Composite)] == [0, 1]
    assert messages[-1] == Bye(reason=GOODBYE)
    assert (code, reason) == (1012, GOODBYE)
    stopped.join(PATIENCE_S)


def test_frames_sent_while_it_stops_are_left_to_the_next_server(start_server, lab, monkeypatch) -> None:
    monkeypatch.setattr("server.service.serve.DRAIN_PATIENCE_S", 10 * PATIENCE_S)
    monkeypatch.setattr("server.service.graceful_shutdown.ANSWER_PATIENCE_S", PATIENCE_S)
    server = start_server()
    lab.hold = True
    wire = Wire(server.url)
    wire.greet()
    wire.say(frame_message(0))
    lab.next_entered()
    stopped = stopping(server)
    while not server.service.shutdown.is_draining:
        time.sleep(0.01)
    wire.say(frame_message(1), Quality(request=1, preset="no such preset"))
    assert isinstance(wire.hear(), Acknowledged)  # the frame before it has been read
    lab.release(2)
    _, _, messages = wire.ending()
    answers = [message for message in messages if isinstance(message, Composite | Dropped)]
    assert [(type(answer), answer.frame) for answer in answers] == [(Composite, 0)]
    stopped.join(PATIENCE_S)


def test_what_must_not_be_lost_is_saved_after_the_sessions(start_server, lab) -> None:
    server = start_server()
    saved: list[str] = []

    async def save_one() -> None:
        await asyncio.sleep(0.01)
        saved.append("closed" if lab.closed.is_set() else "open")

    async def fail() -> None:
        raise OSError("disk full")

    server.service.shutdown.save_hooks += [fail, save_one]
    wire = Wire(server.url)
    wire.greet()
    wire.say(frame_message(0))
    wire.hear_until(Composite)
    server.stop()
    assert saved == ["closed"]
    wire.hang_up()


def test_saving_that_takes_too_long_is_given_up_and_told(caplog) -> None:
    shutdown = GracefulShutdown()
    cancelled: list[bool] = []

    async def hang() -> None:
        try:
            await asyncio.sleep(PATIENCE_S)
        finally:
            cancelled.append(True)

    async def fail() -> None:
        raise OSError("disk full")

    shutdown.save_hooks += [hang, fail]

    async def drain() -> None:
        await shutdown.drain(0.05)
        await shutdown.drain(0.05)  # once is enough
        await asyncio.sleep(0)

    asyncio.run(asyncio.wait_for(drain(), PATIENCE_S))
    assert cancelled == [True]
    assert "saving took too long" in caplog.text
    assert "disk full" in caplog.text


def test_sigterm_ends_the_program_with_0() -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", SERVE_FAKE], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        process.stdout.readline()
        url = process.stdout.readline().split()[2]
        assert httpx.get(f"{url}/healthz", trust_env=False).status_code == 200
        wire = Wire(url)
        wire.greet()
        process.send_signal(signal.SIGTERM)
        code, reason, _ = wire.ending()
        assert (code, reason) == (1012, GOODBYE)
        said, errors = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0
    assert (said, errors) == ("stopped\n", "")

"""A server that is draining, for as long as a test looks at it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from server.service.serve import BackgroundServer
from tests.service.fakes import PATIENCE_S, Lab, frame_message
from tests.service.wire import Wire


@contextmanager
def draining(server: BackgroundServer, lab: Lab, monkeypatch: pytest.MonkeyPatch) -> Iterator[Wire]:
    """With the client for whose frame it waits."""
    monkeypatch.setattr("server.service.serve.DRAIN_PATIENCE_S", 10 * PATIENCE_S)
    monkeypatch.setattr("server.service.graceful_shutdown.ANSWER_PATIENCE_S", 0.0)
    lab.hold = True
    wire = Wire(server.url)
    wire.greet()
    wire.say(frame_message(0))
    lab.next_entered()
    stopping = threading.Thread(target=server.stop)
    stopping.start()
    try:
        yield wire
    finally:
        lab.release()
        stopping.join(PATIENCE_S)
        wire.hang_up()

"""What one client may have of the service: over its limit it is told the limit, and others are served."""

from contextlib import suppress

import pytest
from websockets.exceptions import ConnectionClosed

from protocol.codec import encode
from protocol.messages import Acknowledged, Composite, Error, Hello, Quality, Welcome
from server.service.edge.connection_limits import network_of
from server.service.edge.rate_limiter import RateLimiter, TokenBucket
from server.service.limits import Limits
from tests.service.fakes import CAMERA, frame_message
from tests.service.wire import Wire


class Clock:
    """A time that the test turns."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_an_allowance_fills_up_with_time_and_no_further() -> None:
    clock = Clock()
    bucket = TokenBucket(rate_per_s=10, burst=20, clock=clock)
    assert bucket.spend(20) == 0
    assert bucket.spend(5) == pytest.approx(0.5)
    clock.now_s = 1.0
    assert bucket.spend(5) == 0
    clock.now_s = 1000.0
    assert bucket.spend(20) == 0
    assert bucket.spend(1) == pytest.approx(0.1)


def test_a_camera_at_90_hertz_is_never_over_its_pace() -> None:
    clock = Clock()
    limiter = RateLimiter(Limits(), clock)
    for _ in range(90 * 600):
        clock.now_s += 1 / 90
        assert not limiter.exceeds_message_rate()
        assert limiter.pause_s(1_400_000) == 0


def test_a_flood_of_messages_ends_its_connection_only(start_server) -> None:
    server = start_server(limits=Limits(messages_per_s=1, messages_burst=50))
    good, bad = Wire(server.url), Wire(server.url)
    good.greet()
    bad.greet()
    with suppress(ConnectionClosed):  # the server may have ended it before all are sent
        for request in range(60):
            bad.socket.send(encode(Quality(request=request, preset="rm")))
    code, reason, messages = bad.ending()
    assert code == 1008
    assert reason == "more than 1 messages a second were sent (saved up: 50): send fewer"
    assert messages[-1] == Error(reason=reason, fatal=True)
    assert max((m.request for m in messages if isinstance(m, Acknowledged)), default=0) < 50
    good.say(frame_message(0))
    assert good.hear_until(Composite)
    good.hang_up()


def test_too_many_bytes_are_read_more_slowly_and_none_is_lost(start_server) -> None:
    frame = frame_message(0)
    size = len(encode(frame))
    server = start_server(limits=Limits(bytes_per_s=20.0 * size, bytes_burst=2.0 * size))
    wire = Wire(server.url)
    wire.greet(lossless=True)
    for _ in range(6):
        wire.say(frame)
    heard = [wire.hear() for _ in range(6 * 2 + 1)]
    told = [m for m in heard if isinstance(m, Error)]
    assert len(told) == 1
    assert not told[0].fatal
    assert "read more slowly" in told[0].reason
    assert sum(isinstance(m, Composite) for m in heard) == 6
    wire.hang_up()


def test_one_address_cannot_take_all_sessions(start_server) -> None:
    server = start_server(limits=Limits(sessions_per_address=2))
    wires = [Wire(server.url) for _ in range(3)]
    for wire in wires[:2]:
        wire.greet()
    wires[2].say(Hello(client="test", camera=CAMERA))
    code, reason, _ = wires[2].ending()
    assert code == 1013
    assert reason == "your address 127.0.0.1 has 2 sessions already, which is the most: end one of them"
    watcher = Wire(server.url)
    assert isinstance(watcher.watch(), Welcome)
    for wire in (*wires, watcher):
        wire.hang_up()


def test_one_address_cannot_take_all_connections(start_server) -> None:
    server = start_server(limits=Limits(connections_per_address=3))
    wires = [Wire(server.url) for _ in range(3)]
    code, reason, _ = Wire(server.url).ending()
    assert code == 1013
    assert "3 connections already" in reason
    wires[0].greet()
    for wire in wires:
        wire.hang_up()
    assert _greets_again(server.url)


def _greets_again(url: str) -> bool:
    """A place is free a moment after a connection has ended."""
    while True:
        wire = Wire(url)
        wire.say(Hello(client="test", camera=CAMERA))
        heard = wire.hear()
        wire.hang_up()
        if isinstance(heard, Welcome):
            return True


def test_who_says_nothing_must_go(start_server) -> None:
    server = start_server(limits=Limits(first_message_s=0.05))
    code, reason, _ = Wire(server.url).ending()
    assert (code, reason) == (1008, "neither hello nor watch came within 0.05 s")


@pytest.mark.parametrize(
    ("address", "network"),
    [
        ("192.0.2.1", "192.0.2.1"),
        ("::ffff:192.0.2.1", "192.0.2.1"),
        ("2001:db8:1:2:3::4", "2001:db8:1:2::/64"),
        ("fe80::1%eth0", "fe80::/64"),
        ("testclient", "testclient"),
    ],
)
def test_an_address_stands_for_whoever_has_it(address, network) -> None:
    assert network_of(address) == network

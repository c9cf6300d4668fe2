"""Opening a connection: versions, first messages, limits on how many."""

import pytest

from protocol.limits import SUBPROTOCOL
from protocol.messages import Bye, Error, Hello, MoveObject, Quality, Wishes
from tests.service.fakes import CAMERA, frame_message
from tests.service.wire import Wire


def test_offered_version_is_selected(server) -> None:
    wire = Wire(server.url, ("probeless-v999", SUBPROTOCOL))
    assert wire.socket.subprotocol == SUBPROTOCOL
    assert wire.greet().device == "a fake device"
    wire.hang_up()


@pytest.mark.parametrize(
    ("offered", "named"),
    [(("probeless-v999",), "probeless-v999"), ((), "no protocol version"), (("chat",), "no protocol version")],
)
def test_other_versions_are_told_which_one_is_spoken(server, offered, named) -> None:
    wire = Wire(server.url, offered)
    assert wire.socket.subprotocol == (offered[0] if offered else None)
    code, reason, messages = wire.ending()
    assert (code, messages) == (1002, [])
    assert SUBPROTOCOL in reason
    assert reason.endswith("use the same version on both sides")
    assert named in reason


def test_close_reason_of_a_long_version_fits_a_close_frame(server) -> None:
    code, reason, _ = Wire(server.url, ("probeless-v" + "9" * 2000,)).ending()
    assert code == 1002
    assert SUBPROTOCOL in reason


@pytest.mark.parametrize(
    "first",
    [frame_message(0), Quality(request=0, preset="rm"), MoveObject(request=0, object="a", position_m=(0, 0, 0))],
)
def test_first_message_must_be_hello_or_watch(dial, first) -> None:
    wire = dial()
    wire.say(first)
    code, reason, messages = wire.ending()
    assert code == 1008
    assert reason == f"the first message must be hello or watch, not {type(first).__name__.lower()}"
    assert messages == [Error(reason=reason, fatal=True)]


def test_bye_first_closes_normally(dial) -> None:
    wire = dial()
    wire.say(Bye())
    assert wire.ending() == (1000, "", [])


def test_second_hello_is_refused(dial) -> None:
    wire = dial()
    wire.greet()
    wire.say(Hello(client="test", camera=CAMERA))
    code, reason, _ = wire.ending()
    assert code == 1008
    assert "hello" in reason


def test_wishes_the_pipeline_cannot_meet_are_told(dial) -> None:
    wire = dial()
    wire.say(Hello(client="test", camera=CAMERA, wishes=Wishes(preset="auto")))
    code, reason, messages = wire.ending()
    assert (code, reason) == (1008, "preset auto is not for this fake: choose reg4")
    assert messages == [Error(reason=reason, fatal=True)]
    dial().greet()


def test_one_session_too_many_is_told_and_its_place_is_free_again_later(start_server, lab) -> None:
    server = start_server(max_sessions=2)
    first, second, third = (Wire(server.url) for _ in range(3))
    assert first.greet().session != second.greet().session
    third.say(Hello(client="test", camera=CAMERA))
    code, reason, _ = third.ending()
    assert code == 1013
    assert reason == "all 2 sessions of this server are taken: try again later"
    first.say(Bye())
    assert first.ending()[0] == 1000
    assert lab.closed.wait(20)
    fourth = _greet_when_free(server.url)
    for wire in (second, fourth):
        wire.hang_up()


def _greet_when_free(url: str) -> Wire:
    """The place is free a moment after the pipeline is closed."""
    while True:
        wire = Wire(url)
        wire.say(Hello(client="test", camera=CAMERA))
        if not isinstance(wire.hear(), Error):
            return wire


def test_socket_elsewhere_is_told_where_the_stream_is(server) -> None:
    code, reason, _ = Wire(server.url, path="/else").ending()
    assert code == 1008
    assert "/v1/stream" in reason


def test_pipelines_are_built_off_the_event_loop(dial, lab) -> None:
    dial().greet()
    assert all(name.startswith("probeless-session") for name in lab.threads)

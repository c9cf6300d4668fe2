"""Which room a first message belongs to, and names that find back to it."""

import pytest

from protocol.codec import decode_client, decode_server, encode
from protocol.limits import MAX_NAME_CHARS
from protocol.messages import Bye, Dropped, Hello, Watch, Welcome
from server.cluster.routing import outgoing, room_id_of, route_of
from server.service.edge.connection import GONE, POLICY, Refusal
from tests.service.fakes import CAMERA

ID = room_id_of("kitchen")


def hello(**said: object) -> Hello:
    return Hello(client="test", camera=CAMERA, **said)


def test_everybody_who_names_a_room_is_led_to_it_and_nobody_else() -> None:
    assert route_of(hello(room="kitchen")).room_id == route_of(Watch(room="kitchen")).room_id == ID
    assert room_id_of("kitchen ") != ID


def test_session_without_a_room_has_one_of_its_own() -> None:
    a, b = route_of(hello()), route_of(hello())
    assert a.room_id != b.room_id
    assert decode_client(a.first) == hello()
    assert a.may_open


def test_names_of_a_welcome_lead_back_and_are_the_hosts_own_there() -> None:
    welcome = Welcome(session="session-1", server="s", device="d", max_inflight=2, key="k" * 32)
    seen = decode_server(outgoing(encode(welcome), ID))
    assert isinstance(seen, Welcome)
    assert len(seen.key or "") <= MAX_NAME_CHARS
    back = route_of(hello(resume=seen.key))
    watched = route_of(Watch(session=seen.session))
    assert (back.room_id, watched.room_id) == (ID, ID)
    assert not back.may_open
    assert not watched.may_open
    assert decode_client(back.first) == hello(resume=welcome.key)
    assert decode_client(watched.first) == Watch(session="session-1")


def test_other_messages_pass_as_they_are() -> None:
    for message in (Dropped(frame=3, reason="late"), Dropped(frame=3, reason="welcome" * 900)):
        assert outgoing(encode(message), ID) == encode(message)


@pytest.mark.parametrize(
    ("first", "code"),
    [
        (hello(resume="x" * 32), GONE),
        (hello(resume=f"{ID}."), GONE),
        (Watch(session="session-1"), GONE),
        (Watch(), POLICY),
        (Bye(), POLICY),
        (None, POLICY),
    ],
)
def test_first_message_that_leads_nowhere_is_refused(first, code) -> None:
    with pytest.raises(Refusal) as refused:
        route_of(first)
    assert refused.value.code == code

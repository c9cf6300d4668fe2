"""Panoramas over the socket and over HTTP: of the right session and place, in order, or refused in one line."""

from __future__ import annotations

import threading
from concurrent.futures import CancelledError
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest

from client.options.light_places import PanoramaOut
from client.streaming.client import ClientError, StreamClient
from protocol.messages import Acknowledged, Composite, Hello, Panorama, RequestPanorama, Wishes
from server.service.edge.authenticator import Authenticator
from server.service.mailbox import Mailbox, PanoramaOrder
from tests.service.conversation import with_client
from tests.service.fakes import CAMERA, EXPLODE_MM, PATIENCE_S, frame_message
from tests.service.http import get
from tests.service.streaming import FakeSource, quietly
from tests.service.wire import Wire

FILE = b"#?RADIANCE and so on"


def test_the_client_receives_the_file_and_its_place(server, lab) -> None:
    lab.panorama = FILE

    async def talk(client: StreamClient) -> list[Panorama]:
        await client.hello(CAMERA)
        return [await client.request_panorama("hdr"), await client.request_panorama("exr", (0.5, -1.0, 2.0))]

    first, second = with_client(server.url, talk)
    assert (first.format, first.position_m, first.data) == ("hdr", (1.0, 2.0, 3.0), FILE)
    assert (second.format, second.position_m) == ("exr", (0.5, -1.0, 2.0))


def test_it_comes_in_its_place_among_frames(dial, lab) -> None:
    lab.panorama = FILE
    wire = dial()
    wire.greet(lossless=True)
    wire.say(frame_message(0), RequestPanorama(request=3, format="hdr"), frame_message(1))
    heard = [type(message).__name__ for message in wire.hear_until(Acknowledged)]
    assert heard == ["Light", "Composite", "Panorama", "Acknowledged"]
    wire.hear_until(Composite)
    assert lab.log == [("frame", 0), ("panorama", "hdr", None), ("frame", 1)]


def test_a_session_without_light_says_so_and_goes_on(server) -> None:
    async def talk(client: StreamClient) -> None:
        await client.hello(CAMERA)
        with pytest.raises(ClientError, match="there is no light yet"):
            await client.request_panorama("hdr")
        assert (await client.set_quality("rm")).error is None

    with_client(server.url, talk)


def test_stream_writes_it_after_the_last_answer(server, lab, tmp_path: Path) -> None:
    lab.panorama = FILE
    asked = PanoramaOut(tmp_path / "sky.exr", "exr", (0.25, 0.5, 1.0))
    quietly(FakeSource(3), server.url, lossless=True, panorama=asked)
    assert asked.path.read_bytes() == FILE
    assert lab.log[-1] == ("panorama", "exr", (0.25, 0.5, 1.0))


def test_over_http_it_is_of_the_newest_session_or_the_named_one(server, lab, dial) -> None:
    lab.panorama = FILE
    assert get(server, "/v1/panorama.hdr").status_code == 404
    first, second = dial(), dial()
    name = first.greet().session
    second.greet()
    answer = get(server, "/v1/panorama.hdr?at=0.5,-1,2e0")
    assert (answer.status_code, answer.content) == (200, FILE)
    assert answer.headers["content-type"] == "image/vnd.radiance"
    assert lab.log[-1] == ("panorama", "hdr", (0.5, -1.0, 2.0))
    answer = get(server, f"/v1/panorama.exr?session={name}")
    assert (answer.content, answer.headers["content-type"]) == (FILE, "image/x-exr")
    assert lab.log[-1] == ("panorama", "exr", None)
    answer = get(server, "/v1/panorama.exr?session=session-77")
    assert (answer.status_code, "no session 'session-77'" in answer.text) == (404, True)


@pytest.mark.parametrize("at", ["1,2", "1,2,3,4", "a,b,c", "1,nan,2", "inf,0,0", ""])
def test_over_http_a_place_is_three_numbers(server, dial, at: str) -> None:
    dial().greet()
    answer = get(server, f"/v1/panorama.hdr?at={at}")
    assert answer.status_code == 400
    assert answer.text.endswith("expected x,y,z, three finite numbers in metres\n")


def test_over_http_a_session_without_light_says_so(server, dial) -> None:
    dial().greet()
    answer = get(server, "/v1/panorama.hdr")
    assert (answer.status_code, answer.text.startswith("there is no light yet")) == (409, True)


def test_over_http_the_token_and_the_rooms_key_are_needed(start_server, lab) -> None:
    lab.panorama = FILE
    server = start_server(
        authenticator=Authenticator("a-token", frozenset()),
        room_factory=lambda _wishes, name: SimpleNamespace(name=name, key_digest=None, close=lambda: None),
    )
    assert get(server, "/v1/panorama.hdr").status_code == 401

    def ask(query: str = "") -> httpx.Response:
        headers = {"Authorization": "Bearer a-token"}
        return httpx.get(f"{server.url}/v1/panorama.hdr{query}", headers=headers, trust_env=False, timeout=PATIENCE_S)

    wire = Wire(server.url, path="/v1/stream?token=a-token")
    wire.say(Hello(client="test", camera=CAMERA, wishes=Wishes(), room="study", room_key="secret"))
    wire.hear()
    assert ask().status_code == 404
    assert ask("?room=study&room_key=wrong").status_code == 404
    assert ask("?room=study&room_key=secret").content == FILE
    wire.hang_up()


def test_over_http_it_waits_for_frames_before_it(server, lab, dial) -> None:
    lab.panorama, lab.hold = FILE, True
    wire = dial()
    wire.greet()
    wire.say(frame_message(0))
    lab.next_entered()
    answers: list[bytes] = []
    asking = threading.Thread(target=lambda: answers.append(get(server, "/v1/panorama.hdr").content))
    asking.start()
    asking.join(0.2)
    assert not answers
    lab.release()
    asking.join(PATIENCE_S)
    assert answers == [FILE]
    assert lab.log == [("frame", 0), ("panorama", "hdr", None)]


def test_over_http_a_session_that_fails_first_ends_the_request(server, lab, dial) -> None:
    lab.panorama, lab.hold = FILE, True
    wire = dial()
    wire.greet()
    wire.say(frame_message(0, EXPLODE_MM))
    lab.next_entered()
    answers: list[httpx.Response] = []
    asking = threading.Thread(target=lambda: answers.append(get(server, "/v1/panorama.hdr")))
    asking.start()
    asking.join(0.2)
    lab.release()
    asking.join(PATIENCE_S)
    assert [answer.status_code for answer in answers] == [404]


def test_a_closed_mailbox_cancels_orders() -> None:
    mailbox = Mailbox(2)
    before, after = PanoramaOrder("hdr", None), PanoramaOrder("hdr", None)
    mailbox.post(before)
    mailbox.close()
    mailbox.post(after)
    for order in (before, after):
        with pytest.raises(CancelledError):
            order.answer.result(timeout=0)

"""The client library against a real server, and against servers that are absent, strange or of another version."""

import asyncio
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer

import numpy as np
import pytest
from websockets.sync.server import Server, serve

from client.streaming.client import ClientError, StreamClient, stream_url
from protocol.images import decode_color
from protocol.messages import Bye, Composite, Frame, Hello, Light, Welcome, Wishes
from tests.service.conversation import next_answer, with_client
from tests.service.fakes import CAMERA, EXPLODE_MM, REFUSE_MM, fake_light, frame_message, rgbd_frame


@pytest.mark.parametrize(
    ("given", "url"),
    [
        ("http://host:8080", "ws://host:8080/v1/stream"),
        ("http://host:8080/", "ws://host:8080/v1/stream"),
        ("https://host", "wss://host/v1/stream"),
        ("host:8080", "ws://host:8080/v1/stream"),
        ("[::1]:8080", "ws://[::1]:8080/v1/stream"),
        ("ws://host:1/v1/stream", "ws://host:1/v1/stream"),
        ("wss://host/behind/a/proxy", "wss://host/behind/a/proxy"),
    ],
)
def test_stream_url(given, url) -> None:
    assert stream_url(given) == url


def test_frames_come_back_with_light_and_picture(server) -> None:
    async def talk(client: StreamClient) -> None:
        welcome = await client.hello(CAMERA, Wishes(lossless=True))
        assert welcome.device == "a fake device"
        for i in range(3):
            await client.send_frame(rgbd_frame(i))
            answer = await next_answer(client)
            assert answer.light == fake_light(rgbd_frame(i))
            picture = decode_color(answer.composite.color, CAMERA)
            np.testing.assert_array_equal(picture, 255 - rgbd_frame(i).color)

    with_client(server.url, talk)


@pytest.mark.parametrize("window", [2, 5])
def test_window_holds_back_the_frame_after_it(server, lab, window: int) -> None:
    lab.hold = True

    async def talk(client: StreamClient) -> None:
        welcome = await (client.hello(CAMERA) if window == 2 else client.hello(CAMERA, max_inflight=window))
        assert welcome.max_inflight == window
        for number in range(window):
            assert client.has_room
            await client.send_frame(rgbd_frame(number))
        assert not client.has_room
        next_one = asyncio.create_task(client.send_frame(rgbd_frame(window)))
        assert await asyncio.to_thread(lab.next_entered) == 0
        assert not next_one.done()
        lab.release()
        await next_one
        lab.release(window)
        await client.wait_until_answered()
        assert [(await next_answer(client)).composite.frame for _ in range(window + 1)] == list(range(window + 1))

    with_client(server.url, talk)


def test_dropped_frame_makes_room(server) -> None:
    async def talk(client: StreamClient) -> None:
        await client.hello(CAMERA)
        for i in range(4):
            await client.send_frame(rgbd_frame(i, REFUSE_MM))
            assert (await next_answer(client)).frame == i
        assert client.has_room

    with_client(server.url, talk)


def test_objects_are_placed_moved_and_removed(server, lab) -> None:
    async def talk(client: StreamClient) -> None:
        await client.hello(CAMERA)
        placed = await client.place_object("chair", "glb", b"mesh", (1.0, 2.0, 3.0), 2.0, 45.0)
        assert (placed.error, placed.notes) == (None, ("chair has no texture",))
        assert (await client.move_object("chair", (0.0, 0.0, 0.0))).error is None
        assert (await client.set_quality("rm")).error is None
        assert (await client.remove_object("chair")).error is None
        assert "no object" in (await client.remove_object("chair")).error
        assert "no GLB" in (await client.place_object("junk", "glb", b"no mesh")).error

    with_client(server.url, talk)
    assert [entry[0] for entry in lab.log] == ["place", "move", "preset", "remove", "remove"]
    placement = lab.log[0][3]
    assert (placement.position_m, placement.scale, placement.yaw_deg) == ((1.0, 2.0, 3.0), 2.0, 45.0)


def test_watching(server, dial) -> None:
    camera = dial()
    session = camera.greet().session

    async def talk(client: StreamClient) -> None:
        assert (await client.watch()).session == session
        await asyncio.to_thread(camera.say, frame_message(7))
        assert (await next_answer(client)).composite.frame == 7

    with_client(server.url, talk)


def test_tap_sees_everything_in_both_directions(server) -> None:
    seen: list = []

    async def talk(client: StreamClient) -> None:
        await client.hello(CAMERA)
        await client.send_frame(rgbd_frame(0))
        await client.wait_until_answered()

    with_client(server.url, talk, tap=seen.append)
    assert [type(message) for message in seen] == [Hello, Welcome, Frame, Light, Composite, Bye]


def refused(url: str, *frames: int, **wishes: object) -> str:
    """The line a client gets that says hello and sends frames with these first depths."""

    async def talk(client: StreamClient) -> None:
        await client.hello(CAMERA, Wishes(**wishes))
        for i, depth_mm in enumerate(frames):
            await client.send_frame(rgbd_frame(i, depth_mm))
        await client.wait_until_answered()

    with pytest.raises(ClientError) as error:
        with_client(url, talk)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_refused_hello_says_why(server) -> None:
    assert refused(server.url, preset="auto").endswith("preset auto is not for this fake: choose reg4")


def test_full_server_says_so(start_server) -> None:
    url = start_server(max_sessions=1).url

    async def talk(client: StreamClient) -> None:
        await client.hello(CAMERA)
        assert "try again later" in await asyncio.to_thread(refused, url)

    with_client(url, talk)


def test_failing_session_ends_whoever_waits(server) -> None:
    assert "the server failed in this session" in refused(server.url, EXPLODE_MM)


def test_answers_end_with_the_servers_reason(server) -> None:
    async def talk(client: StreamClient) -> None:
        await client.hello(CAMERA)
        await client.send_frame(rgbd_frame(0))
        await client.send_frame(rgbd_frame(1, EXPLODE_MM))
        assert (await next_answer(client)).composite.frame == 0
        with pytest.raises(ClientError, match="failed in this session"):
            await next_answer(client)

    with_client(server.url, talk)


def test_stopping_server_is_told(start_server) -> None:
    server = start_server()

    async def talk(client: StreamClient) -> None:
        await client.hello(CAMERA)
        await asyncio.to_thread(server.stop)
        with pytest.raises(ClientError, match="closed the connection"):
            await next_answer(client)

    with_client(server.url, talk)


def test_absent_server_is_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as placeholder:
        port = placeholder.getsockname()[1]
    line = refused(f"http://127.0.0.1:{port}")
    assert line.startswith(f"no server at http://127.0.0.1:{port} (")
    assert line.endswith("start one with: probeless serve")


@pytest.mark.parametrize("url", ["", "http://", "http://host:port", "ftp://host:1"])
def test_address_that_is_none_is_one_line(url) -> None:
    assert "http://HOST:PORT" in refused(url)


def test_web_server_that_is_something_else_is_one_line() -> None:
    with background(HTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler)) as web:
        assert "no probeless server" in refused(f"http://127.0.0.1:{web.server_port}")


def test_server_of_another_version_is_one_line() -> None:
    with other_server(lambda socket: socket.close(1002, "this server speaks probeless-v9")) as url:
        assert "this server speaks probeless-v9" in refused(url)


def test_server_that_does_not_select_our_protocol_is_one_line() -> None:
    with other_server(lambda socket: socket.recv(), select_subprotocol=lambda *_: None) as url:
        assert "does not speak probeless-v1" in refused(url)


def test_server_that_talks_nonsense_is_one_line() -> None:
    with other_server(lambda socket: socket.send(b"\xc1")) as url:
        assert "no message" in refused(url)


def test_server_that_vanishes_is_one_line() -> None:
    with other_server(lambda socket: socket.socket.shutdown(2)) as url:
        assert "the connection was lost" in refused(url)


@contextmanager
def other_server(handler: Callable, **options: object) -> Iterator[str]:
    """The URL of a WebSocket server that is not ours."""
    options = {"select_subprotocol": lambda *_: "probeless-v1"} | options
    with background(serve(handler, "127.0.0.1", 0, compression=None, **options)) as server:
        yield f"http://127.0.0.1:{server.socket.getsockname()[1]}"


@contextmanager
def background(server: Server | HTTPServer) -> Iterator:
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        if isinstance(server, HTTPServer):
            server.server_close()

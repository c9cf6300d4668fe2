"""The scene's mesh over the socket: whole, in order, in parts that fit a message, or refused in one line."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest
from websockets.sync.server import Server, serve

from client.streaming.client import ClientError, StreamClient
from protocol.codec import decode_client, encode
from protocol.limits import MAX_MESH_PART_BYTES, SUBPROTOCOL
from protocol.messages import Acknowledged, Composite, Hello, Light, MeshPart, RequestMesh, Welcome, Wishes
from server.meshing.files import mesh_files
from server.service import mesh_message
from tests.service.conversation import with_client
from tests.service.fakes import CAMERA, PATIENCE_S, frame_message, terrain
from tests.service.streaming import FakeSource, files, quietly


async def fetched(client: StreamClient) -> dict[str, bytes]:
    await client.hello(CAMERA, Wishes(lossless=True))
    return dict(await client.request_mesh())


def test_both_files_arrive_whole_in_several_parts(server, lab) -> None:
    lab.mesh = terrain(450)
    expected = mesh_files(lab.mesh)
    assert len(expected["ply"]) > MAX_MESH_PART_BYTES
    told: list[tuple[int, int]] = []

    async def talk(client: StreamClient) -> dict[str, bytes]:
        await client.hello(CAMERA)
        return dict(await client.request_mesh(lambda done, total: told.append((done, total))))

    assert with_client(server.url, talk) == expected
    assert told[0] == (MAX_MESH_PART_BYTES, len(expected["ply"]))
    assert told[-1] == (len(expected["glb"]), len(expected["glb"]))


def test_the_mesh_comes_in_its_place_among_frames(dial, lab) -> None:
    lab.mesh = terrain(5)
    wire = dial()
    wire.greet(lossless=True)
    wire.say(frame_message(0), RequestMesh(request=3), frame_message(1))
    assert [type(m) for m in wire.hear_until(Acknowledged)] == [Light, Composite, MeshPart, MeshPart, Acknowledged]
    wire.hear_until(Composite)
    assert lab.log == [("frame", 0), ("mesh",), ("frame", 1)]


def test_a_session_that_has_fused_nothing_says_so_and_goes_on(server) -> None:
    async def talk(client: StreamClient) -> None:
        with pytest.raises(ClientError, match="no frame has been fused yet"):
            await fetched(client)
        assert (await client.set_quality("rm")).error is None

    with_client(server.url, talk)


def test_a_mesh_beyond_the_limit_is_refused_before_anything_of_it_is_sent(dial, lab, monkeypatch) -> None:
    monkeypatch.setattr(mesh_message, "MAX_SCENE_MESH_BYTES", 1 << 20)
    lab.mesh = terrain(300)
    wire = dial()
    wire.greet()
    wire.say(RequestMesh(request=9))
    answer = wire.hear()
    assert isinstance(answer, Acknowledged)
    assert answer.request == 9
    assert answer.error == (
        "the scene's mesh has 3 MiB as ply, at most 1 MiB are sent: give a larger --voxel, or use probeless run"
    )


def test_wrong_request_is_answered_in_kind(dial) -> None:
    wire = dial()
    wire.greet()
    fields = msgspec.to_builtins(RequestMesh(request=4)) | {"voxel_m": 0.5}
    wire.socket.send(msgspec.msgpack.encode(fields))
    answer = wire.hear()
    assert (answer.request, "voxel_m" in answer.error) == (4, True)


@contextmanager
def scripted(answers: Callable[[int], list[MeshPart]]) -> Iterator[str]:
    """A server that answers a request for the mesh with these parts and an acknowledgement."""

    def handle(socket) -> None:
        for data in socket:
            match decode_client(data):
                case Hello():
                    welcome = Welcome(session="s", server="scripted", device="none", max_inflight=2)
                    socket.send(encode(welcome))
                case RequestMesh(request=request):
                    for part in answers(request):
                        socket.send(encode(part))
                    socket.send(encode(Acknowledged(request=request)))

    with serve(handle, "127.0.0.1", 0, subprotocols=[SUBPROTOCOL]) as server:
        yield from _serving(server)


def _serving(server: Server) -> Iterator[str]:
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.socket.getsockname()[1]}"
    finally:
        server.shutdown()
        thread.join(PATIENCE_S)


def part(request: int, offset: int, data: bytes, size_bytes: int = 6) -> MeshPart:
    return MeshPart(request=request, format="ply", size_bytes=size_bytes, offset=offset, data=data)


@pytest.mark.parametrize(
    ("answers", "told"),
    [
        (lambda r: [part(r, 0, b"abc"), part(r, 4, b"ef")], "does not follow on"),
        (lambda r: [part(r, 0, b"abcdefg")], "does not follow on"),
        (lambda r: [part(r, 0, b"abc"), part(r, 3, b"def", 7)], "does not follow on"),
        (lambda r: [part(r + 1, 0, b"abcdef")], "does not follow on"),
        (lambda r: [part(r, 0, b"abc")], "incomplete mesh"),
        (lambda _: [], "incomplete mesh"),
    ],
)
def test_a_server_that_breaks_the_order_is_caught(answers: Callable[[int], list[MeshPart]], told: str) -> None:
    with scripted(answers) as url, pytest.raises(ClientError, match=told):
        with_client(url, fetched)


def test_stream_writes_the_mesh_after_the_last_answer(server, lab, tmp_path: Path) -> None:
    lab.mesh = terrain(20)
    quietly(FakeSource(3), server.url, out=tmp_path, lossless=True, mesh=True)
    written = files(tmp_path)
    assert {format_: written[f"mesh.{format_}"] for format_ in ("ply", "glb")} == mesh_files(lab.mesh)
    assert lab.log[-1] == ("mesh",)
    quietly(FakeSource(3), server.url, out=tmp_path, lossless=True, overwrite=True)
    assert not [name for name in files(tmp_path) if name.startswith("mesh")], (
        "an earlier run's mesh would pass for ours"
    )


def test_stream_that_gets_no_mesh_says_why_and_keeps_its_frames(server, tmp_path: Path) -> None:
    with pytest.raises(ClientError, match="no surface to mesh"):
        quietly(FakeSource(2), server.url, out=tmp_path, lossless=True, mesh=True)
    assert "frames/000001.png" in files(tmp_path)


def test_a_flood_of_frames_does_not_replace_the_request(server, lab) -> None:
    lab.hold, lab.mesh = True, terrain(4)

    async def talk(client: StreamClient) -> dict[str, bytes]:
        await client.hello(CAMERA)
        asking = asyncio.create_task(client.request_mesh())
        for i in range(4):
            await client._send(frame_message(i))
        lab.release(4)
        return dict(await asking)

    assert with_client(server.url, talk) == mesh_files(lab.mesh)

"""Layers and lights alone over a real socket: with fake pipelines, and with the real one."""

from __future__ import annotations

import io
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from msgspec import structs
from rich.console import Console

from client.cli import run_command
from client.commands.stream import StreamSummary, stream
from client.display.layers import NEUTRAL, decode_layer, put_over
from client.gallery.source import GallerySource
from client.objects.object_file import ObjectFile
from client.streaming.client import Answer, StreamClient
from protocol.images import encode_depth
from protocol.messages import Bye, Composite, Dropped, Layer, Light, Wishes
from server.opencl.device import Device
from server.service.result_encoding import STEPS_PER_M
from server.service.serve import BackgroundServer
from server.service.service import Service
from server.shading import layer as of_server
from server.shading.layer import LayerPart
from tests.service.conversation import next_answer, with_client
from tests.service.fakes import CAMERA, POSE, REFUSE_MM, fake_layer, fake_light, frame_message, rgbd_frame
from tests.service.streaming import FakeSource


def quietly(*args: object, **options: object) -> StreamSummary:
    return stream(*args, console=Console(file=io.StringIO()), **options)


def said(index: int) -> LayerPart:
    """What the fake says of a frame."""
    part = fake_layer(rgbd_frame(index)).virtual
    assert part is not None
    return part


# ---- on the wire -------------------------------------------------------------------------------------------------


def test_frame_is_answered_by_its_light_and_then_its_layer(dial) -> None:
    wire = dial()
    wire.greet(answer="layer")
    wire.say(frame_message(3))
    light, layer = wire.hear(), wire.hear()
    assert light == fake_light(rgbd_frame(3))
    assert isinstance(layer, Layer)
    assert (layer.frame, layer.timestamp_s, layer.tracking, layer.notes) == (3, 0.1, "given", ("one note",))
    assert layer.ratio is None
    assert (layer.virtual.x, layer.virtual.y, layer.virtual.color.codec) == (3, 2, "png")
    assert np.array_equal(np.reshape(layer.world_from_camera, (4, 4)), POSE)
    read, sent = decode_layer(layer, CAMERA).virtual, said(3)
    depth_m = sent.depth * layer.depth_scale_m
    half_a_unit = layer.depth_scale_m / 2 / depth_m**2
    assert (np.abs(1 / read.depth_m - 1 / depth_m) <= 0.5 / STEPS_PER_M + half_a_unit + 1e-6).all()
    assert len(np.unique(np.rint(STEPS_PER_M / read.depth_m))) == len(np.unique(read.depth_m))
    np.testing.assert_allclose(read.values[..., 3], sent.color[..., 3] / 255, rtol=1e-6)


def test_layers_depth_comes_as_the_client_sends_its_own(dial) -> None:
    """A browser has no Zstandard."""
    for codec, answered in (("raw", "zdelta"), ("zdelta", "zdelta"), ("zstd-delta", "zstd-delta")):
        wire = dial()
        wire.greet(answer="layer")
        wire.say(structs.replace(frame_message(1), depth=encode_depth(rgbd_frame(1).depth, codec)))
        layer = wire.hear_until(Layer)[-1]
        assert layer.virtual.depth.codec == answered


def test_a_light_is_the_whole_answer(dial) -> None:
    wire = dial()
    wire.greet(answer="light", lossless=True)
    wire.say(frame_message(1), frame_message(2, REFUSE_MM), frame_message(3))
    heard = [wire.hear() for _ in range(3)]
    assert [(type(message), message.frame) for message in heard] == [(Light, 1), (Dropped, 2), (Light, 3)]
    wire.say(Bye())
    assert all(isinstance(message, Bye) for message in wire.ending()[2])


@pytest.mark.parametrize("answer", ["layer", "light"])
def test_those_who_watch_get_composites(dial, answer: str) -> None:
    camera, watcher = dial(), dial()
    session = camera.greet(answer=answer).session
    camera.say(frame_message(1))
    camera.hear_until(Layer if answer == "layer" else Light)
    assert watcher.watch().session == session
    camera.say(frame_message(2))
    camera.hear_until(Layer if answer == "layer" else Light)
    light, composite = watcher.hear(), watcher.hear()
    assert isinstance(light, Light)
    assert isinstance(composite, Composite)
    assert (light.frame, composite.frame, composite.color.codec) == (2, 2, "jpeg")


@pytest.mark.parametrize("answer", ["layer", "light"])
def test_a_lossless_session_gets_the_same_bytes_again(dial, lab, answer: str) -> None:
    """A frame that is sent again is not worked on again."""
    wire = dial()
    wire.greet(answer=answer, lossless=True)
    last = Layer if answer == "layer" else Light
    heard = []
    for _ in range(2):
        wire.say(frame_message(5))
        heard.append(wire.hear_until(last))
    assert heard[0] == heard[1]
    assert lab.log.count(("frame", 5)) == 1


# ---- the client library ------------------------------------------------------------------------------------------


def test_the_client_gives_layers(server) -> None:
    async def talk(client: StreamClient) -> None:
        await client.hello(CAMERA, Wishes(answer="layer", lossless=True))
        for i in range(3):
            await client.send_frame(rgbd_frame(i))
            answer = await next_answer(client)
            assert isinstance(answer, Answer)
            assert answer.light == fake_light(rgbd_frame(i))
            assert answer.composite is None
            assert answer.drawn is answer.layer
            assert answer.layer.frame == i
            assert answer.layer.virtual.depth.codec == "zstd-delta"
        assert client.unanswered == 0

    with_client(server.url, talk)


def test_the_client_gives_lights_alone(server) -> None:
    async def talk(client: StreamClient) -> None:
        await client.hello(CAMERA, Wishes(answer="light"))
        for i in range(5):  # more than the window holds
            await client.send_frame(rgbd_frame(i))
            assert await next_answer(client) == Answer(fake_light(rgbd_frame(i)))
        assert client.unanswered == 0

    with_client(server.url, talk)


# ---- the command -------------------------------------------------------------------------------------------------


def test_stream_puts_layers_over_the_frames_own_pictures(server, tmp_path: Path) -> None:
    source = FakeSource(3)
    summary = quietly(source, server.url, wishes=Wishes(answer="layer"), out=tmp_path, realtime=False)
    assert summary.answered == 3
    for index in range(3):
        picture = cv2.imread(str(tmp_path / "frames" / f"{index:06d}.png"), cv2.IMREAD_COLOR_RGB)
        own, part = rgbd_frame(index).color, said(index)
        outside = np.ones(own.shape[:2], bool)
        outside[2:7, 3:10] = False
        np.testing.assert_array_equal(picture[outside], own[outside])  # as it was taken, not as JPEG sent it
        is_all = part.color[..., 3] == 255
        np.testing.assert_array_equal(picture[2:7, 3:10][is_all], part.color[..., :3][is_all])
        assert (picture != own).any()
    assert len((tmp_path / "timings.jsonl").read_text().splitlines()) == 3


def test_stream_of_lights_alone_writes_no_pictures(server, tmp_path: Path) -> None:
    summary = quietly(FakeSource(4), server.url, wishes=Wishes(answer="light"), out=tmp_path, realtime=False)
    assert summary.answered == 4
    rows = [json.loads(line) for line in (tmp_path / "light.jsonl").read_text().splitlines()]
    assert [row["frame"] for row in rows] == [0, 1, 2, 3]
    assert rows[2]["dominant_intensity"] == fake_light(rgbd_frame(2)).dominant_intensity
    assert not list((tmp_path / "frames").iterdir())
    assert (tmp_path / "timings.jsonl").read_text() == ""


def test_live_streams_are_answered_in_every_way(server) -> None:
    for answer in ("picture", "layer", "light"):
        source = FakeSource(20, fps=40.0)
        summary = quietly(source, server.url, wishes=Wishes(answer=answer))
        assert summary.answered + summary.skipped + summary.dropped == 20
        assert summary.answered > 0  # how many hangs on what else the machine does


def test_an_answer_that_there_is_not_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["stream", "synthetic:gallery/nothing", "--server", "http://127.0.0.1:1", "--answer", "sound"]
    assert run_command(command) == 2
    assert "expected one of picture, layer, light" in capsys.readouterr().err


# ---- the real pipeline -------------------------------------------------------------------------------------------


def test_real_layers_over_the_socket_make_the_pictures_of_a_lossless_stream(device: Device, tmp_path: Path) -> None:
    """Within two codes; lights byte for byte; and layers that are asked for twice make the same pictures twice."""
    source = GallerySource("shadow-falls-in", width=80)
    bounds = {"volume_m": (-1.6, -0.3, -1.6, 1.6, 1.2, 1.6), "voxel_m": 0.03, "up": source.up}
    file = tmp_path / "box.obj"
    file.write_text("v -1 0 -1\nv 1 0 -1\nv 0 0 1\nv 0 2 0\nf 1 2 4\nf 2 3 4\nf 3 1 4\nf 1 3 2\n")
    thing = ObjectFile(file, (0.1, 0.0, 0.0), 0.15, 0.0)
    for folder, answer in (("picture", "picture"), ("layer", "layer"), ("again", "layer"), ("light", "light")):
        with BackgroundServer(Service(device)) as server:
            wishes, out = Wishes(**bounds, light=source.light, answer=answer), tmp_path / folder
            quietly(source, server.url, [thing], wishes, out, lossless=True, frames=range(3))
    lights = {folder: (tmp_path / folder / "light.jsonl").read_bytes() for folder in ("picture", "layer", "light")}
    assert len(set(lights.values())) == 1
    largest = 0
    for index in range(3):
        made = [cv2.imread(str(tmp_path / f / "frames" / f"{index:06d}.png")) for f in ("picture", "layer", "again")]
        np.testing.assert_array_equal(made[1], made[2])
        largest = max(largest, int(np.abs(made[0].astype(int) - made[1]).max()))
        changed = (made[0] != cv2.cvtColor(source[index].color, cv2.COLOR_RGB2BGR)).any(-1)
        assert changed.mean() > 0.01
    assert largest <= 2


def test_a_real_layer_of_nothing_is_put_over_a_picture(device: Device) -> None:
    source = GallerySource("nothing", width=80)

    async def talk(client: StreamClient) -> None:
        bounds = {"volume_m": (-1.6, -0.3, -1.6, 1.6, 1.2, 1.6), "voxel_m": 0.04, "up": source.up}
        await client.hello(source.camera, Wishes(**bounds, light=source.light, answer="layer"))
        await client.send_frame(source[0])
        layer = (await next_answer(client)).layer
        assert (layer.virtual, layer.ratio, layer.plan.run) == (None, None, ("compose_layer",))
        picture = put_over(decode_layer(layer, source.camera), source[0].color, source.camera)
        np.testing.assert_array_equal(picture, source[0].color)

    with BackgroundServer(Service(device)) as server:
        with_client(server.url, talk)


def test_neutral_is_the_same_to_both_sides() -> None:
    assert of_server.NEUTRAL == NEUTRAL

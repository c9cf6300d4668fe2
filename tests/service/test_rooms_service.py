"""Rooms over the socket: clients that share one, who watches it, how many the device has time for."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from client.cli import app
from client.errors import OptionError
from client.options.room_options import room_place
from protocol.frames import IDENTITY
from protocol.messages import Acknowledged, Composite, Error, Hello, Light, Marker, PlaceObject, Watch, Welcome
from server.opencl.device import Device
from server.service.limits import Limits
from server.service.serve import BackgroundServer
from server.service.service import Service
from tests.scenes.rooms import CAMERA, frame_at, view_at, wishes
from tests.service import fakes
from tests.service.room_clients import answered, message_of
from tests.service.wire import Wire

PATIENT = Limits(max_period_s=3600.0)
"""Nobody is sent away since this machine is busy."""


@pytest.fixture
def real_server(device: Device) -> Iterator[BackgroundServer]:
    with BackgroundServer(Service(device, limits=PATIENT)) as server:
        yield server


def enter(url: str, **said: object) -> tuple[Wire, Welcome]:
    wire = Wire(url)
    wire.say(Hello(client="test", camera=CAMERA, wishes=wishes("given"), **{"room": "study"} | said))
    welcome = wire.hear()
    assert isinstance(welcome, Welcome), welcome
    return wire, welcome


def test_clients_of_a_room_share_it_and_others_do_not(real_server: BackgroundServer) -> None:
    first, welcome = enter(real_server.url)
    second, _ = enter(real_server.url, room_from_world=IDENTITY)
    apart, _ = enter(real_server.url, room="attic")
    assert welcome.room == "study"
    assert real_server.service.rooms.count == 2
    for step in range(4):
        answered(first, step)
    mesh = trimesh.creation.box((0.2, 0.2, 0.2)).export(file_type="ply")
    assert answered(second, 4).tracking == "given"
    second.say(PlaceObject(request=1, object="cube", format="ply", data=mesh, position_m=(-0.9, 0.6, 1.0)))
    assert second.hear_until(Acknowledged)[-1].error is None
    assert "rasterize" in answered(first, 5).plan.run
    assert "rasterize" not in answered(apart, 5).plan.run
    for wire in (first, second, apart):
        wire.hang_up()


def test_a_room_closes_behind_the_last(real_server: BackgroundServer) -> None:
    wires = [enter(real_server.url)[0] for _ in range(2)]
    answered(wires[0], 0)
    wires[0].hang_up()
    assert real_server.service.rooms.count == 1
    wires[1].hang_up()
    wait_until(lambda: real_server.service.rooms.count == 0)


def wait_until(holds) -> None:
    end_s = time.monotonic() + fakes.PATIENCE_S
    while not holds():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def test_watchers_of_a_room_see_only_that(real_server: BackgroundServer) -> None:
    watcher = Wire(real_server.url)
    watcher.say(Watch(room="study"))
    assert watcher.hear().session == "waiting"
    apart, _ = enter(real_server.url, room="attic")
    answered(apart, 0)
    inside, welcome = enter(real_server.url)
    answered(inside, 1)
    heard = watcher.hear_until(Composite)
    assert [m.session for m in heard if isinstance(m, Welcome)] == [welcome.session]
    assert heard[-1].frame == 1
    for wire in (apart, inside, watcher):
        wire.hang_up()


def test_a_client_too_many_is_told_that_the_server_is_full(start_server, lab) -> None:
    server = start_server(limits=Limits(max_period_s=0.05))
    first = Wire(server.url)
    first.greet()
    lab.hold = True
    for index in range(2):  # kernels are loaded in the first: it says nothing
        first.say(fakes.frame_message(index))
        lab.next_entered()
        time.sleep(0.1)  # the frame takes so long
        lab.release()
        first.hear_until(Composite)
    lab.hold = False
    second = Wire(server.url)
    second.say(Hello(client="test", camera=fakes.CAMERA))
    code, reason, messages = second.ending()
    assert code == 1013
    assert reason.startswith("the server is full: 1 sessions share its device")
    assert any(isinstance(m, Error) and m.fatal for m in messages)
    first.say(fakes.frame_message(2))
    first.hear_until(Composite)  # the others are not disturbed
    first.hang_up()


def test_sessions_that_share_a_device_step_down_and_are_told(start_server, lab) -> None:
    server = start_server(limits=Limits(target_period_s=0.0))
    wires = [Wire(server.url) for _ in range(2)]
    for wire in wires:
        wire.greet(preset="rm")
    for index in range(20):
        for wire in wires:
            wire.say(fakes.frame_message(index))
            composite = wire.hear_until(Composite)[-1]
    presets = [entry[1] for entry in lab.log if entry[0] == "preset"]
    assert sorted(set(presets)) == ["art1", "gr15fast", "reg4"]
    assert composite.plan.point is None or "share the device" in composite.plan.point.reason
    for wire in wires:
        wire.hang_up()


def test_options_say_the_room_and_the_place_in_it(tmp_path: Path) -> None:
    assert room_place(None, None, None) is None
    place = room_place("kitchen", "same", "7,0.12,apriltag_36h11")
    assert place is not None
    assert place.room_from_world == IDENTITY
    assert place.marker == Marker(id=7, side_m=0.12, dictionary="apriltag_36h11")
    file = tmp_path / "pose.txt"
    np.savetxt(file, np.eye(4))
    assert room_place("kitchen", str(file), None).room_from_world == IDENTITY


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ((None, "same", None), "name it with --room"),
        (("a", "1 2 3", None), "16"),
        (("a", " ".join(["2"] * 16), None), "last row"),
        (("a", None, "seven"), "ID,SIDE_M"),
        (("a", None, "7,0.1,qr"), "ID,SIDE_M"),
    ],
)
def test_options_that_say_nothing_are_refused(said: tuple, words: str) -> None:
    with pytest.raises(OptionError, match=words):
        room_place(*said)


def test_the_command_streams_into_a_room(real_server: BackgroundServer, tmp_path: Path) -> None:
    watcher = Wire(real_server.url)
    watcher.say(Watch(room="study"))
    watcher.hear()
    options = ["--frames", "0:2", "--room", "study", "--marker", "7,0.1"]
    command = ["stream", "synthetic:table", "--server", real_server.url, "--out", str(tmp_path), "--lossless", *options]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    assert len(list((tmp_path / "frames").iterdir())) == 2
    assert watcher.hear_until(Composite)
    watcher.hang_up()


def test_a_room_with_a_key_is_for_those_who_have_it(real_server: BackgroundServer) -> None:
    owner, welcome = enter(real_server.url, room_key="k3y")
    for key in (None, "guess"):
        wire = Wire(real_server.url)
        wire.say(Hello(client="test", camera=CAMERA, room="study", room_key=key))
        code, reason, _ = wire.ending()
        assert code == 4401
        assert reason == "room 'study' has a key of its own, and this is not it: ask who opened it"
    named = Wire(real_server.url)
    named.say(Watch(session=welcome.session))
    code, reason, _ = named.ending()
    assert code == 1008
    assert reason.endswith("sessions now: none")
    anybody, insider = Wire(real_server.url), Wire(real_server.url)
    anybody.say(Watch())
    assert anybody.hear().session == "waiting"
    insider.say(Watch(room="study", room_key="k3y"))
    assert insider.hear().session == welcome.session
    second, _ = enter(real_server.url, room_key="k3y", room_from_world=IDENTITY)
    answered(owner, 0)
    assert insider.hear_until(Composite)[-1].frame == 0
    for wire in (owner, second, anybody, insider):
        wire.hang_up()


def test_rooms_are_as_they_were_after_a_restart(device: Device, tmp_path: Path) -> None:
    mesh = trimesh.creation.box((0.2, 0.2, 0.2)).export(file_type="ply")
    with BackgroundServer(Service(device, data=tmp_path)) as server:
        wire, _ = enter(server.url, room_key="k3y")
        for step in range(12):
            before = answered(wire, step)
        wire.say(PlaceObject(request=1, object="cube", format="ply", data=mesh, position_m=(-0.9, 0.6, 1.0)))
        wire.hear_until(Acknowledged)
    assert "rasterize" not in before.plan.run
    with BackgroundServer(Service(device, data=tmp_path)) as server:
        refused = Wire(server.url)
        refused.say(Hello(client="test", camera=CAMERA, wishes=wishes("given"), room="study"))
        assert refused.ending()[0] == 4401
        wire, _ = enter(server.url, room_key="k3y")
        wire.say(message_of(frame_at(view_at(6), 0, given=view_at(6))))
        heard = wire.hear_until(Composite)
        after = heard[-1]
        assert after.tracking == "given"
        assert "rasterize" in after.plan.run
        light = next(message for message in heard if isinstance(message, Light))
        assert light.sh_std[0][0] is not None
        wire.hang_up()

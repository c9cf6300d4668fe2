"""Objects of a room are on the disk by the time they are acknowledged: a server that is then killed loses none."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh

from protocol.codec import decode_server
from protocol.frames import IDENTITY
from protocol.messages import (
    NOT_SAVED,
    Acknowledged,
    Composite,
    Hello,
    MoveObject,
    PlaceObject,
    RemoveObject,
    ServerMessage,
    Welcome,
    Wishes,
)
from server.opencl.device import Device
from server.room.room import Room
from server.service.mailbox import Mailbox
from server.service.monitoring.metrics import Metrics
from server.service.saving.room_store import RoomStore
from server.service.scheduler import Scheduler
from server.service.serve import BackgroundServer
from server.service.service import Service
from server.service.worker import Worker, WorkerContext
from tests.scenes.faulty_disk import FaultyDisk, full
from tests.scenes.rooms import CAMERA, frame_at, view_at, wishes
from tests.service import fakes
from tests.service.fakes import PATIENCE_S, FakePipeline, Lab, fake_mesh, frame_message
from tests.service.room_clients import answered, message_of
from tests.service.wire import Wire

CUBE = trimesh.creation.box((0.2, 0.2, 0.2)).export(file_type="ply")


@contextlib.contextmanager
def found(folder: Path, device: Device) -> Iterator[Room | None]:
    """The room as another server would find it now."""
    room = RoomStore(folder).load("study", device)
    try:
        yield room
    finally:
        if room is not None:
            room.close()


def kept(folder: Path, device: Device) -> set[str]:
    """Objects of that room."""
    with found(folder, device) as room:
        return {kept.object_id for kept in room.objects.kept()} if room else set()


def middle_of(folder: Path, device: Device, name: str) -> list[float]:
    """Where the object stands there: the bottom's middle; metres, world."""
    with found(folder, device) as room:
        assert room is not None
        (place,) = (kept.place for kept in room.objects.kept() if kept.object_id == name)
        if not isinstance(place, np.ndarray):
            return list(place.position_m)
        return (place @ [0.0, 0.0, -0.1, 1.0])[:3].round(6).tolist()  # of the cube; PLY: +z is up


@pytest.fixture
def server(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[BackgroundServer]:
    """One that saves nothing by itself."""
    monkeypatch.setattr("server.service.saving.room_saver.RoomSaver.start", lambda _self: None)
    with BackgroundServer(Service(device, data=tmp_path / "rooms")) as server:
        yield server


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "rooms"


def enter(server: BackgroundServer, **said: object) -> Wire:
    wire = Wire(server.url)
    wire.say(Hello(client="test", camera=CAMERA, wishes=wishes("given"), room="study", **said))
    assert isinstance(wire.hear(), Welcome)
    return wire


def place(wire: Wire, request: int, name: str) -> Acknowledged:
    wire.say(PlaceObject(request=request, object=name, format="ply", data=CUBE, position_m=(0, 0, 1)))
    return wire.hear_until(Acknowledged)[-1]


def test_what_is_acknowledged_is_kept(server: BackgroundServer, folder: Path, device: Device) -> None:
    wire = enter(server, room_from_world=IDENTITY)
    for request, name in enumerate(("a", "b")):
        assert place(wire, request, name).error is None
        assert name in kept(folder, device)
    wire.say(RemoveObject(request=7, object="a"))
    assert wire.hear_until(Acknowledged)[-1].error is None
    assert kept(folder, device) == {"b"}
    wire.hang_up()


@pytest.mark.parametrize("frames", [0, 1])
def test_a_move_that_is_acknowledged_is_kept(
    server: BackgroundServer, folder: Path, device: Device, frames: int
) -> None:
    wire = enter(server)
    for step in range(frames):
        answered(wire, step)
    for request, name in enumerate(("a", "b")):
        assert place(wire, request, name).error is None
    for step in range(3):
        target = (0.1 * step, 0.2, 1.0)
        wire.say(MoveObject(request=10 + step, object="a", position_m=target))
        assert wire.hear_until(Acknowledged)[-1].error is None
        assert middle_of(folder, device, "a") == pytest.approx(target)
    assert middle_of(folder, device, "b") == pytest.approx((0, 0, 1))
    wire.say(RemoveObject(request=20, object="a"))  # a whole save: the moves are of one before
    wire.hear_until(Acknowledged)
    assert kept(folder, device) == {"b"}
    wire.hang_up()


def test_what_could_not_be_saved_is_acknowledged_with_an_error(
    server: BackgroundServer, folder: Path, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is done all the same; asking again tells whether it has been saved."""
    wire = enter(server, room_from_world=IDENTITY)
    disk = FaultyDisk(monkeypatch)
    disk.only_writes = True
    cube = PlaceObject(request=1, object="a", format="ply", data=CUBE, position_m=(0, 0, 1))
    for request, after in (
        (cube, {"a"}),
        (MoveObject(request=2, object="a", position_m=(0.1, 0.2, 1.0)), {"a"}),
        (RemoveObject(request=3, object="a"), set()),
    ):
        before = kept(folder, device), middle_of(folder, device, "a") if kept(folder, device) else None
        disk.fail_at(1, full())
        wire.say(request)
        error = wire.hear_until(Acknowledged)[-1].error
        assert error is not None
        assert error.startswith(f"{NOT_SAVED}No space left on device; it is done, and lost if")
        assert str(folder) not in error
        assert (kept(folder, device), middle_of(folder, device, "a") if kept(folder, device) else None) == before
        wire.say(request)
        assert wire.hear_until(Acknowledged)[-1].error is None
        assert kept(folder, device) == after
        if isinstance(request, MoveObject):
            assert middle_of(folder, device, "a") == pytest.approx(request.position_m)
    wire.hang_up()


@pytest.mark.usefixtures("open_umask")
def test_a_room_without_a_frame_or_an_object_is_not_kept(
    server: BackgroundServer, folder: Path, device: Device
) -> None:
    enter(server, room_from_world=IDENTITY).hang_up()
    wire = enter(server, room_from_world=IDENTITY)  # after the first has been closed, or not
    server.service._persistence._saver.save_all()
    assert not folder.exists() or not list(folder.iterdir())
    assert place(wire, 1, "a").error is None
    assert kept(folder, device) == {"a"}
    inside = list(folder.rglob("*"))
    assert {path.stat().st_mode & 0o777 for path in inside if path.is_dir()} == {0o700}
    assert {path.stat().st_mode & 0o777 for path in inside if path.is_file()} == {0o600}
    (room,) = folder.iterdir()
    room.chmod(0o755)  # of an earlier version
    assert place(wire, 2, "b").error is None
    assert room.stat().st_mode & 0o777 == 0o700
    wire.hang_up()


@pytest.fixture
def open_umask() -> Iterator[None]:
    """Lets all read what is made without a mode."""
    before = os.umask(0)
    yield
    os.umask(before)


def test_an_object_of_a_client_that_is_not_aligned_is_told_after_a_crash(
    server: BackgroundServer, folder: Path, device: Device
) -> None:
    first = enter(server)
    for step in range(3):
        answered(first, step)
    lost = enter(server)  # says nothing of its world, and shows nothing that it is known by
    acknowledged = place(lost, 1, "vase")
    assert acknowledged.error is None
    assert acknowledged.notes == ("it is placed once this client is aligned with the room",)
    assert kept(folder, device) == set()
    with BackgroundServer(Service(device, data=folder)) as other:  # as after a kill
        again = enter(other, room_from_world=IDENTITY)
        note = "'vase'"
        assert any(note in line for line in answered(again, 4).notes)
        assert not any(note in line for line in answered(again, 5).notes)  # once for each client
        assert place(again, 2, "vase").error is None
        later = enter(other, room_from_world=IDENTITY)
        assert not any(note in line for line in answered(later, 6).notes)
        for wire in (again, later):
            wire.hang_up()
    for wire in (first, lost):
        wire.hang_up()


def test_pending_objects_can_be_removed(server: BackgroundServer, folder: Path, device: Device) -> None:
    first = enter(server)
    answered(first, 0)
    lost = enter(server)
    assert place(lost, 1, "vase").error is None
    with found(folder, device) as room:
        assert room is not None
        assert room.objects.inventory().pending == ("vase",)
    first.say(RemoveObject(request=1, object="vase"))
    assert first.hear_until(Acknowledged)[-1].error is None
    with found(folder, device) as room:
        assert room is not None
        assert room.objects.inventory().pending == ()
    for wire in (first, lost):
        wire.hang_up()


def test_once_its_client_is_aligned_nothing_is_pending(server: BackgroundServer, folder: Path, device: Device) -> None:
    first = enter(server)
    for step in range(3):
        answered(first, step)
    second = enter(server)
    assert place(second, 1, "vase").error is None
    second.say(message_of(frame_at(view_at(1), 0, given=view_at(1))))  # shows what the first has shown
    assert second.hear_until(Composite)[-1].tracking == "given"
    assert place(second, 2, "other").error is None
    assert kept(folder, device) == {"vase", "other"}
    with found(folder, device) as room:
        assert room is not None
        assert room.objects.inventory().pending == ()
    for wire in (first, second):
        wire.hang_up()


class Inbox:
    """An outbox that notes what has been kept when something is sent."""

    waited_s = 0.0

    def __init__(self) -> None:
        self.kept: list[int] = []
        self.heard: list[tuple[ServerMessage, int]] = []
        self.all_heard = threading.Event()

    def greet(self, device_name: str) -> None:
        pass

    def answer_to(self, connection: int) -> None:
        pass

    def is_watched(self) -> bool:
        return False

    def publish(self, messages: tuple[bytes, ...]) -> None:
        pass

    def send(self, data: bytes) -> None:
        message = decode_server(data)
        self.heard.append((message, len(self.kept)))
        if isinstance(message, Acknowledged) and message.request == 99:
            self.all_heard.set()


def test_moves_that_wait_behind_a_frame_are_kept_together() -> None:
    """Each is done and acknowledged; the disk is waited for once."""
    lab, inbox = Lab(hold=True), Inbox()
    pipeline = FakePipeline(lab)
    context = WorkerContext(
        open_pipeline=lambda _hello: contextlib.nullcontext(pipeline),
        mesh_loader=lambda: fake_mesh,
        metrics=Metrics(),
        scheduler=Scheduler(),
        save_placements=lambda _name: inbox.kept.append(len(lab.log)),
    )
    mailbox = Mailbox(2)
    hello = Hello(client="test", camera=fakes.CAMERA, wishes=Wishes(answer="light"), room="study")
    worker = Worker(context, hello, mailbox, inbox)
    working = threading.Thread(target=worker.run)
    working.start()
    mailbox.post(PlaceObject(request=0, object="vase", format="ply", data=b"mesh", position_m=(0, 0, 1)))
    mailbox.post(frame_message(0))
    lab.next_entered()
    for request in range(1, 6):
        mailbox.post(MoveObject(request=request, object="vase", position_m=(0, 0, request)))
    mailbox.post(RemoveObject(request=6, object="vase"))
    mailbox.post(MoveObject(request=99, object="vase", position_m=(0, 0, 1)))
    lab.release()
    assert inbox.all_heard.wait(PATIENCE_S)
    mailbox.close()
    working.join(PATIENCE_S)
    answers = [(message.request, kept, message.error) for message, kept in inbox.heard if hasattr(message, "request")]
    assert [request for request, _, _ in answers] == [0, 1, 2, 3, 4, 5, 6, 99]
    assert [kept for request, kept, _ in answers if 1 <= request <= 5] == [1] * 5
    assert "no object" in answers[-1][2]
    assert [entry[0] for entry in lab.log].count("move") == 6

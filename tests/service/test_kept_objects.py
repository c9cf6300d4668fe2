"""Objects of a room are on the disk by the time they are acknowledged: a server that is then killed loses none."""

from __future__ import annotations

from pathlib import Path

import pytest
import trimesh

from protocol.frames import IDENTITY
from protocol.messages import Acknowledged, Hello, PlaceObject, RemoveObject, Welcome
from server.opencl.device import Device
from server.room_store import RoomStore
from server.serve import start_in_background
from server.service import Service
from tests.rooms import CAMERA, wishes
from tests.service.wire import Wire

CUBE = trimesh.creation.box((0.2, 0.2, 0.2)).export(file_type="ply")


def kept(folder: Path, device: Device) -> set[str]:
    """Objects of the room as another server would find it now."""
    room = RoomStore(folder).load("study", device)
    if room is None:
        return set()
    names = {kept.object_id for kept in room.objects.kept()}
    room.close()
    return names


def test_what_is_acknowledged_is_kept(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.room_saver.RoomSaver.start", lambda _self: None)  # nothing else saves
    with start_in_background(Service(device, data=tmp_path)) as server:
        wire = Wire(server.url)
        wire.say(Hello(client="test", camera=CAMERA, wishes=wishes("given"), room="study", room_from_world=IDENTITY))
        assert isinstance(wire.hear(), Welcome)
        for request, name in enumerate(("a", "b")):
            wire.say(PlaceObject(request=request, object=name, format="ply", data=CUBE, position_m=(0, 0, 1)))
            assert wire.hear_until(Acknowledged)[-1].error is None
            assert name in kept(tmp_path, device)
        wire.say(RemoveObject(request=7, object="a"))
        assert wire.hear_until(Acknowledged)[-1].error is None
        assert kept(tmp_path, device) == {"b"}
        wire.hang_up()

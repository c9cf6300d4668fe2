"""Objects of a client that does not know yet where in the room it is: they wait, and can be moved and removed there."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from protocol.messages import Hello
from server.client_session import ClientSession
from server.opencl.device import Device
from server.room.room import Room
from server.scene.placement import Placement
from tests.scenes.kept_rooms import CUBE, scan
from tests.scenes.rooms import CAMERA, wishes

THERE, ELSEWHERE = Placement(position_m=(-0.9, 0.6, 1.0)), Placement(position_m=(-0.7, 0.5, 1.2))


@pytest.fixture
def clients(device: Device) -> Iterator[tuple[ClientSession, ClientSession]]:
    """One that has scanned, and one that has not been seen to fit yet."""
    asked = wishes("given")
    room = Room(device, asked, "study")
    hello = Hello(client="test", camera=CAMERA, wishes=asked, room="study")
    pipelines = ClientSession(device, CAMERA, asked, room, hello), ClientSession(device, CAMERA, asked, room, hello)
    scan(pipelines[0], range(0, 12))
    yield pipelines
    for pipeline in pipelines:
        pipeline.close()
    room.close()


def places(client: ClientSession) -> dict[str, list[float]]:
    """Of all objects of its room, the middle of each model's floor."""
    return {kept.object_id: np.asarray(kept.place)[:3, 3].round(3).tolist() for kept in client._room.objects.kept()}


def test_an_object_that_waits_is_moved_and_removed(clients: tuple[ClientSession, ClientSession]) -> None:
    first, second = clients
    first.place_object("reference", CUBE, ELSEWHERE)
    for name in ("moved", "removed"):
        second.place_object(name, CUBE, THERE)
    second.move_object("moved", ELSEWHERE)
    second.remove_object("removed")
    with pytest.raises(KeyError):
        second.remove_object("removed")
    assert set(places(first)) == {"reference"}
    scan(second, range(4, 7))
    assert second._alignment.is_settled
    found = places(first)
    assert set(found) == {"reference", "moved"}
    np.testing.assert_allclose(found["moved"], found["reference"], atol=1e-3)  # seen: equal


def test_a_move_that_cannot_be_leaves_what_waits(clients: tuple[ClientSession, ClientSession]) -> None:
    _, second = clients
    second.place_object("cube", CUBE, THERE)
    with pytest.raises(ValueError, match="choose another scale"):
        second.move_object("cube", Placement(position_m=(0.0, 0.0, 1.0), scale=1e9))
    scan(second, range(4, 7))
    assert set(places(second)) == {"cube"}

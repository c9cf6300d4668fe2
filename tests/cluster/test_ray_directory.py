"""Rooms whose clients have left before Ray was asked for them."""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("ray", reason="needs the extra cluster: make install-cluster")

from server.cluster import ray_directory
from server.cluster.ray_directory import RayRoomDirectory
from server.cluster.room_directory import RoomUnavailable
from server.cluster.settings import read_settings


def test_a_room_that_is_given_up_while_ray_is_asked_is_not_created(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, goes_on, created = threading.Event(), threading.Event(), []

    def names() -> list[str]:
        asked.set()
        goes_on.wait()
        return []

    def no_actor(_name: str, _namespace: str) -> None:
        raise ValueError

    claimed = SimpleNamespace(claim=SimpleNamespace(remote=lambda *_: None))
    monkeypatch.setattr(ray_directory, "room_names", names)
    monkeypatch.setattr(ray_directory, "_quota", lambda _settings: claimed)
    monkeypatch.setattr(ray_directory, "ABANDON_PAUSE_S", 0.0)
    monkeypatch.setattr(ray_directory.ray, "get", lambda _reference: True)
    monkeypatch.setattr(ray_directory.ray, "get_actor", no_actor)
    monkeypatch.setattr(ray_directory.ray, "remote", created.append)

    async def run() -> None:
        directory = RayRoomDirectory(read_settings({"data": str(tmp_path)}))
        finding = asyncio.create_task(directory.find("room", may_open=True, is_private=True))
        await asyncio.to_thread(asked.wait)
        abandoning = asyncio.create_task(directory.abandon("room"))
        await asyncio.sleep(0)  # it has begun
        goes_on.set()
        await abandoning
        with pytest.raises(RoomUnavailable, match="has left"):
            await finding

    asyncio.run(run())
    assert created == []

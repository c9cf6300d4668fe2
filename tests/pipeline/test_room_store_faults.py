"""Saves that are cut short or damaged: the last whole one comes back, and what was wrong is said in a line."""

from __future__ import annotations

import hashlib
import logging
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zstandard

from protocol.messages import Marker
from server.opencl.device import Device
from server.room.room import Room
from server.scene.placement import Placement
from server.service.saving import room_state as states
from server.service.saving import save_slot as slots
from server.service.saving.checksummed_files import read_parts, write_parts
from server.service.saving.room_store import RoomStore, RoomStoreError, folder_name
from tests.scenes.faulty_disk import FaultyDisk, PowerCut, full
from tests.scenes.kept_rooms import CUBE, PLACE, client_of, found, layout_of, print_of, scan
from tests.scenes.rooms import wishes
from tests.scenes.volumes import renew_tables


@pytest.fixture
def room(device: Device) -> Iterator[Room]:
    room = Room(device, wishes("given"), "study")
    client = client_of(device, room, wishes("given"))
    client.place_object("cube", CUBE, PLACE)
    scan(client, range(1))
    yield room
    room.close()


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> FaultyDisk:
    return FaultyDisk(monkeypatch)


def change(room: Room, number: int) -> None:
    """Something of everything."""
    volume = room.reconstruction.volume
    assert volume is not None
    volume.colors[1 + number : 3 + number].fill(np.uint32(number))
    renew_tables(volume)
    volume.count_frame()
    room.markers.note(Marker(id=number, side_m=0.1), number * np.eye(4))
    mesh = replace(CUBE, notes=(f"number {number}",))  # a file of its own, and for the device the same
    room.objects.place("other", mesh, Placement(position_m=(0.1 * number, 0.0, 1.0)))


def changed(room: Room, number: int) -> tuple[str, ...]:
    """The same; the room's print then."""
    change(room, number)
    return print_of(room)


def saved_thrice(folder: Path, room: Room, first: int) -> tuple[RoomStore, list[tuple[str, ...]]]:
    """A store that goes on with files of before, and the prints of what it saved."""
    store, prints = RoomStore(folder), []
    for number in range(first, first + 3):
        prints.append(changed(room, number))
        store.save(room)
    return store, prints


def test_after_a_power_cut_at_any_step_of_a_save_the_last_whole_one_is_there(
    device: Device, room: Room, disk: FaultyDisk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(slots, "SPARE_BRICKS", -(10**9))  # files are merged at every save
    step, seen, was_cut = 1, [], True
    while was_cut:
        folder = tmp_path / f"cut-{step}"
        store, number = RoomStore(folder), 4 * step
        for earlier in range(number, number + 2):
            change(room, earlier)
            store.save(room)
        prints = [changed(room, number + 2)]
        store.save(room)
        prints.append(changed(room, number + 3))
        disk.fail_at(step, PowerCut())
        try:
            store.save(room)
            was_cut = False
        except PowerCut:
            disk.cut()
        disk.fails_at = 0
        for number in ("0", "1"):
            slots.SaveSlot(folder / folder_name("study") / number).read()  # both saves are whole
        seen.append(prints.index(found(folder, device)))
        if step % 8 == 1:
            RoomStore(folder).save(room)
            assert found(folder, device) == prints[1]
        shutil.rmtree(folder)
        step += 1
    assert seen == sorted(seen)  # up to a certain step that before, and from then on the new one
    assert set(seen) == {0, 1}
    assert len(seen) > 12


def test_after_a_power_cut_in_the_first_save_nothing_or_all_of_it_is_there(
    device: Device, room: Room, disk: FaultyDisk, tmp_path: Path
) -> None:
    whole, step, was_cut = [], 1, True
    expected = changed(room, 1)
    while was_cut:
        folder = tmp_path / f"cut-{step}"
        disk.fail_at(step, PowerCut())
        try:
            RoomStore(folder).save(room)
            was_cut = False
        except PowerCut:
            disk.cut()
        disk.fails_at = 0
        again = RoomStore(folder).load("study", device)
        whole.append(again is not None)
        assert RoomStore(folder).names() == (("study",) if again else ())
        if again is not None:
            assert print_of(again) == expected
            again.close()
        step += 1
    assert whole == sorted(whole)
    assert set(whole) == {False, True}


def test_a_full_disk_is_told_and_the_room_goes_on(device: Device, room: Room, disk: FaultyDisk, tmp_path: Path) -> None:
    store, prints = saved_thrice(tmp_path, room, 0)
    disk.only_writes = True
    step, failures = 0, 0
    while failures == step:
        step += 1
        disk.fail_at(step, full())
        before, prints = prints[-1], [*prints, changed(room, 2 + step)]
        told = []
        try:
            store.save(room)
        except RoomStoreError as error:
            told.append(str(error))
        for line in told:
            failures += 1
            assert "room 'study' was not saved, it goes on in memory: No space left on device" in line
            assert "\n" not in line
            disk.fails_at = 0
            assert found(tmp_path, device) == before
            store.save(room)
        assert found(tmp_path, device) == prints[-1]
    assert failures > 6


def test_a_full_disk_leaves_nothing_half_written_behind(room: Room, disk: FaultyDisk, tmp_path: Path) -> None:
    store, _ = saved_thrice(tmp_path, room, 0)
    before = {path for path in tmp_path.rglob("*") if path.is_file()}
    change(room, 4)
    disk.only_writes = True
    for step in (1, 4, 8):
        disk.fail_at(step, full())
        with pytest.raises(RoomStoreError):
            store.save(room)
        assert {path for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_folder_that_cannot_be_written_to_is_told(room: Room, tmp_path: Path) -> None:
    (tmp_path / "rooms").write_text("not a folder")
    with pytest.raises(RoomStoreError, match="room 'study' was not saved, it goes on in memory"):
        RoomStore(tmp_path / "rooms").save(room)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def flip(at: float) -> object:
    def flipped(path: Path) -> None:
        data = bytearray(path.read_bytes())
        data[int(at * (len(data) - 1))] ^= 16
        path.write_bytes(data)

    return flipped


DAMAGE = {"cut short": truncate, "empty": empty, "gone": Path.unlink, **{f"flipped at {at}": flip(at) for at in
          (0.0, 0.01, 0.3, 0.7, 1.0)}}  # fmt: skip


OF_EVERY_FILE = ("cut short", "flipped at 0.3")
"""Damage that is done to old files of a save too; all others to the newest of each kind."""


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_save_is_set_aside_and_the_one_before_comes_back(
    device: Device, room: Room, tmp_path: Path, caplog: pytest.LogCaptureFixture, kind: str
) -> None:
    damage = DAMAGE[kind]
    _, prints = saved_thrice(tmp_path / "whole", room, 0)
    own = Path(folder_name("study")) / "0"  # the first and the third go there
    names = sorted(path.name for path in (tmp_path / "whole" / own).iterdir())
    assert [name.partition("-")[0] for name in names] == ["bricks", "bricks", "mesh", "mesh", "save"]
    for name in names if kind in OF_EVERY_FILE else [*names[1:4:2], "save"]:
        folder = tmp_path / name
        shutil.copytree(tmp_path / "whole", folder)
        damage(folder / own / name)  # type: ignore[operator]
        if name == "save" and damage is Path.unlink:
            assert found(folder, device) == prints[1]
            continue
        with caplog.at_level(logging.WARNING):
            caplog.clear()
            assert found(folder, device) == prints[1]
        (record,) = caplog.records
        assert record.getMessage().startswith("a save of room 'study' is set aside as ")
        assert "\n" not in record.getMessage()
        aside = folder / own.parent / "set-aside-1"
        assert {path.name for path in aside.iterdir()} >= set(names) - {name}
        caplog.clear()
        again = RoomStore(folder)
        assert again.load("study", device) is not None
        again.save(room)
        assert not caplog.records
        assert found(folder, device) == prints[2]


def test_where_both_saves_are_damaged_each_is_told_and_the_room_begins_anew(
    device: Device, room: Room, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store, prints = saved_thrice(tmp_path, room, 0)
    for path in (tmp_path / folder_name("study")).glob("*/save"):
        truncate(path)
    with caplog.at_level(logging.WARNING):
        assert RoomStore(tmp_path).load("study", device) is None
    assert len(caplog.records) == 2
    store = RoomStore(tmp_path)
    store.save(room)
    assert found(tmp_path, device) == prints[2]


def test_files_that_rot_while_the_server_runs_are_written_anew(
    device: Device, room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(slots, "SPARE_BRICKS", -(10**9))  # files are merged at every save
    store, prints = saved_thrice(tmp_path, room, 0)
    change(room, 3)
    for path in (tmp_path / folder_name("study") / "1").glob("bricks-*"):
        truncate(path)
    with pytest.raises(RoomStoreError, match="ends too early"):
        store.save(room)
    assert found(tmp_path, device) == prints[2]
    latest = changed(room, 4)
    store.save(room)
    assert found(tmp_path, device) == latest


def test_a_save_of_another_version_is_set_aside(
    device: Device, room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    RoomStore(tmp_path).save(room)
    monkeypatch.setattr(slots, "VERSION", states.VERSION + 1)
    monkeypatch.setattr(slots, "READABLE", (states.VERSION + 1,))
    with caplog.at_level(logging.WARNING):
        assert RoomStore(tmp_path).load("study", device) is None
    assert f"is of version {states.VERSION}, this program reads {states.VERSION + 1}" in caplog.text


def test_a_save_of_the_first_version_is_read(device: Device, room: Room, tmp_path: Path) -> None:
    """It has no places to be told of, its lights no spread, and its patches no side and one grid."""
    RoomStore(tmp_path).save(room)
    path = next(tmp_path.rglob(slots.SAVE))
    header, packed = read_parts(path)
    state = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(packed))
    del state["wishes"]["light_at"]
    for light in lights_in(state):
        del light["spread_deg"]
    patches = state["light"]["room"]["patches"]
    del patches["side_m"]
    vectors, numbers = dict.fromkeys(("positions", "normals", "logarithms"), 3), ("variances", "clipped", "weights")
    arrays = {name: np.full((1, width), 0.1) for name, width in vectors.items()} | dict.fromkeys(numbers, np.ones(1))
    arrays["keys"] = np.zeros((1, 6), np.int64)
    patches |= {name: states.array_to_list(array) for name, array in arrays.items()}
    old = msgspec.msgpack.encode(msgspec.msgpack.decode(header) | {"version": 1})
    write_parts(path, [old, zstandard.ZstdCompressor().compress(msgspec.msgpack.encode(state))])
    loaded = RoomStore(tmp_path).load("study", device)
    assert loaded is not None
    assert loaded.wishes.light_at == ()
    assert loaded.light.estimate().spread_deg is None
    resumed = loaded.light.known().room.patches
    assert resumed.side_m == 0.15
    assert resumed.keys.shape == (2, 7)


def lights_in(value: Any) -> Iterator[dict[str, Any]]:
    if isinstance(value, dict):
        if "spread_deg" in value:
            yield value
        value = list(value.values())
    if isinstance(value, list):
        for part in value:
            yield from lights_in(part)


def test_two_saves_are_kept(device: Device, room: Room, tmp_path: Path) -> None:
    _, prints = saved_thrice(tmp_path, room, 0)
    assert found(tmp_path, device) == prints[2]
    shutil.rmtree(tmp_path / folder_name("study") / "0")
    assert found(tmp_path, device) == prints[1]


LAYOUT = "648ce2ccc95d2633"


def test_the_version_is_that_of_the_layout() -> None:
    """Where this fails, another layout is written: give it another `VERSION`."""
    layout = hashlib.blake2b(repr(layout_of(states.RoomState)).encode(), digest_size=8).hexdigest()
    assert (states.VERSION, layout) == (5, LAYOUT)

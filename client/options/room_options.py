"""Options of the room to join and of the pose of the client's world in it."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import msgspec

from client.errors import OptionError
from client.streaming.client import RoomPlace
from protocol.frames import IDENTITY, check_rigid
from protocol.messages import Dictionary, Marker

SAME = "same"


def room_place(
    room: str | None, room_from_world: str | None, marker: str | None, key: str | None = None
) -> RoomPlace | None:
    """None without `--room`. Raises OptionError."""
    if room is None:
        for option, value in (("--room-key", key), ("--room-from-world", room_from_world), ("--marker", marker)):
            if value is not None:
                raise OptionError(f"{option} is of a room: name it with --room")
        return None
    return RoomPlace(
        room,
        key,
        None if room_from_world is None else _matrix(room_from_world),
        None if marker is None else _marker(marker),
    )


def _matrix(text: str) -> tuple[float, ...]:
    """`same`, sixteen numbers, or a file with them. Raises OptionError."""
    if text == SAME:
        return IDENTITY
    path = Path(text)
    try:
        words = path.read_text() if path.is_file() else text
    except (OSError, UnicodeDecodeError) as error:
        raise OptionError(f"--room-from-world {text}: cannot be read ({error})") from error
    try:
        numbers = tuple(float(word) for word in words.replace(",", " ").split())
        check_rigid("--room-from-world", numbers)
    except ValueError as error:
        raise OptionError(
            f"--room-from-world: expected `same` or 16 numbers of a rigid 4x4, row by row: {error}"
        ) from error
    return numbers


def _marker(text: str) -> Marker:
    """Raises OptionError."""
    words = text.split(",")
    try:
        number, side_m, *dictionary = words
        fields = {"id": int(number), "side_m": float(side_m)} | ({"dictionary": dictionary[0]} if dictionary else {})
        if len(words) > 3:
            raise ValueError("more than three parts")
        return msgspec.convert(fields, Marker)
    except (ValueError, msgspec.ValidationError) as error:
        raise OptionError(
            f"--marker {text}: expected ID,SIDE_M[,DICTIONARY], the last of {', '.join(get_args(Dictionary))} ({error})"
        ) from error

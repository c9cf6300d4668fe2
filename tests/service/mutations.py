"""Messages that are nearly right: whole ones of every kind with one to three things changed that a fuzzer would.

Changes know what a message is made of: a field of another type, absent, unknown, nested, a number far out
of range or not finite, a length that lies, text that is not UTF-8, bytes cut, added or flipped.
"""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable, Sequence
from typing import Any

import msgpack

Path = tuple[Any, ...]
"""Keys and places that lead to a value."""

NUMBERS = (
    0,
    1,
    -1,
    2,
    255,
    4096,
    4097,
    65536,
    2**31,
    -(2**31) - 1,
    2**53,
    2**53 + 1,
    2**63,
    2**64 - 1,
    -(2**63),
    0.5,
    -0.0,
    1e-320,
    1e-30,
    1e30,
    1.7e308,
    math.inf,
    -math.inf,
    math.nan,
)
TEXTS = ("", " ", "x" * 64, "x" * 65, "x" * 5000, "\x00", "ä\u202e\n", "../../etc/passwd", "%s%n", "hello", "\ud800")
OTHERS: tuple[Any, ...] = (None, True, False, [], {}, [[]], [None] * 20, {"type": "frame"}, b"", b"\xff" * 20)
NESTED = 2000
HUGE_HEADERS = (b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff")
"""Arrays, maps, bytes and text of four thousand million."""


class Mutator:
    """Endless mutations of `messages` (MessagePack), the same for the same seed."""

    def __init__(self, messages: Sequence[bytes], seed: int) -> None:
        self._random = random.Random(seed)
        self._messages = [msgpack.unpackb(data, strict_map_key=False) for data in messages]

    def next(self) -> bytes:
        """One message."""
        chance = self._random
        message = _copied(chance.choice(self._messages))
        for _ in range(chance.choice((1, 1, 1, 2, 3))):
            chance.choice(STRUCTURE)(self, message)
        data = packed(message)
        return chance.choice(BYTES)(self, data) if chance.random() < 0.3 else data

    def any_value(self) -> Any:
        """Of any type."""
        chance = self._random
        values = (*NUMBERS, *TEXTS, *OTHERS, chance.randbytes(chance.randrange(40)), Nested(NESTED))
        return _copied(chance.choice(values))

    def _place(self, message: Any) -> tuple[Any, Any]:
        """A container within the message, and a key of it."""
        places = [(holder, key) for holder, key in _places(message)]
        return self._random.choice(places) if places else (message, "type")

    def replace(self, message: Any) -> None:
        holder, key = self._place(message)
        holder[key] = self.any_value()

    def nudge(self, message: Any) -> None:
        """Another value of the same type."""
        chance = self._random
        holder, key = self._place(message)
        value = holder.get(key) if isinstance(holder, dict) else holder[key]
        if isinstance(value, bool) or value is None:
            holder[key] = _copied(chance.choice(OTHERS))
        elif isinstance(value, int | float):
            holder[key] = chance.choice((*NUMBERS, -value, value + 1, value * 1e6, float(value), str(value)))
        elif isinstance(value, str):
            holder[key] = chance.choice((*TEXTS, value + "x", value[:-1], value.upper()))
        elif isinstance(value, bytes):
            cut = chance.randrange(len(value) + 1)
            holder[key] = chance.choice((value[:cut], value + b"\x00", value[:cut] + chance.randbytes(4) + value[cut:]))
        elif isinstance(value, list):
            holder[key] = chance.choice((value[:-1], [*value, *value], [value], value[::-1]))

    def remove(self, message: Any) -> None:
        holder, key = self._place(message)
        if isinstance(holder, dict):
            holder.pop(key, None)
        else:
            del holder[key]

    def add(self, message: Any) -> None:
        """A field that does not exist, or one of another kind of message."""
        chance = self._random
        other = chance.choice(self._messages)
        holder = chance.choice([holder for holder, _ in _places(message) if isinstance(holder, dict)] or [message])
        name = chance.choice((*other, "extra", "", 7, None, b"type"))
        holder[name] = _copied(other.get(name, self.any_value()))

    def swap(self, message: Any) -> None:
        """The type of another message."""
        message["type"] = self._random.choice(self._messages)["type"]

    def cut(self, data: bytes) -> bytes:
        return data[: self._random.randrange(len(data) + 1)]

    def append(self, data: bytes) -> bytes:
        return data + self._random.choice((b"\x00", data, self._random.randbytes(8)))

    def flip(self, data: bytes) -> bytes:
        changed = bytearray(data)
        for _ in range(self._random.randint(1, 4)):
            if changed:
                changed[self._random.randrange(len(changed))] = self._random.randrange(256)
        return bytes(changed)

    def lie(self, data: bytes) -> bytes:
        """A header of something huge in the middle."""
        at = self._random.randrange(len(data) + 1)
        return data[:at] + self._random.choice(HUGE_HEADERS) + data[at:]

    def noise(self, data: bytes) -> bytes:
        return self._random.randbytes(self._random.randrange(min(len(data), 400) + 1))


STRUCTURE: tuple[Callable[[Mutator, Any], None], ...] = (
    Mutator.replace,
    Mutator.replace,
    Mutator.nudge,
    Mutator.nudge,
    Mutator.nudge,
    Mutator.remove,
    Mutator.add,
    Mutator.swap,
)
BYTES: tuple[Callable[[Mutator, bytes], bytes], ...] = (
    Mutator.cut,
    Mutator.append,
    Mutator.flip,
    Mutator.flip,
    Mutator.lie,
    Mutator.noise,
)


class Nested:
    """Lists in lists, so many deep."""

    def __init__(self, depth: int) -> None:
        self.depth = depth


def packed(message: Any) -> bytes:
    """MessagePack, also of what no encoder packs: numbers beyond 64 bits, broken text, bottomless lists."""
    match message:
        case dict():
            parts = [packed(part) for pair in message.items() for part in pair]
            data = struct.pack(">BI", 0xDF, len(message)) + b"".join(parts)
        case list():
            data = struct.pack(">BI", 0xDD, len(message)) + b"".join(map(packed, message))
        case Nested():
            data = b"\x91" * message.depth + b"\xc0"
        case str():
            text = message.encode("utf-8", "surrogatepass")
            data = struct.pack(">BI", 0xDB, len(text)) + text
        case int() if not -(2**63) <= message < 2**64:
            data = msgpack.packb(float(message))
        case _:
            data = msgpack.packb(message)
    return data


def _places(message: Any) -> list[tuple[Any, Any]]:
    """Every container with every key of it, however deep."""
    if isinstance(message, dict):
        own = [(message, key) for key in message]
        return own + [place for value in message.values() for place in _places(value)]
    if isinstance(message, list):
        own = [(message, key) for key in range(len(message))]
        return own + [place for value in message for place in _places(value)]
    return []


def _copied(message: Any) -> Any:
    if isinstance(message, dict):
        return {key: _copied(value) for key, value in message.items()}
    return [_copied(value) for value in message] if isinstance(message, list) else message

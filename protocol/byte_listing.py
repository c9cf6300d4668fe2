"""Lists the bytes of a MessagePack message, each value on a line with what it says; long data is told by its period."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator

_SHOWN_BYTES = 16
"""Longer data is written as its repeated unit."""
_HEX_COLUMNS = 40
_NUMBERS = {0xCB: ">d", 0xCA: ">f", 0xCC: ">B", 0xCD: ">H", 0xCE: ">I", 0xCF: ">Q"}
_SINGLE = {0xC0: "null", 0xC2: "false", 0xC3: "true"}


def listing(data: bytes) -> str:
    """Lines `hex bytes  # meaning`. Raises ValueError for a type that the protocol does not use."""
    lines = []
    position = 0
    for size, hexadecimal, meaning, depth in _values(data, 0, 0):
        position += size
        lines.append(f"{'  ' * depth + hexadecimal:<{_HEX_COLUMNS}}  # {meaning}")
    if position != len(data):
        raise ValueError(f"{len(data) - position} bytes follow the message")
    return "\n".join(lines)


def read_listing(text: str) -> bytes:
    """The bytes that a listing shows: `b4 dc`, and `(b4) x 768` for repeated ones."""
    data = b""
    for line in text.splitlines():
        shown = line.split("#")[0].strip()
        head, _, repeated = shown.partition("(")
        data += bytes.fromhex(head)
        if repeated:
            unit, count = repeated.split(") x ")
            data += bytes.fromhex(unit) * int(count)
    return data


def _values(data: bytes, at: int, depth: int) -> Iterator[tuple[int, str, str, int]]:
    """Size, bytes as text, meaning and nesting of the value at `at` and of those inside it."""
    first = data[at]
    if first >> 4 == 0x8:
        yield 1, f"{first:02x}", f"map of {first & 15} fields", depth
        yield from _fields(data, at + 1, first & 15, depth + 1)
    elif first >> 4 == 0x9 or first == 0xDC:
        yield (*_numbers(data, at), depth)
    else:
        yield (*_scalar(data, at), depth)


def _fields(data: bytes, at: int, count: int, depth: int) -> Iterator[tuple[int, str, str, int]]:
    for _ in range(count):
        key_size, key_shown, key = _scalar(data, at)
        (size, shown, meaning, _), *inside = _values(data, at + key_size, depth)
        yield key_size + size, f"{key_shown} {shown}", f"{key}: {meaning}", depth
        yield from inside
        at += key_size + size + sum(value[0] for value in inside)


def _numbers(data: bytes, at: int) -> tuple[int, str, str]:
    """An array of numbers."""
    head, count = (3, int.from_bytes(data[at + 1 : at + 3], "big")) if data[at] == 0xDC else (1, data[at] & 15)
    size, meanings = head, []
    for _ in range(count):
        item_size, _, meaning = _scalar(data, at + size)
        size += item_size
        meanings.append(meaning)
    return size, data[at : at + size].hex(" "), f"[{', '.join(meanings)}]"


def _scalar(data: bytes, at: int) -> tuple[int, str, str]:
    first = data[at]
    if first >> 5 == 0b101 or first == 0xD9:
        head = 1 if first != 0xD9 else 2
        count = first & 31 if head == 1 else data[at + 1]
        text = data[at + head : at + head + count]
        return head + count, data[at : at + head + count].hex(" "), json.dumps(text.decode())
    if first in (0xC4, 0xC5, 0xC6):
        head = 1 + (1 << (first - 0xC4))
        count = int.from_bytes(data[at + 1 : at + head], "big")
        shown = f"{data[at : at + head].hex(' ')} {_repeated(data[at + head : at + head + count])}"
        return head + count, shown, f"{count} bytes"
    if first in _NUMBERS:
        form = _NUMBERS[first]
        size = 1 + struct.calcsize(form)
        return size, data[at : at + size].hex(" "), str(struct.unpack(form, data[at + 1 : at + size])[0])
    if first in _SINGLE or first < 0x80:
        return 1, f"{first:02x}", _SINGLE.get(first, str(first))
    raise ValueError(f"byte {first:#x} begins no value of this protocol's examples")


def _repeated(data: bytes) -> str:
    if len(data) <= _SHOWN_BYTES:
        return data.hex(" ")
    for period in range(1, _SHOWN_BYTES + 1):
        count, rest = divmod(len(data), period)
        if rest == 0 and data[:period] * count == data:
            return f"({data[:period].hex(' ')}) x {count}"
    raise ValueError("data of an example must repeat itself, so that the page can show all of it")

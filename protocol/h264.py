"""Validates H.264 pictures (ITU-T H.264, Annex B) before a decoder reads them.

A picture is refused if its size is not the declared one, if it uses a feature that live video does not need
(interlacing, more than 8 bits, B pictures), or if its reference picture was not received.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import islice

from protocol.codec import ProtocolError

MAX_UNITS = 64
"""NAL units of one picture."""
SLICE, KEY_SLICE, EXTRA, SEQUENCE, PICTURE, DELIMITER, FILLER = 1, 5, 6, 7, 8, 9, 12
PROFILES = {66: "Baseline", 77: "Main", 100: "High"}
MISSING = "color.data rests on a picture that was not read: send a key picture"
_HIGH = 100
_P, _I = 0, 2
_REFERENCE = 0x60
"""nal_ref_idc: the picture may be a reference."""
_START = re.compile(b"\x00\x00\x01")
_HEADER_BYTES = 64
"""Bytes of a unit that are read; all header fields lie within."""


@dataclass(frozen=True)
class Sequence:
    """Fields of a sequence parameter set (7.3.2.1.1)."""

    width: int
    height: int
    frame_numbers: int
    """frame_num is modulo this number."""


class VideoOrder:
    """Checks for one stream whether each picture can be decoded. Must receive every picture in order."""

    def __init__(self) -> None:
        self._sequence: Sequence | None = None
        self._reference = 0
        """frame_num of the last reference picture."""

    def begin_anew(self) -> None:
        """Reset after the decoder has lost its state: only a key picture is accepted next."""
        self._sequence = None

    def admit(self, data: bytes, width: int, height: int) -> bool:
        """Check one picture of this size and return whether it is a key picture. Raises ProtocolError.

        After a refused picture only a key picture is accepted.
        """
        try:
            return self._admit(data, (width, height))
        except ProtocolError:
            self.begin_anew()
            raise

    def _admit(self, data: bytes, size: tuple[int, int]) -> bool:
        units = units_of(data)
        slices = [unit for unit in units if unit[0] & 31 in (SLICE, KEY_SLICE)]
        is_key = is_key_picture(data)
        if is_key:
            self._sequence = _only_sequence(units)
        elif any(unit[0] & 31 in (SEQUENCE, PICTURE) for unit in units):
            raise ProtocolError("color.data changes H.264's parameters between key pictures")
        sequence = self._sequence
        if sequence is None:
            raise ProtocolError(MISSING)
        if (sequence.width, sequence.height) != size:
            found = f"color.data is video of {sequence.width}x{sequence.height}"
            raise ProtocolError(f"{found}, color declares {size[0]}x{size[1]}")
        number = _frame_number(slices, sequence, is_key)
        if number != (0 if is_key else (self._reference + 1) % sequence.frame_numbers):
            raise ProtocolError(MISSING)
        if slices[0][0] & _REFERENCE or is_key:
            self._reference = number
        return is_key


def units_of(data: bytes) -> list[bytes]:
    """NAL units, each with its header byte first. Raises ProtocolError."""
    starts = [(found.start(), found.end()) for found in islice(_START.finditer(data), MAX_UNITS + 1)]
    if not starts or data[: starts[0][0]].strip(b"\x00"):
        raise ProtocolError("color.data is not H.264 with start codes (Annex B)")
    if len(starts) > MAX_UNITS:
        raise ProtocolError(f"color.data has more than {MAX_UNITS} NAL units: send one picture at a time")
    ends = [start for start, _ in starts[1:]] + [len(data)]
    units = [data[start:end].rstrip(b"\x00") for (_, start), end in zip(starts, ends, strict=True)]
    if not all(units):
        raise ProtocolError("color.data has an empty NAL unit")
    for unit in units:
        if unit[0] & 31 not in (SLICE, KEY_SLICE, EXTRA, SEQUENCE, PICTURE, DELIMITER, FILLER):
            raise ProtocolError(f"color.data has a NAL unit of type {unit[0] & 31}, which live video does not need")
    return units


def is_key_picture(data: bytes) -> bool:
    """Whether decoding may start with this picture."""
    return any(data[found.end()] & 31 == KEY_SLICE for found in _START.finditer(data, 0, len(data) - 1))


def sequence_of(unit: bytes) -> Sequence:
    """Parse a sequence parameter set. Raises ProtocolError."""
    bits = _Bits(unit)
    profile = bits.take(8)
    bits.take(16)  # constraints, level
    bits.number()
    if profile not in PROFILES:
        raise ProtocolError(f"color.data is H.264 of profile {profile}, must be {', '.join(PROFILES.values())}")
    if profile == _HIGH and (bits.number(), bits.number(), bits.number(), bits.take(2)) != (1, 0, 0, 0):
        raise ProtocolError("color.data is H.264 that is not 4:2:0 of 8 bits with flat scaling")
    frame_numbers = 1 << (4 + bits.number(12))
    _skip_order(bits)
    bits.number(16)
    bits.take(1)
    width, height = 16 * (bits.number(1 << 10) + 1), 16 * (bits.number(1 << 10) + 1)
    if not bits.take(1):
        raise ProtocolError("color.data is interlaced video")
    bits.take(1)
    left, right, top, bottom = (2 * bits.number(1 << 10) for _ in range(4)) if bits.take(1) else (0, 0, 0, 0)
    return Sequence(width - left - right, height - top - bottom, frame_numbers)


def _skip_order(bits: _Bits) -> None:
    """Skip the picture order count fields; pictures are shown in the order received."""
    kind = bits.number(2)
    if kind == 0:
        bits.number(12)
    elif kind == 1:
        bits.take(1)
        for _ in range(2):
            bits.number()
        for _ in range(bits.number(255)):
            bits.number()


def _only_sequence(units: list[bytes]) -> Sequence:
    found = [unit for unit in units if unit[0] & 31 == SEQUENCE]
    if len(found) != 1 or not any(unit[0] & 31 == PICTURE for unit in units):
        raise ProtocolError("color.data is a key picture without its one sequence and its picture parameter set")
    return sequence_of(found[0])


def _frame_number(slices: list[bytes], sequence: Sequence, is_key: bool) -> int:
    """frame_num of the picture to which the slices belong. Raises ProtocolError if they are not of one picture."""
    if not slices:
        raise ProtocolError("color.data holds no picture")
    numbers, begun = set(), -1
    for unit in slices:
        bits = _Bits(unit)
        first, kind, _ = bits.number(), bits.number(9), bits.number(255)
        if kind % 5 not in (_P, _I) or (unit[0] & 31 == KEY_SLICE) != is_key:
            raise ProtocolError("color.data has B or switching slices, or slices of several pictures")
        if (begun < 0) != (first == 0) or first <= begun:
            raise ProtocolError("color.data is not exactly one picture")
        begun = first
        numbers.add(bits.take(sequence.frame_numbers.bit_length() - 1))
    if len(numbers) != 1:
        raise ProtocolError("color.data is not exactly one picture")
    return numbers.pop()


class _Bits:
    """Reads a NAL unit's payload bit by bit (7.2, 9.1). Raises ProtocolError at its end."""

    def __init__(self, unit: bytes) -> None:
        payload = unit[1:_HEADER_BYTES].replace(b"\x00\x00\x03", b"\x00\x00")
        self._value, self._left = int.from_bytes(payload, "big"), 8 * len(payload)

    def take(self, count: int) -> int:
        """Unsigned integer of the given number of bits."""
        self._left -= count
        if self._left < 0:
            raise ProtocolError("color.data has a truncated H.264 header")
        return self._value >> self._left & ((1 << count) - 1)

    def number(self, most: int = 1 << 31) -> int:
        """Unsigned Exp-Golomb number; for a signed one, its code."""
        zeros = 0
        while not self.take(1):
            zeros += 1
            if zeros > 31:
                raise ProtocolError("color.data has a damaged H.264 header")
        value = (1 << zeros) - 1 + self.take(zeros)
        if value > most:
            raise ProtocolError(f"color.data has an H.264 header with {value} where at most {most} may be")
        return value

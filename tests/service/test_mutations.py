"""Messages that are nearly right are refused in one line that says what was wrong, and never end anything else."""

from __future__ import annotations

import logging
from collections import Counter

import msgpack
import pytest

from protocol.codec import ProtocolError, decode_client, encode
from protocol.limits import MAX_REASON_CHARS
from tests.protocol.samples import CLIENT
from tests.service.mutations import NESTED, Mutator, Nested, packed
from tests.service.wrong_messages import HELLO, after_control, serves_frames

MESSAGES, OVER_SOCKET = 2000, 60
SEEDS = [encode(message) for message in CLIENT.values()]


def test_mutations_are_the_same_for_the_same_seed_and_of_every_kind() -> None:
    first, again, other = ([Mutator(SEEDS, seed).next() for _ in range(1)] for seed in (1, 1, 2))
    assert first == again != other
    mutator, found = Mutator(SEEDS, 3), Counter()
    for _ in range(MESSAGES):
        try:
            decode_client(mutator.next())
        except ProtocolError as error:
            found[str(error).split()[4]] += 1
        else:
            found["accepted"] += 1
    assert found["accepted"] < MESSAGES / 4
    assert len(found) > 20  # ways to be wrong


def test_what_is_packed_is_what_another_library_packs() -> None:
    message = {"a": [1, -2.5, None, True, "ä"], "b": {"c": b"x" * 300}, "d": 2**64 - 1}
    assert msgpack.unpackb(packed(message)) == message


@pytest.mark.parametrize("seed", range(2))
def test_every_refusal_is_one_line_about_the_message(seed: int) -> None:
    mutator = Mutator(SEEDS, seed)
    for _ in range(MESSAGES):
        try:
            decode_client(mutator.next())
        except ProtocolError as error:
            line = str(error)
            assert line.startswith("not a valid message: ")
            assert line.isprintable()
            assert len(line) <= MAX_REASON_CHARS


def test_a_long_value_does_not_hide_the_field() -> None:
    fields = msgpack.unpackb(encode(CLIENT["quality"])) | {"preset": "x" * 5000}
    with pytest.raises(ProtocolError, match=r"`\$\.preset`$"):
        decode_client(packed(fields))


def test_what_is_nested_without_end_is_refused_like_all_else() -> None:
    fields = msgpack.unpackb(encode(CLIENT["quality"]))
    with pytest.raises(ProtocolError, match="preset"):
        decode_client(packed(fields | {"preset": Nested(NESTED)}))
    with pytest.raises(ProtocolError, match="nested too deeply"):
        decode_client(packed({"extra": Nested(50_000)} | fields))


def test_over_the_socket_each_is_answered_or_ends_with_a_code(dial, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.ERROR)
    good, mutator = dial(), Mutator(SEEDS, 5)
    good.greet()
    for number in range(OVER_SOCKET):
        wire = dial()
        if number % 2:
            wire.say(HELLO)
        wire.socket.send(mutator.next())
        assert after_control(wire) in (None, 1000, 1007, 1008, 4410)
        wire.hang_up()
    nested = dial()
    nested.socket.send(packed({"type": "hello", "extra": Nested(50_000)}))
    assert nested.ending()[0] == 1007
    assert serves_frames(good, 0)
    assert caplog.text == ""

"""Hostile bytes and failing pipelines: one clear line for who caused it, nothing for the others."""

import logging
import random

import msgpack
import msgspec
import pytest

from protocol.codec import encode
from protocol.frames import IDENTITY
from protocol.images import encode_color
from protocol.limits import MAX_MESSAGE_BYTES
from protocol.messages import Acknowledged, Dropped, Error
from tests.service.fakes import EXPLODE_MM, PATIENCE_S, frame_message, rgbd_frame
from tests.service.http import rows
from tests.service.wrong_messages import HELLO, after_control, serves_frames


def moved(by_m: float) -> list[float]:
    return [by_m if place == 3 else value for place, value in enumerate(IDENTITY)]


def altered(message, **changes) -> bytes:
    """A message with other fields, encoded by an independent library; None takes a field away."""
    fields = msgpack.unpackb(encode(message)) | changes
    return msgpack.packb({name: value for name, value in fields.items() if value != "absent"})


DAMAGED_FRAMES = 100
RANDOM = random.Random(1)
HOSTILE = {
    "empty": (b"", "valid message"),
    "random": (RANDOM.randbytes(1000), "valid message"),
    "truncated": (encode(HELLO)[:-10], "truncated"),
    "trailing bytes": (encode(HELLO) + b"\x00", "trailing"),
    "wrong tag": (altered(HELLO, type="hallo"), "$.type"),
    "no tag": (altered(HELLO, type="absent"), "type"),
    "no object": (msgpack.packb([1, 2, 3]), "object"),
    "unknown field": (altered(HELLO, extra=1), "extra"),
    "missing field": (altered(HELLO, camera="absent"), "camera"),
    "wrong type": (altered(HELLO, client=7), "$.client"),
    "not finite": (altered(HELLO, camera=msgpack.unpackb(encode(HELLO))["camera"] | {"fx": float("nan")}), "camera.fx"),
    "too big a picture": (
        altered(HELLO, camera=msgpack.unpackb(encode(HELLO))["camera"] | {"width": 10**6}),
        "camera.width",
    ),
    "4 GB array header": (b"\xdd\xff\xff\xff\xff", "valid message"),
    "deep nesting": (b"\x91" * 100_000, "valid message"),
    "utf-8 that is none": (altered(HELLO, client="abc").replace(b"\xa3abc", b"\xa3\xff\xfe\xfd"), "valid message"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_first_message_is_refused_by_field_and_others_are_served(dial, name) -> None:
    data, named = HOSTILE[name]
    good, bad = dial(), dial()
    good.greet()
    bad.socket.send(data)
    code, reason, messages = bad.ending()
    assert code == 1007
    assert named in messages[0].reason
    assert messages[0].fatal
    assert "Traceback" not in messages[0].reason
    assert messages[0].reason.startswith(reason)
    assert serves_frames(good, 0)


def test_text_message_is_refused(dial) -> None:
    wire = dial()
    wire.greet()
    wire.socket.send("hello")
    code, reason, messages = wire.ending()
    assert code == 1003
    assert "binary" in reason
    assert messages == [Error(reason=reason, fatal=True)]


def test_huge_message_closes_with_1009_and_others_are_served(dial) -> None:
    good, bad = dial(), dial()
    good.greet()
    bad.greet()
    bad.socket.send(bytes(MAX_MESSAGE_BYTES + 1))
    code, _, _ = bad.ending()
    assert code == 1009
    assert serves_frames(good, 0)


def test_garbage_in_a_session_ends_only_that_session(dial) -> None:
    good, bad = dial(), dial()
    good.greet()
    bad.greet()
    bad.socket.send(b"\xc1\xc1")
    assert bad.ending()[0] == 1007
    assert serves_frames(good, 0)


@pytest.mark.parametrize(
    ("data", "answer", "field"),
    [
        (altered(frame_message(7), world_from_camera=[0.0] * 15), Dropped, "$.world_from_camera"),
        (altered(frame_message(7), timestamp_s=float("inf")), Dropped, "frame.timestamp_s"),
        (altered(frame_message(7), world_from_camera=[-1.0, *IDENTITY[1:]]), Dropped, "not a rotation"),
        (altered(frame_message(7), world_from_camera=moved(1e5)), Dropped, "moves by 100000 m"),
        (msgpack.packb({"type": "quality", "request": 7, "preset": "best"}), Acknowledged, "$.preset"),
        (msgpack.packb({"type": "remove_object", "request": 7, "object": "x" * 65}), Acknowledged, "$.object"),
    ],
)
def test_wrong_field_of_a_known_frame_or_request_is_answered_and_the_session_lives(
    server, dial, data, answer, field
) -> None:
    wire = dial()
    wire.greet()
    wire.socket.send(data)
    message = wire.hear()
    assert isinstance(message, answer)
    text = message.reason if answer is Dropped else message.error
    assert field in text
    assert rows(server)["probeless_frames_dropped_total", "invalid"] == (answer is Dropped)
    assert (message.frame if answer is Dropped else message.request) == 7
    assert serves_frames(wire, 8)


def damaged(data: bytes, random_: random.Random) -> bytes:
    """The bytes with a few of them changed, and now and then cut short."""
    damaged_ = bytearray(data)
    for _ in range(random_.randint(1, 4)):
        damaged_[random_.randrange(len(damaged_))] = random_.randrange(256)
    return bytes(damaged_[: random_.randint(1, len(damaged_))] if random_.random() < 0.2 else damaged_)


def test_randomly_damaged_frames_never_break_the_server(dial, caplog) -> None:
    caplog.set_level(logging.ERROR)
    random_ = random.Random(2)
    jpeg = msgspec.structs.replace(frame_message(3), color=encode_color(rgbd_frame(3).color, "jpeg"))
    good = dial()
    good.greet()
    for _ in range(DAMAGED_FRAMES):
        wire = dial()
        wire.greet()
        wire.socket.send(damaged(encode(random_.choice([jpeg, frame_message(3)])), random_))
        assert after_control(wire) in (None, 1007, 1008)
        wire.hang_up()
    assert serves_frames(good, 0)
    assert caplog.text == ""


def test_failing_pipeline_ends_its_session_only(dial, lab, caplog) -> None:
    caplog.set_level(logging.ERROR)
    good, bad = dial(), dial()
    good.greet()
    bad.greet()
    bad.say(frame_message(0, EXPLODE_MM))
    code, reason, messages = bad.ending()
    assert code == 1011
    assert messages == [Error(reason=reason, fatal=True)]
    assert "secret" not in reason
    assert lab.closed.wait(PATIENCE_S)
    assert "secret internals" in caplog.text
    assert "Traceback" in caplog.text
    assert serves_frames(good, 1)
    dial().greet()


def test_client_that_vanishes_mid_frame_frees_its_pipeline(dial, lab) -> None:
    lab.hold = True
    wire = dial()
    wire.greet()
    wire.say(frame_message(0))
    lab.next_entered()
    wire.socket.socket.close()
    lab.release()
    assert lab.closed.wait(PATIENCE_S)
    lab.hold = False
    other = dial()
    other.greet()
    assert serves_frames(other, 1)

"""A capturing session over a real socket: answers, latest-wins, control messages, refused frames."""

import threading

import msgspec
import numpy as np
import pytest

from protocol.images import decode_color, encode_color
from protocol.messages import (
    Acknowledged,
    ColorImage,
    Composite,
    DepthImage,
    Dropped,
    Error,
    Light,
    MoveObject,
    PlaceObject,
    Quality,
    RemoveObject,
    Spot,
)
from server.scene.placement import SpotPlacement
from server.service import frame_reader, mailbox, worker
from tests.service.fakes import CAMERA, PATIENCE_S, POSE, REFUSE_MM, FakePipeline, fake_light, frame_message, rgbd_frame


def test_frame_is_answered_by_its_light_and_then_its_composite(dial) -> None:
    wire = dial()
    assert wire.greet().max_inflight == 2
    wire.say(frame_message(5))
    light, composite = wire.hear(), wire.hear()
    assert light == fake_light(rgbd_frame(5))
    assert isinstance(composite, Composite)
    assert (composite.frame, composite.timestamp_s) == (5, 5 / 30)
    assert composite.color.codec == "jpeg"
    assert composite.world_from_camera == tuple(POSE.ravel())
    assert composite.timings.rendering == 3.25
    assert composite.plan.run == ("composite",)
    assert composite.notes == ("one note",)
    negative = 255 - rgbd_frame(5).color
    sent_as_jpeg = decode_color(encode_color(negative, "jpeg", quality=90), CAMERA)
    np.testing.assert_array_equal(decode_color(composite.color, CAMERA), sent_as_jpeg)


def test_lossless_answers_every_frame_in_order_with_exact_pixels(dial, lab) -> None:
    lab.hold = True
    wire = dial()
    wire.greet(lossless=True)
    wire.say(*(frame_message(i) for i in range(4)))
    lab.release(4)
    for i in range(4):
        light, composite = wire.hear(), wire.hear()
        assert isinstance(light, Light)
        assert (light.frame, composite.frame) == (i, i)
        assert composite.color.codec == "png"
        np.testing.assert_array_equal(decode_color(composite.color, CAMERA), 255 - rgbd_frame(i).color)


def test_a_frame_is_computed_while_the_answer_before_it_is_encoded(dial, lab, monkeypatch) -> None:
    """Even if it comes while that is being encoded. Answers keep their order, and what was done in between is
    acknowledged after both."""
    is_computed, encode = threading.Event(), worker.composite_message

    def encode_late(*arguments, **options):
        assert is_computed.wait(PATIENCE_S)
        return encode(*arguments, **options)

    monkeypatch.setattr(worker, "composite_message", encode_late)
    wire = dial()
    wire.greet()
    wire.say(frame_message(0))
    answers = [wire.hear()]  # the light, after which the picture is encoded
    wire.say(frame_message(1), Quality(request=1, preset="reg4"))
    assert [lab.next_entered(), lab.next_entered()] == [0, 1]
    is_computed.set()
    answers += [wire.hear() for _ in range(4)]
    assert [type(answer) for answer in answers] == [Light, Composite, Light, Composite, Acknowledged]
    assert [answer.frame for answer in answers[:4]] == [0, 0, 1, 1]


@pytest.mark.parametrize("next_fails", [False, True])
def test_an_answer_that_fails_ends_its_session_and_is_logged(dial, monkeypatch, caplog, next_fails: bool) -> None:
    """Also where the frame that was computed meanwhile has failed before."""
    has_failed = threading.Event()

    def fail(*_arguments, **_options):
        assert not next_fails or has_failed.wait(PATIENCE_S)
        raise RuntimeError("no such codec")

    process = FakePipeline.process

    def process_and_tell(pipeline, frame, **options):
        if frame.index == 1:
            has_failed.set()
            raise RuntimeError("no such frame")
        return process(pipeline, frame, **options)

    monkeypatch.setattr(worker, "composite_message", fail)
    monkeypatch.setattr(FakePipeline, "process", process_and_tell)
    wire = dial()
    wire.greet()
    wire.say(*(frame_message(i) for i in range(1 + next_fails)))
    code, reason, _ = wire.ending()
    assert (code, reason) == (1011, "the server failed in this session; its log says why")
    assert "no such codec" in caplog.text
    assert ("no such frame" in caplog.text) == next_fails


def test_a_frame_is_read_while_the_one_before_it_is_computed(dial, lab, monkeypatch) -> None:
    is_read, decode = threading.Semaphore(0), frame_reader.decode_depth

    def decode_and_tell(*arguments):
        is_read.release()
        return decode(*arguments)

    monkeypatch.setattr(frame_reader, "decode_depth", decode_and_tell)
    lab.hold = True
    wire = dial()
    wire.greet()
    wire.say(frame_message(0))
    assert lab.next_entered() == 0
    wire.say(frame_message(1))
    assert all(is_read.acquire(timeout=PATIENCE_S) for _ in range(2))
    lab.release(2)
    assert [wire.hear().frame for _ in range(4)] == [0, 0, 1, 1]
    assert not is_read.acquire(blocking=False)


def test_newer_frame_replaces_the_one_that_waits(dial, lab) -> None:
    lab.hold = True
    wire = dial()
    wire.greet()
    wire.say(frame_message(0))
    assert lab.next_entered() == 0
    wire.say(*(frame_message(i) for i in (1, 2, 3)))
    assert wire.hear() == Dropped(frame=1, reason="replaced by a newer frame")
    assert wire.hear() == Dropped(frame=2, reason="replaced by a newer frame")
    lab.release(2)
    assert [type(wire.hear()) for _ in range(4)] == [Light, Composite, Light, Composite]
    assert lab.log == [("frame", 0), ("frame", 3)]


def test_control_messages_are_never_dropped_and_precede_later_frames(dial, lab) -> None:
    lab.hold = True
    wire = dial()
    wire.greet()
    wire.say(frame_message(0))
    lab.next_entered()
    wire.say(
        PlaceObject(request=1, object="chair", format="glb", data=b"mesh", position_m=(1.0, 2.0, 3.0), yaw_deg=30.0),
        frame_message(1),
        MoveObject(request=2, object="chair", position_m=(0.0, 0.0, 1.0), scale=2.0),
        frame_message(2),
        Quality(request=3, preset="rm"),
        RemoveObject(request=4, object="chair"),
        frame_message(3),
    )
    assert [wire.hear().frame for _ in range(2)] == [1, 2]
    lab.release(2)
    answers = wire.hear_until(Composite) + wire.hear_until(Composite)
    acknowledged = [a for a in answers if isinstance(a, Acknowledged)]
    assert [a.request for a in acknowledged] == [1, 2, 3, 4]
    assert all(a.error is None for a in acknowledged)
    assert acknowledged[0].notes == ("chair has no texture",)
    asked = [(entry[0], entry[1]) for entry in lab.log]
    assert asked == [
        ("frame", 0),
        ("place", "chair"),
        ("move", "chair"),
        ("preset", "rm"),
        ("remove", "chair"),
        ("frame", 3),
    ]
    _, _, mesh, placement = lab.log[1]
    assert mesh == ("glb", b"mesh")
    assert (placement.position_m, placement.scale, placement.yaw_deg) == ((1.0, 2.0, 3.0), 1.0, 30.0)


def test_a_spot_is_passed_on_and_a_bad_one_refused(dial, lab) -> None:
    wire = dial()
    wire.greet()
    spot = Spot(on="pixel", pixel=(3.0, 4.0), frame=7)
    wire.say(PlaceObject(request=1, object="chair", format="glb", data=b"mesh", spot=spot, scale=2.0, yaw_deg=30.0))
    wire.say(PlaceObject(request=2, object="vase", format="glb", data=b"mesh", spot=Spot(on="auto")))
    wire.say(PlaceObject(request=4, object="cup", format="glb", data=b"mesh", spot=Spot(on="auto"), height_m=0.25))
    assert [wire.hear().error for _ in range(3)] == [None] * 3
    assert lab.log[0][3] == SpotPlacement(spot, 2.0, 30.0)
    assert lab.log[1][3] == SpotPlacement(Spot(on="auto"), None, 0.0)  # its size is chosen
    assert lab.log[2][3] == SpotPlacement(Spot(on="auto"), 0.25, 0.0)
    place = {"type": "place_object", "request": 3, "object": "junk", "format": "glb", "data": b"mesh"}
    for wrong, words in (
        ({"spot": {"on": "pixel"}}, "spot.pixel is needed"),
        ({"spot": {"on": "table", "pixel": [1.0, 2.0]}}, "spot.pixel is needed on a pixel"),
        ({"spot": {"on": "ray", "origin_m": [0.0, 0.0, 0.0]}}, "spot.origin_m and spot.direction are needed"),
        ({"spot": {"on": "ray", "origin_m": [0, 0, 0], "direction": [0, 0, 0]}}, "direction must not be zero"),
        ({"spot": {"on": "shelf"}}, "Invalid enum value 'shelf'"),
        ({"spot": {"on": "floor"}, "position_m": [0.0, 0.0, 1.0]}, "leave one out"),
        ({"height_m": 0.3}, "height_m needs a position_m or a spot"),
        ({"spot": {"on": "floor"}, "height_m": 0.0}, "height_m"),
    ):
        wire.socket.send(msgspec.msgpack.encode(place | wrong))
        assert words in wire.hear().error


def test_reading_stops_while_too_much_is_unread_and_goes_on_later(dial, lab, monkeypatch) -> None:
    lab.hold = True
    monkeypatch.setattr(mailbox, "MAX_QUEUED_MESSAGES", 4)
    unread: list[int] = []
    post = mailbox.Mailbox.post

    def post_and_count(self: mailbox.Mailbox, message: mailbox.Control) -> mailbox.Receipt:
        receipt = post(self, message)
        unread.append(len(self._messages))
        return receipt

    monkeypatch.setattr(mailbox.Mailbox, "post", post_and_count)
    wire = dial()
    wire.greet()
    wire.say(frame_message(0))
    lab.next_entered()
    wire.say(*(Quality(request=i, preset="rm") for i in range(40)))
    lab.release()
    answers = wire.hear_until(Composite) + [wire.hear() for _ in range(40)]
    assert [a.request for a in answers[2:]] == list(range(40))
    assert max(unread) == 4


@pytest.mark.parametrize(
    ("message", "error"),
    [
        (MoveObject(request=9, object="ghost", position_m=(0.0, 0.0, 0.0)), "no object 'ghost'"),
        (RemoveObject(request=9, object="ghost"), "no object 'ghost'"),
        (PlaceObject(request=9, object="junk", format="glb", data=b"no mesh"), "no GLB"),
    ],
)
def test_control_that_cannot_be_done_is_said_and_the_session_lives(dial, message, error) -> None:
    wire = dial()
    wire.greet()
    wire.say(message, frame_message(0))
    answer = wire.hear()
    assert answer.request == 9
    assert error in answer.error
    assert isinstance(wire.hear_until(Composite)[-1], Composite)


def unreadable_frames() -> list:
    good = frame_message(0)
    jpeg = msgspec.structs.replace(good.color, codec="jpeg", data=b"\xff\xd8\xff\xe0 not a picture")
    short = msgspec.structs.replace(good.color, data=good.color.data[:-1])
    small = ColorImage(width=8, height=8, data=bytes(192), codec="raw")
    depth = DepthImage(width=48, height=32, data=good.depth.data[: len(good.depth.data) // 2], codec="zstd-delta")
    return [
        pytest.param(msgspec.structs.replace(good, color=jpeg), "color", id="jpeg that is none"),
        pytest.param(msgspec.structs.replace(good, color=short), "color.data", id="raw colour too short"),
        pytest.param(msgspec.structs.replace(good, color=small), "color is 8x8", id="another camera's size"),
        pytest.param(msgspec.structs.replace(good, depth=depth), "depth", id="truncated depth"),
    ]


@pytest.mark.parametrize(("frame", "field"), unreadable_frames())
def test_unreadable_frame_is_dropped_with_its_field_and_the_session_lives(dial, lab, frame, field) -> None:
    wire = dial()
    wire.greet()
    wire.say(frame)
    dropped = wire.hear()
    assert isinstance(dropped, Dropped)
    assert dropped.frame == 0
    assert field in dropped.reason
    wire.say(frame_message(1))
    assert wire.hear_until(Composite)[-1].frame == 1
    assert lab.log == [("frame", 1)]


def test_frame_the_pipeline_refuses_is_dropped_with_its_reason(dial) -> None:
    wire = dial()
    wire.greet(lossless=True)
    wire.say(frame_message(0), frame_message(1, REFUSE_MM), frame_message(2))
    answers = [*wire.hear_until(Composite), wire.hear(), *wire.hear_until(Composite)]
    assert answers[2] == Dropped(frame=1, reason="no depth in this frame: point the camera at something")
    assert [a.frame for a in answers] == [0, 0, 1, 2, 2]


@pytest.mark.parametrize("lossless", [False, True])
def test_client_far_beyond_its_window_is_told_once(dial, lab, lossless) -> None:
    lab.hold = True
    wire = dial()
    wire.greet(lossless=lossless)
    wire.say(frame_message(0))
    lab.next_entered()
    wire.say(*(frame_message(i) for i in range(1, 20)))
    lab.release(20)
    answers = wire.hear_until(Composite)
    while answers[-1].frame != 19:
        answers += wire.hear_until(Composite)
    told = [a for a in answers if isinstance(a, Error)]
    assert len(told) == 1
    assert not told[0].fatal
    assert "at most 2" in told[0].reason
    finished = {a.frame for a in answers if isinstance(a, Composite | Dropped)}
    assert finished == set(range(20))

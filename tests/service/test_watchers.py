"""Watching clients: whom they see, what they get, and that a slow one slows nobody."""

import asyncio
import threading

import msgpack
import pytest
from msgspec.structs import replace

from protocol.frames import CameraModel
from protocol.images import encode_color, encode_depth
from protocol.messages import (
    Acknowledged,
    Bye,
    Composite,
    Frame,
    Hello,
    Light,
    MoveObject,
    PlaceObject,
    Quality,
    RemoveObject,
    Spot,
    Watch,
    Welcome,
)
from server.service import worker
from server.service.broadcast import Broadcast, Watcher
from server.service.edge.connection import Refusal
from server.service.mailbox import Mailbox, WatcherRequest
from tests.service.fakes import CAMERA, PATIENCE_S, frame_message, rgbd_frame
from tests.service.wire import Wire


def test_watcher_of_the_current_session_gets_light_and_composite(dial) -> None:
    camera, watcher = dial(), dial()
    session = camera.greet().session
    assert watcher.watch().session == session
    camera.say(frame_message(3))
    light, composite = watcher.hear(), watcher.hear()
    assert isinstance(light, Light)
    assert isinstance(composite, Composite)
    assert (light.frame, composite.frame, composite.color.codec) == (3, 3, "jpeg")


def test_watcher_of_a_lossless_session_gets_jpeg(dial) -> None:
    camera, watcher = dial(), dial()
    camera.greet(lossless=True)
    watcher.watch()
    camera.say(frame_message(3))
    assert camera.hear_until(Composite)[-1].color.codec == "png"
    assert watcher.hear_until(Composite)[-1].color.codec == "jpeg"


def test_watcher_that_came_first_is_attached_to_the_next_session_and_to_its_successor(dial) -> None:
    watcher, first = dial(), dial()
    assert watcher.watch().session == "waiting"
    session = first.greet().session
    assert watcher.hear().session == session
    first.say(frame_message(1))
    assert watcher.hear_until(Composite)[-1].frame == 1
    first.say(Bye())
    second = dial()
    assert watcher_sees(watcher, second.greet().session)
    second.say(frame_message(2))
    assert watcher.hear_until(Composite)[-1].frame == 2


def watcher_sees(watcher, session: str) -> bool:
    """The watcher's next welcome is of this session."""
    return watcher.hear_until(Welcome)[-1].session == session


def test_named_session_is_watched_to_its_end(dial) -> None:
    camera, other, watcher = dial(), dial(), dial()
    name = camera.greet().session
    other.greet()
    assert watcher.watch(name).session == name
    other.say(frame_message(1))
    other.hear_until(Composite)
    camera.say(frame_message(2))
    assert watcher.hear_until(Composite)[-1].frame == 2
    camera.say(Bye())
    code, _, messages = watcher.ending()
    assert code == 1000
    assert messages == [Bye(reason="the session is over")]


def test_unknown_session_is_refused_with_those_there_are(dial) -> None:
    camera, watcher = dial(), dial()
    name = camera.greet().session
    watcher.say(Watch(session="nobody"))
    code, reason, _ = watcher.ending()
    assert code == 1008
    assert "nobody" in reason
    assert name in reason


@pytest.mark.parametrize("message", [Quality(request=0, preset="rm"), frame_message(0)])
def test_watcher_may_send_no_frames_and_change_no_quality(dial, message) -> None:
    watcher = dial()
    watcher.watch()
    watcher.say(message)
    code, reason, _ = watcher.ending()
    assert code == 1008
    assert "a watching client sends requests for objects and bye, not" in reason


def test_watcher_places_moves_and_removes_in_the_session_that_it_sees(dial, lab) -> None:
    camera, watcher = dial(), dial()
    camera.greet()
    assert watcher.watch().camera == CAMERA
    asked = [
        PlaceObject(request=5, object="vase", format="glb", data=b"glb", spot=Spot(on="table")),
        MoveObject(request=6, object="vase", position_m=(1.0, 2.0, 3.0)),
        RemoveObject(request=7, object="vase"),
        RemoveObject(request=8, object="vase"),
    ]
    for message in asked:
        watcher.say(message)
    done = [watcher.hear_until(Acknowledged)[-1] for _ in asked]
    assert [each.request for each in done] == [5, 6, 7, 8]
    assert [each.error for each in done[:3]] == [None] * 3
    assert done[0].notes == ("vase has no texture",)
    assert "no object 'vase'" in (done[3].error or "")
    assert [entry[0] for entry in lab.log] == ["place", "move", "remove", "remove"]
    camera.say(frame_message(1))
    assert not any(isinstance(message, Acknowledged) for message in camera.hear_until(Composite))


def test_numbers_of_a_watcher_are_not_those_of_the_session(dial, lab) -> None:
    camera, watcher = dial(), dial()
    camera.greet()
    watcher.watch()
    place = PlaceObject(request=0, object="a", format="glb", data=b"glb", position_m=(0.0, 0.0, 0.0))
    camera.say(place)
    assert camera.hear_until(Acknowledged)[-1].error is None
    watcher.say(replace(place, object="b"))
    assert watcher.hear_until(Acknowledged)[-1].error is None
    assert [entry[1] for entry in lab.log if entry[0] == "place"] == ["a", "b"]


def test_watcher_of_nobody_is_told_that_there_is_no_session(dial) -> None:
    watcher = dial()
    watcher.watch()
    watcher.say(RemoveObject(request=1, object="vase"))
    assert watcher.hear_until(Acknowledged)[-1].error == "no session is streaming that could have objects"


def asking_during_a_frame(dial, lab) -> tuple[Wire, Wire]:
    """A camera whose frame is held, and a watcher that has asked for something meanwhile."""
    lab.hold = True
    camera, watcher = dial(), dial()
    camera.greet()
    watcher.watch()
    camera.say(frame_message(1))
    lab.next_entered()
    watcher.say(RemoveObject(request=1, object="vase"))
    return camera, watcher


def test_watcher_is_told_that_the_session_ended_before_its_request_was_read(dial, lab) -> None:
    camera, watcher = asking_during_a_frame(dial, lab)
    camera.say(Bye())
    lab.release()
    said = watcher.hear_until(Acknowledged)[-1].error
    assert said in ("the session has just ended", "no session is streaming that could have objects")


def test_watcher_is_told_where_an_answer_that_fails_ends_the_session(dial, lab, monkeypatch) -> None:
    """The worker has its request in hand then, and waits until the frame before is answered."""
    is_posted, is_awaited = threading.Event(), threading.Event()
    post, finish = Mailbox.post, worker.Worker._finish_delivery

    def post_and_tell(mailbox, message):
        receipt = post(mailbox, message)
        if isinstance(message, WatcherRequest):
            is_posted.set()
        return receipt

    def finish_and_tell(its_worker):
        if its_worker._delivery is not None:
            is_awaited.set()
        finish(its_worker)

    def fail(*_arguments, **_options):
        assert is_awaited.wait(PATIENCE_S)
        raise RuntimeError("no such codec")

    monkeypatch.setattr(Mailbox, "post", post_and_tell)
    monkeypatch.setattr(worker.Worker, "_finish_delivery", finish_and_tell)
    monkeypatch.setattr(worker, "composite_message", fail)
    _, watcher = asking_during_a_frame(dial, lab)
    assert is_posted.wait(PATIENCE_S)
    lab.release()
    assert watcher.hear_until(Acknowledged)[-1].error == "the session has just ended"


def test_watcher_that_leaves_with_a_request_under_way_disturbs_nobody(dial, lab) -> None:
    lab.hold = True
    camera, leaves, stays = dial(), dial(), dial()
    camera.greet()
    leaves.watch()
    stays.watch()
    camera.say(frame_message(1))
    lab.next_entered()
    leaves.say(RemoveObject(request=1, object="of the one that leaves"))
    leaves.hang_up()
    stays.say(RemoveObject(request=1, object="of the one that stays"))
    lab.release()
    assert stays.hear_until(Acknowledged)[-1].request == 1
    assert ("remove", "of the one that stays") in lab.log


def test_watcher_with_an_invalid_field_is_answered_and_stays(dial) -> None:
    camera, watcher = dial(), dial()
    camera.greet()
    watcher.watch()
    watcher.socket.send(msgpack.packb({"type": "remove_object", "request": 3, "object": ""}))
    assert watcher.hear_until(Acknowledged)[-1].request == 3
    watcher.say(RemoveObject(request=4, object="vase"))
    assert watcher.hear_until(Acknowledged)[-1].request == 4


def test_watcher_that_leaves_disturbs_nobody(dial) -> None:
    camera, leaves, stays = dial(), dial(), dial()
    camera.greet()
    leaves.watch()
    stays.watch()
    leaves.say(Bye())
    assert leaves.ending()[0] == 1000
    camera.say(frame_message(1))
    assert camera.hear_until(Composite)[-1].frame == 1
    assert stays.hear_until(Composite)[-1].frame == 1


def test_slow_watcher_slows_nobody_and_then_gets_the_newest(server, dial) -> None:
    frames = 40
    camera, quick = dial(), dial()
    big = CameraModel(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    camera.say(Hello(client="test", camera=big))
    camera.hear()
    slow = SleepyWatcher(server.url)
    quick.watch()
    for i in range(frames):
        camera.say(big_frame(i, big))
        assert camera.hear_until(Composite)[-1].frame == i
        assert quick.hear_until(Composite)[-1].frame == i
    seen = slow.wake_and_read_until(frames - 1)
    assert len(seen) < frames
    assert seen == sorted(seen)


class SleepyWatcher:
    """Watches with hardly any buffer and reads nothing until it is woken."""

    def __init__(self, url: str) -> None:
        self.wire = Wire(url, receive_buffer_bytes=4096)
        self.wire.watch()

    def wake_and_read_until(self, last: int) -> list[int]:
        """The frames it gets, up to `last`."""
        seen = [self.wire.hear_until(Composite)[-1].frame]
        while seen[-1] != last:
            seen.append(self.wire.hear_until(Composite)[-1].frame)
        self.wire.hang_up()
        return seen


def big_frame(index: int, camera: CameraModel) -> Frame:
    """A frame of noise whose composite's JPEG is hundreds of kilobytes."""
    frame = rgbd_frame(index, camera=camera)
    return Frame(
        frame=index,
        timestamp_s=frame.timestamp_s,
        world_from_camera=None,
        color=encode_color(frame.color, "jpeg"),
        depth=encode_depth(frame.depth, "raw"),
    )


def take_now(watcher: Watcher) -> tuple[bytes, ...]:
    """What a watcher can take without waiting long."""
    return asyncio.run(asyncio.wait_for(watcher.take(), PATIENCE_S))


def test_only_the_newest_pictures_wait_for_a_watcher() -> None:
    broadcast = Broadcast()
    broadcast.open_session("a", b"welcome a")
    with broadcast.watcher(None, b"waiting") as watcher:
        for i in range(5):
            broadcast.publish("a", (b"light %d" % i, b"composite %d" % i))
        broadcast.publish("b", (b"not for it",))
        assert take_now(watcher) == (b"welcome a", b"light 4", b"composite 4")


def test_pictures_of_the_session_before_are_not_mixed_with_the_next() -> None:
    broadcast = Broadcast()
    broadcast.open_session("a", b"welcome a")
    broadcast.open_session("b", b"welcome b")
    with broadcast.watcher(None, b"waiting") as watcher:
        broadcast.publish("b", (b"picture of b",))
        broadcast.close_session("b")
        assert take_now(watcher) == (b"welcome a",)


def test_watched_sessions_are_known() -> None:
    broadcast = Broadcast()
    broadcast.open_session("a", b"")
    assert not broadcast.is_watched("a")
    with broadcast.watcher("a", b""):
        assert broadcast.is_watched("a")
        assert not broadcast.is_watched("b")
    assert not broadcast.is_watched("a")
    with pytest.raises(Refusal, match="sessions now: a"), broadcast.watcher("b", b""):
        pass

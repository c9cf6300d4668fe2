"""The mailbox between two threads: latest frame wins, control messages keep their place."""

import threading
import time
from concurrent.futures import Future

import msgspec
import pytest

from protocol.messages import Frame, MoveObject, PlaceObject, Quality
from server.service.mailbox import MAX_QUEUED_BYTES, MAX_QUEUED_MESSAGES, Mailbox
from tests.service.fakes import PATIENCE_S, frame_message


def quality(request: int) -> Quality:
    return Quality(request=request, preset="reg4")


def drain(mailbox: Mailbox, count: int) -> list:
    return [mailbox.take().message for _ in range(count)]


def posted_while_one_is_worked_on(window: int | None, frames: list[Frame]) -> tuple[Mailbox, list]:
    """Post frames while the reader is busy with one: the mailbox and what each frame replaced."""
    mailbox = Mailbox(window)
    mailbox.post(frame_message(100))
    mailbox.take()
    return mailbox, [mailbox.post(frame).replaced for frame in frames]


def test_newer_frame_replaces_unread_older_one() -> None:
    frames = [frame_message(i) for i in range(3)]
    mailbox, replaced = posted_while_one_is_worked_on(2, frames)
    assert replaced == [None, frames[0], frames[1]]
    assert mailbox.take().message is frames[2]


def test_a_client_within_its_window_never_loses_a_frame() -> None:
    frames = [frame_message(i) for i in range(4)]
    mailbox, _ = posted_while_one_is_worked_on(2, frames[:1])
    mailbox.note_answered(0)  # and before the reader takes frames[0], the client sends another
    assert mailbox.post(frames[1]).replaced is None
    assert mailbox.take().message is frames[0]
    assert mailbox.post(frames[2]).replaced is frames[1]
    mailbox.note_answered(0)
    assert mailbox.post(frames[3]).replaced is None
    assert drain(mailbox, 2) == [frames[2], frames[3]]


def test_frames_of_a_lost_connection_are_neither_counted_nor_replaced() -> None:
    frames = [frame_message(i) for i in range(5)]
    mailbox, _ = posted_while_one_is_worked_on(2, frames[:1])
    mailbox.begin_connection()
    assert [mailbox.post(frame).replaced for frame in frames[1:4]] == [None, None, frames[1]]
    mailbox.note_answered(0)  # the one that was worked on: it was never of this window
    assert mailbox.post(frames[4]).replaced is frames[2]
    assert drain(mailbox, 3) == [frames[0], *frames[3:]]


def test_messages_of_two_connections_are_not_taken_together() -> None:
    mailbox = Mailbox(2)
    moves = [MoveObject(request=i, object="vase", position_m=(0, 0, i)) for i in range(4)]
    for move in moves[:2]:
        mailbox.post(move)
    mailbox.begin_connection()
    for move in moves[2:]:
        mailbox.post(move)
    assert mailbox.take().message is moves[0]
    assert mailbox.take_while(MoveObject) == moves[1:2]
    assert mailbox.take().message is moves[2]
    assert mailbox.take_while(MoveObject) == moves[3:]


def test_lossless_keeps_every_frame_in_order() -> None:
    mailbox = Mailbox(None)
    frames = [frame_message(i) for i in range(5)]
    assert all(mailbox.post(frame).replaced is None for frame in frames)
    assert drain(mailbox, 5) == frames


def test_control_messages_survive_replacement_and_precede_later_frames() -> None:
    old, new = frame_message(0), frame_message(1)
    mailbox, _ = posted_while_one_is_worked_on(2, [])
    for message in (quality(1), old, quality(2), new, quality(3)):
        mailbox.post(message)
    assert drain(mailbox, 4) == [quality(1), quality(2), new, quality(3)]


def test_frames_ahead_counts_what_came_since_the_worker_took_one() -> None:
    mailbox = Mailbox(2)
    assert [mailbox.post(frame_message(i)).frames_ahead for i in range(3)] == [1, 2, 3]
    mailbox.take()
    assert mailbox.post(frame_message(3)).frames_ahead == 2  # it, and one that was unread already


def test_frames_ahead_counts_what_waits_when_lossless() -> None:
    mailbox = Mailbox(None)
    for i in range(3):
        mailbox.post(frame_message(i))
    mailbox.take()
    assert mailbox.post(frame_message(3)).frames_ahead == 3


def test_take_waits_for_a_letter() -> None:
    mailbox, taken = Mailbox(2), []
    thread = threading.Thread(target=lambda: taken.append(mailbox.take().message))
    thread.start()
    mailbox.post(quality(7))
    thread.join(PATIENCE_S)
    assert taken == [quality(7)]


@pytest.mark.parametrize("what_comes", ["a message", "the other", "closing"])
def test_a_reader_waits_for_a_message_or_something_else(what_comes: str) -> None:
    mailbox, other = Mailbox(2), Future()
    ways = {"a message": lambda: mailbox.post(quality(7)), "the other": lambda: other.set_result(None)}
    thread = threading.Thread(target=mailbox.wait_or, args=(other,))
    thread.start()
    thread.join(0.05)
    assert thread.is_alive()
    ways.get(what_comes, mailbox.close)()
    thread.join(PATIENCE_S)
    assert not thread.is_alive()


def test_close_lets_a_waiting_reader_go_and_forgets_letters() -> None:
    mailbox, taken = Mailbox(2), []
    thread = threading.Thread(target=lambda: taken.append(mailbox.take()))
    thread.start()
    mailbox.close()
    thread.join(PATIENCE_S)
    assert taken == [None]
    mailbox.post(quality(1))
    assert mailbox.take() is None


def test_room_is_bounded_by_count_and_by_bytes() -> None:
    mailbox = Mailbox(2)
    for request in range(MAX_QUEUED_MESSAGES):
        assert mailbox.has_room()
        mailbox.post(quality(request))
    assert not mailbox.has_room()
    mailbox.take()
    assert mailbox.has_room()

    mailbox = Mailbox(2)
    mesh = PlaceObject(request=0, object="a", format="glb", data=bytes(12 << 20))
    for _ in range(MAX_QUEUED_BYTES // (12 << 20)):
        assert mailbox.has_room()
        mailbox.post(mesh)
    assert not mailbox.has_room()


def test_replaced_frames_leave_no_bytes_behind() -> None:
    mailbox = Mailbox(2)
    frame = frame_message(0)
    for _ in range(2 * MAX_QUEUED_BYTES // len(frame.color.data)):
        mailbox.post(frame)
    assert mailbox.has_room()


def test_on_taken_is_called_for_each_letter() -> None:
    calls: list[int] = []
    mailbox = Mailbox(2, on_taken=lambda: calls.append(1))
    mailbox.post(quality(1))
    mailbox.post(quality(2))
    drain(mailbox, 2)
    assert len(calls) == 2


@pytest.mark.parametrize("window", [None, 1, 2])
def test_two_threads_lose_no_control_message_and_end_with_the_newest_frame(window: int | None) -> None:
    mailbox, taken = Mailbox(window), []
    frame = frame_message(0)

    def read() -> None:
        while (queued := mailbox.take()) is not None and queued.message != quality(999):
            taken.append(queued.message)
            if isinstance(queued.message, Frame):
                mailbox.note_answered(0)

    reader = threading.Thread(target=read)
    reader.start()
    replaced = []
    for i in range(999):
        mailbox.post(MoveObject(request=i, object="a", position_m=(0.0, 0.0, 0.0)))
        receipt = mailbox.post(msgspec.structs.replace(frame, frame=i))
        replaced += [receipt.replaced.frame] if receipt.replaced else []
    mailbox.post(quality(999))
    reader.join(PATIENCE_S)

    assert [m.request for m in taken if isinstance(m, MoveObject)] == list(range(999))
    read_frames = [m.frame for m in taken if isinstance(m, Frame)]
    assert read_frames[-1] == 998
    assert sorted(read_frames + replaced) == list(range(999))
    assert read_frames == sorted(read_frames)
    for i, message in enumerate(taken):
        if isinstance(message, Frame):  # its own move came before it
            assert MoveObject(request=message.frame, object="a", position_m=(0.0, 0.0, 0.0)) in taken[:i]


def test_more_of_a_kind_is_taken_only_as_far_as_it_is_next() -> None:
    taken: list[None] = []
    mailbox = Mailbox(2, on_taken=lambda: taken.append(None))
    moves = [MoveObject(request=request, object="vase", position_m=(0, 0, 1)) for request in range(4)]
    for message in (*moves[:3], quality(3), moves[3]):
        mailbox.post(message)
    assert mailbox.take().message is moves[0]
    assert mailbox.take_while(MoveObject) == moves[1:3]
    assert mailbox.take_while(MoveObject) == []
    assert drain(mailbox, 2) == [quality(3), moves[3]]
    assert mailbox.take_while(MoveObject) == []  # and waits for none
    assert len(taken) == 4


def test_it_is_idle_when_the_reader_waits_for_a_message() -> None:
    mailbox = Mailbox(2)
    assert mailbox.is_idle()
    mailbox.post(frame_message(0))
    assert not mailbox.is_idle()
    mailbox.take()
    assert not mailbox.is_idle()  # its answer may not have been sent yet
    reader = threading.Thread(target=mailbox.take)
    reader.start()
    deadline_s = time.monotonic() + PATIENCE_S
    while not mailbox.is_idle():
        assert time.monotonic() < deadline_s
    mailbox.close()
    reader.join(PATIENCE_S)

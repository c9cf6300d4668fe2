"""A connection that breaks ends nothing: the session waits, what was asked for is done once, and it goes on."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import pytest

from client.streaming.client import Answer, ClientError, RoomPlace, StreamClient
from protocol.limits import MOST_INFLIGHT
from protocol.messages import Acknowledged, Composite, Dropped, Hello, Light, MoveObject, PlaceObject, Welcome, Wishes
from server.service.serve import BackgroundServer
from tests.service.fakes import CAMERA, EXPLODE_MM, PATIENCE_S, Lab, frame_message, rgbd_frame
from tests.service.proxy import Proxy, impaired
from tests.service.wire import Wire

PLACE = PlaceObject(request=3, object="vase", format="ply", data=b"mesh", position_m=(0, 0, 1))


KEPT_S = 300.0
"""For how long a session waits for its client. A server that did not wait for that leaves far sooner on any machine."""


def greet(wire: Wire, **said: object) -> Welcome:
    wire.say(Hello(client="test", camera=CAMERA, **{"keep_s": 20.0} | said))
    welcome = wire.hear()
    assert isinstance(welcome, Welcome), welcome
    return welcome


@pytest.fixture
def proxy(server) -> Iterator[Proxy]:
    with impaired(server.url) as between:
        yield between


def placed(lab: Lab) -> list[str]:
    return [entry[1] for entry in lab.log if entry[0] == "place"]


def test_a_session_goes_on_by_another_connection(server, proxy: Proxy, lab: Lab) -> None:
    first = Wire(proxy.url)
    welcome = greet(first)
    assert welcome.key
    assert not welcome.resumed
    first.say(PLACE)
    assert isinstance(first.hear(), Acknowledged)
    first.say(frame_message(0))
    first.hear_until(Composite)
    proxy.cut()
    second = Wire(server.url)
    again = greet(second, resume=welcome.key)
    assert again.resumed
    assert again.session == welcome.session
    second.say(PLACE, frame_message(1))
    messages = second.hear_until(Composite)
    assert [m.request for m in messages if isinstance(m, Acknowledged)] == [3]
    assert messages[-1].frame == 1
    assert placed(lab) == ["vase"]  # done once, acknowledged twice
    assert server.service.sessions == 1
    second.hang_up()


def test_a_request_whose_acknowledgement_was_lost_is_not_done_again(server, proxy: Proxy, lab: Lab) -> None:
    first = Wire(proxy.url)
    welcome = greet(first)
    proxy.flows.clear()
    proxy.flows.set()
    first.say(PLACE)
    first.hear()
    lab.hold = True
    first.say(frame_message(0), MoveObject(request=4, object="vase", position_m=(0, 0, 2)))
    lab.next_entered()
    proxy.cut()
    lab.release(5)
    second = Wire(server.url)
    greet(second, resume=welcome.key)
    move = MoveObject(request=4, object="vase", position_m=(0, 0, 2))
    second.say(move, move)
    assert [second.hear_until(Acknowledged)[-1].request for _ in range(2)] == [4, 4]
    assert [entry[0] for entry in lab.log].count("move") == 1
    second.hang_up()


def test_a_client_that_keeps_to_its_window_loses_no_frame_after_a_resume(server, proxy: Proxy, lab: Lab) -> None:
    """Two frames and a request are on the way when the connection is cut: nothing of them is told to the next one."""
    first = Wire(proxy.url)
    welcome = greet(first)
    lab.hold = True
    move = MoveObject(request=1, object="vase", position_m=(0, 0, 2))
    first.say(frame_message(0), move, frame_message(1))
    lab.next_entered()
    until_queued(server, 2)
    proxy.cut()
    second = Wire(server.url)
    assert greet(second, resume=welcome.key).resumed
    unanswered = [2, 3]
    second.say(*map(frame_message, unanswered))
    until_queued(server, 4)
    lab.release(20)
    answered: list[int] = []
    while unanswered:
        light, composite = second.hear(), second.hear()
        assert isinstance(light, Light), light
        assert isinstance(composite, Composite), composite
        assert light.frame == composite.frame == unanswered.pop(0)
        answered.append(composite.frame)
        if (number := answered[-1] + 2) < 14:
            unanswered.append(number)
            second.say(frame_message(number))
    assert answered == list(range(2, 14))
    assert [entry[1] for entry in lab.log if entry[0] == "frame"] == list(range(14))  # what had arrived was worked on
    second.hang_up()


def until_queued(server: BackgroundServer, count: int) -> None:
    """Wait until so many messages wait for the session's worker."""
    (session,) = server.service._captures.values()
    until(lambda: len(session._mailbox._messages) >= count)


def until(is_so: Callable[[], bool]) -> None:
    """Wait for that."""
    end_s = time.monotonic() + PATIENCE_S
    while not is_so():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def test_a_window_is_kept_to_after_a_resume(server, proxy: Proxy, lab: Lab) -> None:
    """Who sends more than it allows is told so, of frames of this connection alone."""
    first = Wire(proxy.url)
    welcome = greet(first)
    lab.hold = True
    first.say(frame_message(0), frame_message(1))
    lab.next_entered()
    until_queued(server, 1)
    proxy.cut()
    second = Wire(server.url)
    greet(second, resume=welcome.key)
    second.say(*map(frame_message, (2, 3, 4)))
    dropped = second.hear()
    assert isinstance(dropped, Dropped)
    assert dropped.frame == 2
    lab.release(5)
    assert [second.hear_until(Composite)[-1].frame for _ in range(2)] == [3, 4]
    second.hang_up()


def test_a_client_that_does_not_come_back_is_let_go(server, proxy: Proxy, lab: Lab) -> None:
    wire = Wire(proxy.url)
    key = greet(wire, keep_s=0.3).key
    proxy.cut()
    assert lab.closed.wait(PATIENCE_S)
    code, reason, _ = resumed(server.url, key)
    assert code == 4410
    assert "no session with this key" in reason


def test_a_client_that_says_bye_is_not_waited_for(server, lab: Lab) -> None:
    wire = Wire(server.url)
    greet(wire)
    wire.hang_up()
    assert lab.closed.wait(PATIENCE_S)


def test_a_key_that_is_none_is_refused(server) -> None:
    code, reason, _ = resumed(server.url, "guessed")
    assert code == 4410
    assert "no session with this key" in reason


def resumed(url: str, key: str) -> tuple[int, str, list]:
    wire = Wire(url)
    wire.say(Hello(client="test", camera=CAMERA, resume=key))
    return wire.ending()


def test_one_that_has_moved_to_another_network_takes_its_session_along(server) -> None:
    """The old connection is half open: the server has not noticed yet that nobody is there."""
    old = Wire(server.url)
    welcome = greet(old)
    new = Wire(server.url)
    assert greet(new, resume=welcome.key).resumed
    code, reason, _ = old.ending()
    assert "by another connection" in reason
    assert code == 1008
    new.say(frame_message(0))
    new.hear_until(Composite)
    new.hang_up()


def test_watchers_see_no_break(server, proxy: Proxy) -> None:
    first = Wire(proxy.url)
    welcome = greet(first)
    watcher = Wire(server.url)
    assert watcher.watch().key is None
    proxy.cut()
    second = Wire(server.url)
    greet(second, resume=welcome.key)
    second.say(frame_message(5))
    assert watcher.hear_until(Composite)[-1].frame == 5
    second.hang_up()


async def streamed(url: str, proxy: Proxy, frames: int, cuts: set[int], wishes: Wishes) -> tuple[list, int]:
    client = await StreamClient.connect(url)
    await client.hello(CAMERA, wishes)
    taken: list = []

    async def read() -> None:
        async for answer in client.answers():
            taken.append(answer)

    reading = asyncio.create_task(read())
    for index in range(frames):
        await client.send_frame(rgbd_frame(index))
        if index in cuts:
            proxy.cut()
            done = await client.place_object(f"object-{index}", "ply", b"mesh")
            assert done.error is None
    await client.wait_until_answered()
    await client.close()
    await reading
    return taken, client.reconnected


@pytest.mark.parametrize("answer", ["picture", "layer", "light"])
@pytest.mark.parametrize("lossless", [False, True])
def test_the_client_comes_back_by_itself(proxy: Proxy, lab: Lab, lossless: bool, answer: str) -> None:
    cuts = {3, 7, 12}
    taken, reconnected = asyncio.run(streamed(proxy.url, proxy, 20, cuts, Wishes(lossless=lossless, answer=answer)))
    assert reconnected == 3
    assert sorted(placed(lab)) == sorted(f"object-{index}" for index in cuts)
    numbers = [a.light.frame if isinstance(a, Answer) else a.frame for a in taken]
    assert sorted(numbers) == list(range(20))  # each frame has one answer, or is told to be lost
    lost = [a for a in taken if isinstance(a, Dropped)]
    if lossless:
        assert not lost
        processed = [entry[1] for entry in lab.log if entry[0] == "frame"]
        assert processed == list(range(20))  # and was worked on once
    else:
        assert len(lost) <= 6
        assert {a.reason for a in lost} <= {
            "lost with the connection, which was restored",
            "replaced by a newer frame",
        }


@pytest.mark.parametrize("answer", ["picture", "layer", "light"])
def test_a_frame_that_is_sent_again_while_it_is_worked_on_is_answered_once(proxy: Proxy, lab: Lab, answer: str) -> None:
    lab.hold = True

    async def cut_while_it_works() -> list:
        client = await StreamClient.connect(proxy.url)
        await client.hello(CAMERA, Wishes(lossless=True, answer=answer))
        await client.send_frame(rgbd_frame(0))
        await asyncio.to_thread(lab.next_entered)
        proxy.cut()
        async with asyncio.timeout(PATIENCE_S):
            while client.reconnected == 0:
                await asyncio.sleep(0.01)
        lab.release(3)
        taken: list = []

        async def read() -> None:
            async for found in client.answers():
                taken.append(found)

        reading = asyncio.create_task(read())
        for index in (1, 2):
            await client.send_frame(rgbd_frame(index))
        await client.wait_until_answered()
        await client.close()
        await reading
        return taken

    taken = asyncio.run(cut_while_it_works())
    assert [found.light.frame for found in taken] == [0, 1, 2]
    assert [entry[1] for entry in lab.log if entry[0] == "frame"] == [0, 1, 2]


def test_a_whole_window_of_answers_that_were_lost_is_sent_again(server, proxy: Proxy, lab: Lab) -> None:
    first = Wire(proxy.url)
    welcome = greet(first, wishes=Wishes(lossless=True), max_inflight=MOST_INFLIGHT)
    frames = [frame_message(number) for number in range(MOST_INFLIGHT)]
    lab.hold = True
    first.say(*frames)
    lab.next_entered()
    until_queued(server, MOST_INFLIGHT - 1)
    proxy.flows.clear()  # no answer gets through
    lab.release(MOST_INFLIGHT)
    (session,) = server.service._captures.values()
    until(session._mailbox.is_idle)
    proxy.cut()
    second = Wire(server.url)
    greet(second, resume=welcome.key)
    second.say(*frames)
    answered = [second.hear_until(Composite)[-1].frame for _ in frames]
    assert answered == list(range(MOST_INFLIGHT))
    assert [entry[1] for entry in lab.log if entry[0] == "frame"] == answered  # each was worked on once
    second.hang_up()


def test_a_client_that_cannot_come_back_says_so(proxy: Proxy) -> None:
    async def stream() -> None:
        client = await StreamClient.connect(proxy.url)
        await client.hello(CAMERA, keep_s=0.4)
        proxy.refuses = True
        proxy.cut()
        await client.send_frame(rgbd_frame(0))
        with contextlib.suppress(asyncio.CancelledError):
            await client.wait_until_answered()

    with pytest.raises(ClientError, match="the connection was lost, and could not be restored"):
        asyncio.run(stream())


async def until_it_ends(client: StreamClient, lab: Lab, stop: Callable[[], None]) -> None:
    """A frame and a request are on the way, and answers are waited for, when the server stops. Raises ClientError."""
    lab.hold = True
    await client.send_frame(rgbd_frame(0))
    await asyncio.to_thread(lab.next_entered)
    placing = asyncio.create_task(client.place_object("vase", "ply", b"mesh"))
    reading = asyncio.create_task(anext(client.answers()))
    stopping = asyncio.create_task(asyncio.to_thread(stop))
    async with asyncio.timeout(PATIENCE_S):
        ended = await asyncio.gather(placing, reading, client.wait_until_answered(), return_exceptions=True)
    lab.release(10)
    await stopping
    assert [type(error) for error in ended] == [ClientError] * 3
    assert len({str(error) for error in ended}) == 1
    raise ended[0]


def test_a_session_without_a_room_ends_with_its_server_and_says_so(server, lab: Lab) -> None:
    """It has nothing to come back to: no try is made, however long it would have been kept."""

    async def stream() -> None:
        client = await StreamClient.connect(server.url)
        await client.hello(CAMERA, keep_s=300.0)
        try:
            await until_it_ends(client, lab, server.stop)
        finally:
            assert client.reconnected == 0
            await client.close()

    line = "the server is stopping: connect again in a while; a session without a room ends with its server"
    with pytest.raises(ClientError, match=line):
        asyncio.run(stream())


def test_a_client_in_a_room_goes_on_with_the_server_that_comes_after(start_server) -> None:
    rooms = {"room_factory": lambda _wishes, name: SimpleNamespace(name=name, key_digest=None, close=lambda: None)}
    first = start_server(**rooms)

    async def stream(between: Proxy) -> list[int]:
        client = await StreamClient.connect(between.url)
        await client.hello(CAMERA, room=RoomPlace("study"))
        await client.send_frame(rgbd_frame(0))
        await client.wait_until_answered()
        between.refuses = True
        await asyncio.to_thread(first.stop)
        between.lead_to(start_server(**rooms).url)
        between.refuses = False
        async with asyncio.timeout(PATIENCE_S):
            assert (await client.place_object("vase", "ply", b"mesh")).error is None
            await client.send_frame(rgbd_frame(1))
            await client.wait_until_answered()
        assert client.reconnected == 1
        await client.close()
        return [answer.composite.frame async for answer in client.answers() if isinstance(answer, Answer)]

    with impaired(first.url) as between:
        assert asyncio.run(stream(between)) == [0, 1]


def test_a_server_that_leaves_does_not_wait_for_a_client_that_is_away(server, proxy: Proxy, lab: Lab) -> None:
    wire = Wire(proxy.url)
    greet(wire, keep_s=KEPT_S)
    proxy.cut()
    time.sleep(0.2)
    started = time.monotonic()
    server.stop()
    assert lab.closed.is_set()
    assert time.monotonic() - started < KEPT_S


def test_a_session_that_is_ending_is_not_resumed(server, lab: Lab) -> None:
    """The worker fails while the client is on its way back: it is told so, and not left waiting."""
    old = Wire(server.url)
    key = greet(old).key
    lab.hold = True
    old.say(frame_message(0, EXPLODE_MM))
    lab.next_entered()
    new = Wire(server.url)
    new.say(Hello(client="test", camera=CAMERA, resume=key))
    lab.release(5)
    code, _, _ = new.ending()
    assert code in (1011, 4410)

"""Clients at the ingress: led to their rooms, led back to them, and told what goes wrong there."""

import time

from protocol.messages import Acknowledged, Composite, Hello, Quality, Watch, Welcome
from server.cluster.relay import MOVED
from server.cluster.routing import room_id_of
from server.service.edge.connection import GONE, RESTART, TRY_LATER, UNAUTHORIZED
from tests.cluster.conftest import IMPATIENT_S
from tests.service.fakes import CAMERA, PATIENCE_S, frame_message


def greeted(wire, **said) -> Welcome:
    wire.say(Hello(client="test", camera=CAMERA, **said))
    message = wire.hear()
    assert isinstance(message, Welcome), message
    return message


def answered(wire, index: int) -> bool:
    wire.say(frame_message(index))
    return wire.hear_until(Composite)[-1].frame == index


def eventually(holds) -> bool:
    end_s = time.monotonic() + PATIENCE_S
    while not holds() and time.monotonic() < end_s:
        time.sleep(0.01)
    return holds()


def clients_of(town, name: str) -> int:
    return town.hosts[room_id_of(name)].status().clients


def test_clients_of_one_room_meet_and_those_of_another_do_not(town, dial) -> None:
    first, second, other = dial(), dial(), dial()
    greeted(first)
    greeted(second)
    greeted(other)
    assert len(town.hosts) == 3
    assert answered(first, 1)
    assert answered(other, 2)
    assert not any(host.status().clients > 1 for host in town.hosts.values())


def test_watcher_finds_the_session_by_its_name(town, dial) -> None:
    capturing, watcher = dial(), dial()
    welcome = greeted(capturing)
    watcher.say(Watch(session=welcome.session))
    assert watcher.hear().session == welcome.session
    assert answered(capturing, 5)
    assert watcher.hear_until(Composite)[-1].frame == 5
    assert len(town.hosts) == 1


def test_lost_client_comes_back_to_its_session(town, dial) -> None:
    wire = dial()
    welcome = greeted(wire, keep_s=30.0)
    assert answered(wire, 1)
    wire.socket.socket.close()
    again = dial()
    back = greeted(again, resume=welcome.key)
    assert back.resumed
    assert back.key == welcome.key
    assert answered(again, 2)
    assert len(town.hosts) == 1


def test_bye_ends_the_session_at_its_host(town, dial) -> None:
    wire = dial()
    greeted(wire, keep_s=30.0)
    host = next(iter(town.hosts.values()))
    assert host.status().clients == 1
    wire.socket.close()
    assert eventually(lambda: host.status().clients == 0)


def test_host_that_dies_sends_its_clients_to_come_again(town, dial) -> None:
    wire = dial()
    welcome = greeted(wire, keep_s=30.0)
    host = next(iter(town.hosts.values()))
    for connection in tuple(host._server._server.server_state.connections):
        connection.loop.call_soon_threadsafe(connection.transport.abort)
    code, reason, _ = wire.ending()
    assert (code, reason) == (RESTART, MOVED)
    town.hosts.clear()
    again = dial()
    again.say(Hello(client="test", camera=CAMERA, resume=welcome.key))
    assert again.ending()[0] == GONE
    host._server.stop()


def test_room_that_moves_is_waited_for_and_then_the_client_is_told(town, dial, ingress, monkeypatch) -> None:
    wire = dial()
    welcome = greeted(wire, keep_s=30.0)
    town.moving.update(town.hosts)
    patient = ingress._patience_s
    monkeypatch.setattr(ingress, "_patience_s", IMPATIENT_S)
    wire.socket.socket.close()
    late = dial()
    late.say(Hello(client="test", camera=CAMERA, resume=welcome.key))
    assert late.ending()[0] == TRY_LATER
    monkeypatch.setattr(ingress, "_patience_s", patient)
    soon = dial()
    soon.say(Hello(client="test", camera=CAMERA, resume=welcome.key))
    town.moving.clear()
    assert soon.hear().resumed


def test_one_room_too_many_is_told_to_come_later(town, dial, ingress, monkeypatch) -> None:
    town.free = 1
    greeted(dial())
    monkeypatch.setattr(ingress, "_patience_s", IMPATIENT_S)
    wire = dial()
    wire.say(Hello(client="test", camera=CAMERA))
    code, reason, _ = wire.ending()
    assert code == TRY_LATER
    assert "place" in reason


def test_without_the_token_nothing_is_opened(town, dial) -> None:
    wire = dial("guess")
    assert wire.ending()[0] == UNAUTHORIZED
    assert not town.hosts


def test_endings_of_the_host_arrive_as_they_are(dial) -> None:
    wire = dial()
    greeted(wire)
    wire.socket.send("text")
    code, reason, _ = wire.ending()
    assert code == 1003
    assert "binary" in reason


def test_control_messages_pass(dial) -> None:
    wire = dial()
    greeted(wire)
    wire.say(Quality(request=9, preset="rm"))
    assert wire.hear_until(Acknowledged)[-1].request == 9


def test_host_leaves_only_when_nobody_is_there(town, dial) -> None:
    wire = dial()
    greeted(wire)
    host = next(iter(town.hosts.values()))
    assert answered(wire, 1)
    status = host.status()
    assert status.clients == 1
    assert 0 <= status.queue_age_s < PATIENCE_S
    assert host.status().queue_age_s == 0  # no frame since
    assert not host.leave()
    wire.socket.close()
    assert eventually(lambda: host.status().clients == 0)
    assert host.status().idle_s < PATIENCE_S
    assert host.leave()

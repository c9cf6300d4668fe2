"""Clients at the ingress: led to their rooms, led back to them, and told what goes wrong there."""

import time

import httpx

from protocol.messages import Acknowledged, Composite, Hello, Quality, Watch, Welcome, Wishes
from server.cluster.ingress import create_ingress_app
from server.cluster.quota import Quota
from server.cluster.relay import MOVED
from server.cluster.routing import room_id_of
from server.service.edge.connection import GONE, RESTART, TRY_LATER, UNAUTHORIZED
from tests.cluster.conftest import IMPATIENT_S, TOKEN, AsServe, served
from tests.service.fakes import CAMERA, PATIENCE_S, frame_message
from tests.service.promlint import problems
from tests.service.wire import Wire


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
    greeted(wire, keep_s=30.0, room="kitchen")
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
    greeted(wire, room="kitchen")
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


def test_places_of_private_rooms_come_back_when_their_clients_leave(town, dial) -> None:
    for _ in range(3 * town.free):
        wire = dial()
        greeted(wire)
        wire.hang_up()
    assert eventually(lambda: town.free == 3)
    assert not town.hosts


def test_a_named_room_keeps_its_place_for_those_who_come_back(town, dial) -> None:
    wire = dial()
    greeted(wire, room="kitchen")
    wire.hang_up()
    assert eventually(lambda: clients_of(town, "kitchen") == 0)
    again = dial()
    greeted(again, room="kitchen")
    assert town.free == 2


def test_a_kept_session_keeps_its_place(town, dial) -> None:
    wire = dial()
    welcome = greeted(wire, keep_s=300.0)
    wire.socket.socket.close()
    again = dial()
    assert greeted(again, resume=welcome.key).resumed
    assert len(town.hosts) == 1


def test_who_leaves_before_the_room_is_ready_gives_up_its_place(town, dial, ingress) -> None:
    town.free = 0
    for _ in range(11):
        wire = dial()
        wire.say(Hello(client="test", camera=CAMERA))
        wire.hang_up()
    assert eventually(lambda: len(town.abandoned) == 11)
    assert eventually(lambda: ingress.clients == 0)
    assert not town.hosts
    assert b"probeless_ingress_abandoned_total 11.0" in ingress.metrics.render()


def test_whose_request_is_cancelled_before_the_room_is_ready_opens_none(town, ingress, monkeypatch) -> None:
    monkeypatch.setattr("server.cluster.ingress.RETRY_S", 0.01)
    town.free = 0
    with served(AsServe(create_ingress_app(ingress))) as url:
        for _ in range(5):
            wire = Wire(url, Authorization=f"Bearer {TOKEN}")
            wire.say(Hello(client="test", camera=CAMERA))
            wire.hang_up()
        assert eventually(lambda: len(town.abandoned) == 5)
        assert eventually(lambda: ingress.clients == 0)
        asked, town.free = town.asked, 3
        time.sleep(0.5)
        assert town.asked == asked
    assert not town.hosts


def test_what_was_sent_before_the_room_was_ready_arrives_in_order(town, dial) -> None:
    free, town.free = town.free, 0
    wire = dial()
    wire.say(Hello(client="test", camera=CAMERA, wishes=Wishes(lossless=True)), *(frame_message(n) for n in range(8)))
    town.free = free
    assert isinstance(wire.hear(), Welcome)
    heard = [wire.hear_until(Composite)[-1].frame for _ in range(8)]
    assert heard == list(range(8))


def test_a_client_has_so_many_rooms_and_no_more(town, dial, monkeypatch) -> None:
    monkeypatch.setattr("server.cluster.ingress.client_of", lambda _address, _proxies: "203.0.113.7")
    town.quota = Quota(2)
    first, second, third = dial(), dial(), dial()
    greeted(first, room="kitchen")
    greeted(second, room="study")
    third.say(Hello(client="test", camera=CAMERA, room="hall"))
    code, reason, _ = third.ending()
    assert code == TRY_LATER
    assert "203.0.113.7 has 2 rooms open" in reason
    guest = dial()
    greeted(guest, room="study")  # a room that is open is nobody's quota


def test_it_is_not_ready_while_there_is_no_place(town, ingress, ingress_url, monkeypatch) -> None:
    monkeypatch.setattr("server.cluster.ingress.FRESH_S", 0.0)

    def status(path: str) -> int:
        return httpx.get(f"{ingress_url}{path}", trust_env=False).status_code

    assert eventually(lambda: status("/readyz") == 200)
    town.free = 0
    assert eventually(lambda: status("/readyz") == 503)
    assert status("/livez") == status("/healthz") == 200
    assert b"probeless_ingress_has_place 0.0" in ingress.metrics.render()


def test_its_metrics_keep_to_prometheus_rules(ingress_url, dial) -> None:
    greeted(dial())
    wire = dial("guess")
    assert wire.ending()[0] == UNAUTHORIZED
    text = httpx.get(f"{ingress_url}/metrics", trust_env=False).text
    assert problems(text) == []
    assert "probeless_ingress_clients 1.0" in text
    assert 'probeless_ingress_refused_total{code="4401"} 1.0' in text
    assert "probeless_ingress_wait_seconds_count 1.0" in text
    assert "probeless_build_info" in text


def test_a_drained_host_sends_its_clients_elsewhere(town, dial) -> None:
    wire = dial()
    greeted(wire, room="kitchen")
    host = town.hosts.pop(room_id_of("kitchen"))
    assert host.leave(even_with_clients=True)
    assert wire.ending()[0] == RESTART
    again = dial()
    greeted(again, room="kitchen")  # on another node
    assert clients_of(town, "kitchen") == 1

"""Who may open rooms, which are closed, and which GPU they get."""

from __future__ import annotations

import pytest

from server.cluster.closing import FIRST_CLIENT_S, is_enough, rooms_to_close
from server.cluster.host import HostStatus, gpu_number
from server.cluster.quota import SETTLING_S, Quota, client_of
from server.service.edge.trusted_proxies import TrustedProxies

NOBODY = TrustedProxies()
AFTER_S = 60.0


def status(clients: int = 0, idle_s: float = 0.0, **more: bool) -> HostStatus:
    return HostStatus(clients, idle_s, 0.0, "node", **more)


def test_a_quota_counts_rooms_that_are_open_by_who_opened_them() -> None:
    clock = [0.0]
    quota = Quota(2, lambda: clock[0])
    assert quota.claim("a", "first", [])
    assert quota.claim("b", "first", ["a"])
    assert quota.claim("b", "first", ["a"]), "asking again counts once"
    assert not quota.claim("c", "first", ["a", "b"])
    assert quota.claim("c", "second", ["a", "b"])
    clock[0] = SETTLING_S
    assert quota.claim("d", "first", ["b", "c"]), "room a is closed"
    assert not quota.claim("e", "first", ["b", "c"]), "room d counts until it is listed"
    quota.release("d")
    assert quota.claim("e", "first", ["b", "c"])


def test_who_cannot_be_told_apart_is_not_limited() -> None:
    quota = Quota(1)
    assert all(quota.claim(str(number), "", []) for number in range(20))


@pytest.mark.parametrize(
    ("address", "proxies", "client"),
    [
        ("203.0.113.7", NOBODY, ""),  # documentation's network counts as private
        ("8.8.8.8", NOBODY, "8.8.8.8"),
        ("2a00:1450:4001:81b::200e", NOBODY, "2a00:1450:4001:81b::/64"),
        ("10.2.3.4", NOBODY, ""),
        ("127.0.0.1", NOBODY, ""),
        ("10.2.3.4", TrustedProxies(["10.0.0.0/16"]), "10.2.3.4"),
        ("10.0.3.4", TrustedProxies(["10.0.0.0/16"]), ""),
        ("", NOBODY, ""),
        ("unix:", TrustedProxies(["10.0.0.0/16"]), ""),
    ],
)
def test_a_client_is_its_address_where_that_is_known(address: str, proxies: TrustedProxies, client: str) -> None:
    assert client_of(address, proxies) == client


def test_empty_rooms_are_closed_in_their_time() -> None:
    rooms = {
        "in use": status(1),
        "just left": status(0, 1.0),
        "long empty": status(0, AFTER_S + 1),
        "private": status(0, 0.1, is_private=True),
        "private, in use": status(1, is_private=True),
        "new": status(0, 20.0, is_new=True),
        "private, new": status(0, FIRST_CLIENT_S - 1, is_private=True, is_new=True),
        "private, never used": status(0, FIRST_CLIENT_S + 1, is_private=True, is_new=True),
    }
    assert rooms_to_close(rooms, AFTER_S, is_full=True) == ["long empty", "private", "private, never used"]


def test_rooms_that_wait_get_the_places_of_the_longest_empty_ones() -> None:
    rooms = {"a": status(0, 5.0), "b": status(0, 9.0), "c": status(1), "new": status(0, 20.0, is_new=True)}
    waits, more = {"waits": None}, {"too": None, "and": None}
    assert rooms_to_close(rooms, AFTER_S, is_full=True) == []
    assert rooms_to_close(rooms | waits, AFTER_S, is_full=False) == [], "it only starts: there are places"
    assert rooms_to_close(rooms | waits, AFTER_S, is_full=True) == ["b"]
    assert rooms_to_close(rooms | waits | more, AFTER_S, is_full=True) == ["b", "a"]
    assert rooms_to_close(rooms | {"d": status(0, AFTER_S + 1)} | waits, AFTER_S, is_full=True) == ["d"]


def test_a_place_is_free_where_all_it_takes_is() -> None:
    place = {"CPU": 0.5, "room": 1.0}
    assert is_enough({"CPU": 1.0, "room": 1.0, "GPU": 0.0}, place)
    assert not is_enough({"CPU": 1.0}, place)
    assert not is_enough({"CPU": 0.25, "room": 3.0}, place)


@pytest.mark.parametrize(("ids", "number"), [([], 0), (["0"], 0), (["3"], 3), (["3", "1"], 3), (["GPU-8932"], 0)])
def test_a_host_takes_the_gpu_that_it_was_given(ids: list[str], number: int) -> None:
    assert gpu_number(ids) == number

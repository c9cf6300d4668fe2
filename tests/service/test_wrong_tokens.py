"""Wrong tokens: answered later and later, and logged with the address of whoever sends them."""

from __future__ import annotations

import logging

import httpx
import pytest

from client.errors import OptionError
from client.options.serve_options import ServeOptions, authenticator_of
from server.service.edge.authenticator import Authenticator
from server.service.edge.trusted_proxies import TrustedProxies
from server.service.edge.wrong_tokens import (
    FIRST_DELAY_S,
    FORGOTTEN_S,
    FREE_ATTEMPTS,
    MAX_ADDRESSES,
    MAX_DELAY_S,
    WrongTokens,
)
from tests.service.admission import TOKEN
from tests.service.fakes import PATIENCE_S
from tests.service.wire import Wire


class Clock:
    """A time that the test turns."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_the_delay_doubles_is_bounded_and_is_each_address_its_own() -> None:
    wrong = WrongTokens(Clock())
    assert [wrong.delay_s("192.0.2.1") for _ in range(FREE_ATTEMPTS)] == [0.0] * FREE_ATTEMPTS
    delays = [wrong.delay_s("192.0.2.1") for _ in range(2000)]
    assert delays[:3] == [FIRST_DELAY_S, 2 * FIRST_DELAY_S, 4 * FIRST_DELAY_S]
    assert delays[-1] == MAX_DELAY_S
    assert wrong.delay_s("192.0.2.2") == 0


def test_one_client_of_ipv6_cannot_change_its_address() -> None:
    wrong = WrongTokens(Clock())
    delays = [wrong.delay_s(f"2001:db8::{k}") for k in range(FREE_ATTEMPTS + 1)]
    assert delays[-1] == FIRST_DELAY_S


def test_wrong_tokens_are_forgotten() -> None:
    clock = Clock()
    wrong = WrongTokens(clock)
    for _ in range(FREE_ATTEMPTS + 1):
        wrong.delay_s("192.0.2.1")
    clock.now_s += 2 * FORGOTTEN_S
    assert wrong.delay_s("192.0.2.1") == 0


def test_many_addresses_take_little_memory() -> None:
    wrong = WrongTokens(Clock())
    for k in range(2 * MAX_ADDRESSES):
        wrong.delay_s(f"10.{k >> 16}.{k >> 8 & 255}.{k & 255}")
    assert len(wrong._counts) == MAX_ADDRESSES


class Held(WrongTokens):
    """Answers to wrong tokens wait for longer than the test."""

    def delay_s(self, _address: str) -> float:
        """An hour."""
        return 3600.0


def test_the_right_token_and_a_missing_one_are_not_delayed(start_server) -> None:
    server = start_server(authenticator=Authenticator(TOKEN, wrong_tokens=Held()))
    guess = Wire(server.url, Authorization="Bearer x")
    with pytest.raises(httpx.ReadTimeout):
        httpx.get(f"{server.url}/v1/objects?token=x", trust_env=False, timeout=0.2)
    wire = Wire(server.url, Authorization=f"Bearer {TOKEN}")
    assert wire.greet()
    assert Wire(server.url).ending()[0] == 4401
    for each in (guess, wire):
        each.hang_up()


def test_every_refusal_is_logged_with_its_address(start_server, caplog: pytest.LogCaptureFixture) -> None:
    proxies = TrustedProxies(["127.0.0.1"])
    with caplog.at_level(logging.INFO):
        server = start_server(authenticator=Authenticator(TOKEN, proxies=proxies))
        code, _, _ = Wire(server.url, **{"Authorization": "Bearer x", "X-Forwarded-For": "192.0.2.7"}).ending()
        assert code == 4401
        headers = {"X-Forwarded-For": "192.0.2.8"}
        for path in ("/v1/objects", "/v1/panorama.hdr", "/metrics"):
            assert httpx.get(server.url + path, headers=headers, trust_env=False, timeout=PATIENCE_S).status_code == 401
    told = [record.address for record in caplog.records if record.message in {"client refused", "request refused"}]
    assert told == ["192.0.2.7"] + 3 * ["192.0.2.8"]


@pytest.mark.parametrize(
    ("proxies", "seen"),
    [([], "127.0.0.1"), (["192.0.2.0/24"], "127.0.0.1"), (["127.0.0.0/8"], "198.51.100.1"), (["::1"], "127.0.0.1")],
)
def test_only_named_proxies_say_where_a_client_comes_from(start_server, caplog, proxies, seen) -> None:
    with caplog.at_level(logging.INFO):
        server = start_server(authenticator=Authenticator(TOKEN, proxies=TrustedProxies(proxies)))
        Wire(server.url, **{"X-Forwarded-For": "198.51.100.1"}).ending()
    (told,) = [record.address for record in caplog.records if record.message == "client refused"]
    assert told == seen


def test_proxies_are_found_in_their_networks() -> None:
    proxies = TrustedProxies(["192.0.2.0/24", "2001:db8::5"])
    for address in ("192.0.2.1", "::ffff:192.0.2.1", "2001:db8::5"):
        assert address in proxies
    for address in ("192.0.3.1", "2001:db8::6", "testclient", ""):
        assert address not in proxies
    assert "::ffff:192.0.2.0/120" in proxies.for_uvicorn


@pytest.mark.parametrize("wrong", ["proxy.example", "10.0.0.5/24", "10.0.0.0/33", ""])
def test_a_wrong_proxy_is_told(wrong: str) -> None:
    with pytest.raises(OptionError, match=r"--trusted-proxy: .*expected ADDRESS or ADDRESS/BITS"):
        authenticator_of(ServeOptions(host="127.0.0.1", trusted_proxy=(wrong,)))
    given = authenticator_of(ServeOptions(host="127.0.0.1", trusted_proxy=("10.0.0.0/24",)))
    assert "10.0.0.5" in given.proxies

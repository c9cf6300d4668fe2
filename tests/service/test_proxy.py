"""The proxy that tests break connections with leaves nothing behind."""

from __future__ import annotations

import socket
import threading
import time
from urllib.parse import urlsplit

from tests.service.fakes import PATIENCE_S
from tests.service.proxy import Proxy


def threads_of_proxies() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("proxy-")]


def test_it_ends_with_all_its_threads() -> None:
    """One connection idles, one is cut, one sends what nobody takes."""
    with socket.create_server(("127.0.0.1", 0)) as target:
        proxy = Proxy(f"http://127.0.0.1:{target.getsockname()[1]}")
        at = ("127.0.0.1", urlsplit(proxy.url).port)
        idle, cut = socket.create_connection(at), socket.create_connection(at)
        ends = [target.accept()[0] for _ in range(2)]
        end_s = time.monotonic() + PATIENCE_S
        while len(threads_of_proxies()) < 1 + 2 * 4:  # connected here comes before its threads run there
            assert time.monotonic() < end_s
            time.sleep(0.01)
        proxy.cut()
        busy = socket.create_connection(at)
        busy.settimeout(0.5)
        ends.append(target.accept()[0])
        try:
            while True:
                busy.sendall(bytes(1 << 20))
        except TimeoutError:
            pass  # all buffers are full
        closing = threading.Thread(target=proxy.close)
        closing.start()
        closing.join(PATIENCE_S)
        assert not closing.is_alive()
        for end in (idle, cut, busy, *ends):
            end.close()
    assert not threads_of_proxies()

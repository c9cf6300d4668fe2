"""A TCP proxy that impairs what goes through it: delay, rate, stalls and cuts. In threads: netem is not everywhere."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections import deque
from collections.abc import Iterator
from urllib.parse import urlsplit

CHUNK = 16384


class Proxy:
    """Between a client and a server; its numbers may be changed while it runs."""

    def __init__(self, url: str, delay_s: float = 0.0, bytes_per_s: float | None = None) -> None:
        """`delay_s`: each way. `bytes_per_s`: each way too."""
        self.lead_to(url)
        self.delay_s = delay_s
        self.bytes_per_s = bytes_per_s
        self.flows = threading.Event()
        """Cleared: nothing goes through, nothing is closed."""
        self.flows.set()
        self.refuses = False
        """New connections are closed at once."""
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        self.connections = 0
        self.url = f"{urlsplit(url).scheme}://127.0.0.1:{self._listener.getsockname()[1]}"
        self._ways: list[_Way] = []
        self._accepting = threading.Thread(target=self._accept, name="proxy-accept", daemon=True)
        self._accepting.start()

    def lead_to(self, url: str) -> None:
        """New connections go there from now on."""
        self._target = (urlsplit(url).hostname, urlsplit(url).port)

    def cut(self) -> None:
        """Break every connection, as a network does: without a word of the protocol."""
        pairs, self._pairs = self._pairs, []
        for pair in pairs:
            for end in pair:
                with contextlib.suppress(OSError):
                    end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # a reset
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
                end.close()

    def close(self) -> None:
        """End it and all that goes through it; no thread is left."""
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)  # closing alone lets a thread in accept() wait for ever
        self._listener.close()
        self._accepting.join()
        self.flows.set()
        self.cut()
        for way in self._ways:
            way.join()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                if self.refuses:
                    client.close()
                    continue
                try:
                    server = socket.create_connection(self._target)
                except OSError:
                    client.close()
                    continue
                self.connections += 1
                self._pairs.append((client, server))
                for pair in ((client, server), (server, client)):
                    for end in pair:
                        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    self._ways.append(_Way(self, *pair))


class _Way:
    """One direction of one connection: a thread reads, a thread writes when the time has come."""

    def __init__(self, proxy: Proxy, source: socket.socket, sink: socket.socket) -> None:
        self._proxy, self._source, self._sink = proxy, source, sink
        self._held: deque[tuple[float, bytes]] = deque()
        self._changed = threading.Condition()
        self._is_broken = False
        """Nobody takes any more what is held."""
        works = (self._read, self._write)
        self._threads = [threading.Thread(target=work, name="proxy-way", daemon=True) for work in works]
        for thread in self._threads:
            thread.start()

    def join(self) -> None:
        """Wait for its end, after its sockets have been closed."""
        for thread in self._threads:
            thread.join()

    def _read(self) -> None:
        data = b"x"
        while data:
            try:
                data = self._source.recv(CHUNK)
            except OSError:
                data = b""
            with self._changed:
                self._changed.wait_for(lambda: len(self._held) < 64 or self._is_broken)
                if self._is_broken:
                    return
                self._held.append((time.perf_counter() + self._proxy.delay_s, data))
                self._changed.notify_all()

    def _write(self) -> None:
        self._forward()
        with self._changed:
            self._is_broken = True
            self._changed.notify_all()

    def _forward(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._held))
                due_s, data = self._held.popleft()
                self._changed.notify_all()
            time.sleep(max(due_s - time.perf_counter(), 0.0))
            self._proxy.flows.wait()
            if self._proxy.bytes_per_s:
                time.sleep(len(data) / self._proxy.bytes_per_s)
            try:
                if not data:
                    self._sink.shutdown(socket.SHUT_WR)
                    return
                self._sink.sendall(data)
            except OSError:
                return


@contextlib.contextmanager
def impaired(url: str, delay_s: float = 0.0, bytes_per_s: float | None = None) -> Iterator[Proxy]:
    """A proxy to the server at `url`."""
    proxy = Proxy(url, delay_s, bytes_per_s)
    try:
        yield proxy
    finally:
        proxy.close()

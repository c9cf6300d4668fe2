"""The listening socket, and why there is none."""

from __future__ import annotations

import errno
import socket


class ServeError(Exception):
    """The server cannot start; one line with the reason and a remedy."""


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 takes a free one. Raises ServeError if the port is in use or the host is not local."""
    if not 0 <= port <= 65535:
        raise ServeError(f"there is no port {port}: choose --port from 1 to 65535")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise ServeError(f"port {port} of {host} is in use: stop what uses it or choose another --port") from error
        why = error.strerror or str(error)
        raise ServeError(f"cannot listen on {host} port {port} ({why}): choose another --host or --port") from error

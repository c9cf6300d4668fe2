"""`python -m protocol.conformance URL [--token T]` checks a server, `--serve PORT` a client; a line for each rule."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Iterable

from protocol.conformance.play_client import check_server
from protocol.conformance.play_server import ConformanceServer
from protocol.conformance.report import Line
from protocol.conformance.wire_socket import PATIENCE_S


def main() -> int:
    """Exit status 0 where every rule holds, 1 where one does not, 2 where the server cannot be reached."""
    parser = argparse.ArgumentParser(prog="python -m protocol.conformance", description=__doc__)
    parser.add_argument("url", nargs="?", help="of the server to check, such as http://localhost:8000")
    parser.add_argument("--token", help="of that server")
    parser.add_argument("--patience", type=float, default=PATIENCE_S, metavar="S", help="seconds an answer may take")
    parser.add_argument("--serve", type=int, metavar="PORT", help="play a server for the client to check")
    parser.add_argument("--sessions", type=int, default=1, help="with --serve: report after so many connections")
    asked = parser.parse_args()
    if (asked.url is None) == (asked.serve is None):
        parser.error("give the URL of a server, or --serve PORT")
    if asked.serve is not None:
        return _report(_of_clients(asked.serve, asked.sessions))
    try:
        return _report(check_server(asked.url, asked.token, asked.patience))
    except OSError as error:
        sys.stderr.write(f"no server answers at {asked.url}: {error}\n")
        return 2


def _of_clients(port: int, sessions: int) -> Iterable[Line]:
    server = ConformanceServer(port)
    sys.stderr.write(f"playing a server at http://127.0.0.1:{server.port}\n")
    threading.Thread(target=server.run, daemon=True).start()
    for number in range(sessions):
        yield from server.wait_for(number).lines()
    server.stop()


def _report(lines: Iterable[Line]) -> int:
    failures = 0
    for line in lines:
        failures += line.failure is not None
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())

"""Bad requests to the HTTP side: methods, paths, queries, headers and bodies that are nearly right, and raw bytes."""

from __future__ import annotations

import random
import socket
from collections import Counter
from pathlib import Path

import httpx

from server.service.app import create_app
from server.service.service import Service
from tests.bench.report.finished import Part
from tests.bench.report.run import Run
from tests.bench.service.process import Served, serving
from tests.service.by_schema import requests_by_schema
from tests.service.fakes import FAKE_DEVICE

REQUESTS, QUICK_REQUESTS = 20_000, 300
EXAMPLES, QUICK_EXAMPLES = 1000, 20
"""A route and kind."""
SEED = 8
PATIENCE_S = 20.0
METHODS = ("GET", "HEAD", "POST", "PUT", "DELETE", "OPTIONS", "PATCH", "TRACE", "CONNECT", "get", "BREW", "G\x00T")
PATHS = (
    "/",
    "/index.html",
    "/healthz",
    "/livez",
    "/readyz",
    "/metrics",
    "/v1/stream",
    "/docs",
    "/openapi.json",
    "/../../etc/passwd",
    "/%2e%2e/%2e%2e/etc/passwd",
    "/..%5c..%5cwindows",
    "//healthz",
    "/healthz/",
    "/%00",
    "/%ff%fe",
    "/" + "a" * 5000,
    "/" + "a/" * 500,
    "/healthz?token=" + "x" * 3000,
    "/metrics?token=%00",
    "/?token=wrong",
    "*",
    "http://elsewhere/healthz",
)
HEADERS = (
    ("Host", "elsewhere"),
    ("Host", ""),
    ("Origin", "https://elsewhere"),
    ("Authorization", "Bearer wrong"),
    ("Authorization", "Bearer " + "x" * 8000),
    ("Authorization", "Basic ====="),
    ("Range", "bytes=0-0,5-1,-9999999999999999999999"),
    ("If-None-Match", '"' * 999),
    ("If-Modified-Since", "yesterday"),
    ("Content-Length", "-1"),
    ("Content-Length", "99999999999999999999"),
    ("Content-Length", "5"),
    ("Transfer-Encoding", "chunked"),
    ("Transfer-Encoding", "gzip, chunked"),
    ("Expect", "100-continue"),
    ("Upgrade", "websocket"),
    ("Connection", "Upgrade"),
    ("Sec-WebSocket-Version", "99"),
    ("Sec-WebSocket-Key", "short"),
    ("Sec-WebSocket-Protocol", "probeless-v999"),
    ("Cookie", "\xff" * 100),
    ("X-Long", "y" * 70_000),
    ("X Space", "z"),
    ("", "nameless"),
)
BODIES = (b"", b"hello", b"5\r\nhello\r\n0\r\n\r\n", b"ffffffffffffffff\r\n", b"\x00" * 2000)


def http_part(run: Run, out: Path) -> Part:
    """Requests one after the other; after each hundred the server must be well."""
    count, chance = run.of(QUICK_REQUESTS, REQUESTS), random.Random(SEED)
    answers: Counter[str] = Counter()
    wrong: list[str] = []
    (out / "http.log").unlink(missing_ok=True)  # its errors are counted
    with serving(out / "http.log", "--data", "none") as served:
        for number in range(count):
            request = bad_request(chance)
            answer = answer_to(served, request)
            answers[answer] += 1
            if answer in ("hung", "failed") or answer.startswith("5"):
                wrong.append(f"{answer} <- {request[:200]!r}")
            if number % 100 == 99:
                httpx.get(f"{served.bare_url}/healthz", trust_env=False, timeout=PATIENCE_S).raise_for_status()
                run.say(f"bad requests: {number + 1} of {count}, {dict(answers)}")
        errors = [event for event in served.events() if event.get("level") == "error"]
    part = Part(details={"answers": dict(answers), "wrong": wrong[:20], "errors": errors[:20]})
    part.sizes["bad requests"] = count
    part.add("bad requests: hangs, failures, answers of 500 and above", len(wrong), "requests", "<= 0")
    part.add("bad requests: errors in the server's log", len(errors), "errors", "<= 0")
    return part


def schema_part(run: Run, out: Path) -> Part:
    """Requests that schemathesis makes up from what the routes say of themselves."""
    app = create_app(Service(FAKE_DEVICE))  # for its description
    (out / "schema.log").unlink(missing_ok=True)
    with serving(out / "schema.log", "--data", "none", "--token", "none") as served:
        found = requests_by_schema(app, served.bare_url, run.of(QUICK_EXAMPLES, EXAMPLES))
        errors = [event for event in served.events() if event.get("level") == "error"]
    part = Part(details={"requests": found.requests, "wrong": found.wrong[:20], "errors": errors[:20]})
    part.sizes["requests by the schema"] = sum(found.requests.values())
    part.add("requests by the schema: answers that are not as described", len(found.wrong), "requests", "<= 0")
    part.add("requests by the schema: errors in the server's log", len(errors), "errors", "<= 0")
    return part


def bad_request(chance: random.Random) -> bytes:
    """One, as it goes over the line."""
    if chance.random() < 0.1:
        return chance.randbytes(chance.randrange(1, 400)) + b"\r\n\r\n"
    version = chance.choice(("HTTP/1.1",) * 8 + ("HTTP/1.0", "HTTP/2.0", "HTTP/9", ""))
    headers = [("Host", "localhost"), *chance.sample(HEADERS, chance.randrange(5)), ("Connection", "close")]
    lines = [f"{chance.choice(METHODS)} {chance.choice(PATHS)} {version}", *(f"{k}: {v}" for k, v in headers)]
    end = chance.choice(("\r\n\r\n",) * 8 + ("\n\n", "\r\n"))
    request = "\r\n".join(lines).encode("latin-1") + end.encode() + chance.choice(BODIES)
    if chance.random() < 0.1:
        at = chance.randrange(len(request))
        request = request[:at] + chance.randbytes(1) + request[at + 1 :]
    return request


def answer_to(served: Served, request: bytes) -> str:
    """The status, `closed` where it was closed without one, `silent` where the server still waits for more; `hung`."""
    with socket.create_connection(("127.0.0.1", served.port), timeout=PATIENCE_S) as line:
        try:
            line.sendall(request)
            line.shutdown(socket.SHUT_WR)  # there is no more to wait for
            answer = line.recv(4096)
        except TimeoutError:
            return "hung"
        except OSError:
            return "closed"
    if not answer:
        return "closed"
    status = answer.split(b" ", 2)[1:2]
    return status[0].decode("latin-1") if answer.startswith(b"HTTP/") and status else "failed"

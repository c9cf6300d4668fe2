"""A server in a process of its own, as in the field: started, looked at from outside, killed.

Run as a module it is `probeless serve` with what no user is to have: frames side by side, a device or a disk that
fails, and kernels that are compiled only when they are needed.
`python -m tests.bench.service.process '{"concurrent_frames": 2}' [OPTIONS OF serve]`; see `Unusual`.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any
from unittest.mock import patch

import httpx
import msgspec
from prometheus_client.parser import text_string_to_metric_families

from tests.bench.report.finished import ROOT
from tests.bench.service.injected import INJECTED

START_PATIENCE_S = 120.0
STOP_PATIENCE_S = 30.0
BEGIN, END = signal.SIGRTMIN + 1, signal.SIGRTMIN + 2
"""Signals to a server with a fault; SIGUSR1 and SIGUSR2 are taken by the device's compiler."""
PROGRAM = str(Path(sys.executable).parent / "probeless")


@dataclass(frozen=True)
class Unusual:
    """What `probeless serve` has no option for."""

    concurrent_frames: int = 1
    fault: str = ""
    """One of `service_injected.INJECTED`: it fails from the signal `BEGIN` to `END`."""
    warms_up: bool = True
    """False: it is ready before any kernel is, for tests that ask nothing of most of them."""


@dataclass
class Served:
    """A server that is ready."""

    process: subprocess.Popen[str]
    url: str
    """With its token."""
    log: Path
    options: tuple[str, ...]
    unusual: Unusual = field(default_factory=Unusual)

    @property
    def bare_url(self) -> str:
        return self.url.partition("?")[0].rstrip("/")

    @property
    def port(self) -> int:
        return int(self.bare_url.rpartition(":")[2])

    def health(self) -> dict[str, Any]:
        """What /healthz says."""
        found: dict[str, Any] = httpx.get(f"{self.bare_url}/healthz", trust_env=False, timeout=20.0).json()
        return found

    def metrics(self) -> dict[tuple[str, ...], float]:
        """Every sample of /metrics, by name and values of its labels."""
        text = httpx.get(f"{self.bare_url}/metrics", trust_env=False, timeout=20.0).text
        families = text_string_to_metric_families(text)
        return {(s.name, *s.labels.values()): s.value for family in families for s in family.samples}

    def events(self) -> list[dict[str, Any]]:
        """Its log so far."""
        found = []
        for line in self.log.read_text().splitlines():
            with suppress(ValueError):
                found.append(json.loads(line))
        return found

    def kill(self) -> None:
        """SIGKILL."""
        self.process.kill()
        self.process.wait()


def start(log: Path, *options: str, unusual: Unusual | None = None, port: int = 0) -> Served:
    """Start and wait until it is ready. Raises RuntimeError with what it said."""
    command = [PROGRAM, "serve"]
    if unusual is not None:
        command = [sys.executable, "-m", "tests.bench.service.process", json.dumps(asdict(unusual))]
    said = (*options, "--no-restart", "--log", "json")  # its process is looked at, and killed
    with log.open("a") as errors:
        process = subprocess.Popen(
            [*command, "--port", str(port), *said], stdout=subprocess.PIPE, stderr=errors, text=True, cwd=ROOT
        )
    assert process.stdout is not None
    watchdog = threading.Timer(START_PATIENCE_S, process.kill)
    watchdog.start()
    try:
        url = _ready_url(process.stdout)
    finally:
        watchdog.cancel()
    if url is None:
        process.wait()
        raise RuntimeError(f"the server did not start: {log.read_text()[-2000:]}")
    return Served(process, url, log, options, unusual or Unusual())


def stop(served: Served) -> None:
    """In order; by force where that takes too long."""
    if served.process.poll() is None:
        served.process.terminate()
        try:
            served.process.wait(STOP_PATIENCE_S)
        except subprocess.TimeoutExpired:
            served.kill()
    if served.process.stdout is not None:
        served.process.stdout.close()


@contextmanager
def serving(log: Path, *options: str, unusual: Unusual | None = None, port: int = 0) -> Iterator[Served]:
    """A server, stopped at the end."""
    served = start(log, *options, unusual=unusual, port=port)
    try:
        yield served
    finally:
        stop(served)


def _ready_url(lines: IO[str]) -> str | None:
    for line in lines:
        found = re.search(r"ready: open (https?://\S+)", line)
        if found:
            return found[1]
    return None


def resident_mb(pid: int) -> float:
    """Resident memory of a process in MB, from /proc. Raises OSError where there is none."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1e3
    raise ProcessLookupError(f"no process {pid}")


def held_mb(pid: int) -> float:
    """Resident memory of a process and of those that it started. Raises OSError where there is none of that number."""
    found = resident_mb(pid)
    for below in descendants(pid):
        with suppress(OSError):  # it has just ended
            found += resident_mb(below)
    return found


def children(pid: int) -> list[int]:
    """Processes that `pid` started."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError):
                if int((entry / "stat").read_text().rpartition(")")[2].split()[1]) == pid:
                    found.append(int(entry.name))
    return found


def descendants(pid: int, named: str = "") -> list[int]:
    """Those, what they started, and so on: where `named` is a part of the command line."""
    below = [one for child in children(pid) for one in (child, *descendants(child))]
    return [one for one in below if named in _command(one)]


def _command(pid: int) -> str:
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_text()
    return ""


def _serve_unusually(unusual: Unusual, arguments: list[str]) -> None:
    from client import cli
    from server.service import service

    class Service(service.Service):
        def __init__(self, *given: Any, **more: Any) -> None:
            super().__init__(*given, **{"concurrent_frames": unusual.concurrent_frames} | more)

    with patch("server.service.serve.Service", Service), ExitStack() as changes:
        if not unusual.warms_up:
            changes.enter_context(patch("server.service.serve._warm_up", lambda _device: None))
        if unusual.fault:
            injected = INJECTED[unusual.fault]()
            signal.signal(BEGIN, lambda *_: injected.begin())
            signal.signal(END, lambda *_: injected.end())
        sys.argv = ["probeless", "serve", *arguments]
        cli.main()


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _serve_unusually(msgspec.json.decode(sys.argv[1], type=Unusual), sys.argv[2:])

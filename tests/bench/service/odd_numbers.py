"""Numbers that are legal but odd, and any that float64 has, from one client after the other to a running server.

Hypothesis makes up the sessions (tests/service/odd_numbers.py): cameras, poses, depths, wishes, places, requests. Each
is sent to a server that computes on its device. It may refuse them by the field's name or answer them; it must not end,
and a session must not fail inside. All the while another client sends frames, whose times are compared with those
before.
"""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import time
import warnings
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded
from hypothesis.errors import HypothesisDeprecationWarning
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from client.options.source import open_source
from client.streaming.client import StreamClient
from protocol.codec import decode_server
from protocol.limits import SUBPROTOCOL
from protocol.messages import Acknowledged, Composite, Dropped, Error, Layer, Light, Welcome, Wishes
from tests.bench.report.finished import ROOT, Part
from tests.bench.report.run import Run
from tests.bench.service.long_frames import SHORT, answered, resized_camera
from tests.bench.service.process import Served, serving
from tests.service.odd_numbers import OddSession, sessions

SEED = 22
FRAMES_A_SESSION, ROUNDS = 20, 5
"""Frames that are made up, and how often they are sent, with each other's pictures."""
FRAMES, QUICK_FRAMES = 100_000, 500
QUIET_FRAMES = 300
WARM_UP_FRAMES = 60
"""Until it needs no kernel for the first time: those of a frame that is interrupted, that looks for lamps, of a volume
that grows. Each waits for the compiler where PoCL's cache is empty."""
PAUSE_S = 0.1
"""Of the other client after each answer, as with a camera of few frames a second."""
AHEAD = 2
"""Frames that are unanswered at a time: `welcome.max_inflight`."""
PATIENCE_S = 120.0
"""Longer is taken to hang: it is more than any frame of such pictures takes on a busy machine."""
FAILURES = (1006, 1011)
"""Close codes of a lost connection and of a server that failed inside."""


class Enough(Exception):
    """Ends the sessions: Hypothesis would go on making some up, and the other client would be timed beside nobody."""


@dataclass
class Outcome:
    """What became of odd sessions."""

    sessions: int = 0
    frames: int = 0
    """That were sent."""
    answers: dict[str, int] = field(default_factory=dict)
    """Frames and requests, by what answered them."""
    reasons: dict[str, int] = field(default_factory=dict)
    """First words of refusals."""
    failed: list[str] = field(default_factory=list)
    """Sessions that ended with a failure inside, without a word, or hung."""
    slowest_s: float = 0.0
    """Until a frame was answered, beside the others."""

    def note(self, kind: str, reason: str | None = None) -> None:
        """Count one answer."""
        self.answers[kind] = self.answers.get(kind, 0) + 1
        if reason:
            self.reasons[reason[:60]] = self.reasons.get(reason[:60], 0) + 1


def play_sessions(url: str, frames: int, outcome: Outcome, seed: int = SEED) -> None:
    """Sessions with `frames` frames in all, one after the other, to the server at `url` (without a token).

    Raises OSError where the server is gone.
    """
    gone: list[OSError] = []
    count = max(1, frames // (FRAMES_A_SESSION * ROUNDS))

    @seeded(seed)
    @settings(
        max_examples=10 * count,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
        phases=(Phase.generate,),
    )
    @given(session=sessions(FRAMES_A_SESSION, ROUNDS))
    def one(session: OddSession) -> None:
        if gone or outcome.frames >= frames:
            raise Enough
        try:
            play(url, session, outcome)
        except OSError as error:
            gone.append(error)
            outcome.failed.append(f"the server is gone: {session.hello}"[:2000])

    with warnings.catch_warnings():  # the other client's thread uses `random` while sessions are made up
        warnings.simplefilter("ignore", HypothesisDeprecationWarning)
        warnings.filterwarnings("ignore", message="Generating overly large repr")
        with suppress(Enough):
            one()
    if gone:
        raise gone[0]


def play(url: str, session: OddSession, outcome: Outcome) -> None:
    """Send one session and take its answers. Raises OSError where nobody listens."""
    outcome.sessions += 1
    socket = connect(
        url.replace("http", "ws", 1) + "/v1/stream",
        subprotocols=[Subprotocol(SUBPROTOCOL)],
        compression=None,
        max_size=None,
        proxy=None,
        open_timeout=PATIENCE_S,
    )
    last: list[Error] = []
    with socket:
        try:
            _talk(socket, session, outcome, last)
        except ConnectionClosed as closed:
            code = 1006 if closed.rcvd is None else closed.rcvd.code
            reason = last[0].reason if last else getattr(closed.rcvd, "reason", "")
            outcome.note(f"session ended with {code}", reason)
            if code in FAILURES or not reason:
                outcome.failed.append(f"{code} {reason}: {session.hello}"[:2000])
        except TimeoutError:
            outcome.failed.append(f"no answer within {PATIENCE_S:g} s: {session.hello}"[:2000])


def _talk(socket: ClientConnection, session: OddSession, outcome: Outcome, last: list[Error]) -> None:
    """Raises ConnectionClosed, after the fatal error was put into `last`; TimeoutError."""
    final = Light if session.hello["wishes"].get("answer") == "light" else Composite | Layer
    unanswered = [time.perf_counter()]  # the hello
    socket.send(msgpack.packb(session.hello))
    for message in (*session.messages, None):
        while len(unanswered) >= (AHEAD if message else 1):
            answer = decode_server(bytes(socket.recv(timeout=PATIENCE_S)))  # type: ignore[arg-type]
            if isinstance(answer, Error) and answer.fatal:
                last.append(answer)
            elif isinstance(answer, Welcome | Dropped | Acknowledged | final):
                began_s = unanswered.pop(0)
                outcome.slowest_s = max(outcome.slowest_s, time.perf_counter() - began_s)
                refused = getattr(answer, "reason", None) or getattr(answer, "error", None)
                outcome.note(type(answer).__name__.lower(), refused)
        if message is None:
            return
        socket.send(msgpack.packb(message))
        unanswered.append(time.perf_counter())
        outcome.frames += message["type"] == "frame"


class Neighbour:
    """Another client: sends frames one after the other, and keeps the seconds until each is answered.

    It is a process of its own: making up sessions would keep a thread of this one waiting for longer than the server.
    """

    def __init__(self, served: Served) -> None:
        self.quiet_s: list[float] = []
        """Before `begin`."""
        self.beside_s: list[float] = []
        """From `begin` on."""
        self.failure: str | None = None
        self._url = served.url

    def __enter__(self) -> Neighbour:
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, self._url],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        return self

    def begin(self) -> None:
        """Wait until the quiet frames are answered; times count as beside the others from now on."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if line:
            self.quiet_s = json.loads(line)
            self._process.stdin.write("\n")
            self._process.stdin.flush()

    def __exit__(self, *_: object) -> None:
        said, errors = self._process.communicate()  # which closes its input: the end
        if self._process.returncode == 0:
            self.beside_s = json.loads(said)
        else:
            self.failure = errors[-2000:]


async def be_neighbour(url: str) -> None:
    """Print the seconds of quiet frames, then, from a line of standard input to its end, of those beside others."""
    source = open_source("synthetic:room?frames=8")
    client = await StreamClient.connect(url)
    await client.hello(resized_camera(source.camera, SHORT), Wishes())
    await answered(client, source, WARM_UP_FRAMES)
    quiet_s: list[float] = []
    for _ in range(QUIET_FRAMES):
        quiet_s += await answered(client, source, 1)
        await asyncio.sleep(PAUSE_S)
    sys.stdout.write(json.dumps(quiet_s) + "\n")
    sys.stdout.flush()
    await asyncio.to_thread(sys.stdin.readline)
    ends = asyncio.create_task(asyncio.to_thread(sys.stdin.read))
    beside_s: list[float] = []
    while not ends.done():
        beside_s += await answered(client, source, 1)
        await asyncio.sleep(PAUSE_S)
    sys.stdout.write(json.dumps(beside_s))
    await client.close()


def odd_numbers_part(run: Run, out: Path) -> Part:
    """Odd sessions, and the times of another client beside them."""
    outcome = Outcome()
    with serving(out / "odd_numbers.log", "--token", "none", "--data", "none") as served:
        with Neighbour(served) as neighbour:
            neighbour.begin()
            try:
                play_sessions(served.bare_url, run.of(QUICK_FRAMES, FRAMES), outcome)
            except OSError as error:
                run.say(f"odd numbers: the server is gone: {error}")
        ended = served.process.poll() is not None
        errors = [event for event in served.events() if event.get("level") == "error"]
    return part_of(outcome, neighbour, ended, errors)


def part_of(outcome: Outcome, neighbour: Neighbour, ended: bool, errors: list[dict[str, Any]]) -> Part:
    """The rows."""
    part = Part(sizes={"odd frames": outcome.frames, "odd sessions": outcome.sessions})
    part.details = asdict(outcome) | {"errors": errors[:20]}
    disturbed = 0 if neighbour.failure is None else 1
    quiet_s, beside_s = (float(np.percentile(t or [np.nan], 99)) for t in (neighbour.quiet_s, neighbour.beside_s))
    part.add("odd numbers: crashes of the server", int(ended), "crashes", "<= 0")
    part.add("odd numbers: sessions that failed, hung or ended without a word", len(outcome.failed), "sessions", "<= 0")
    part.add("odd numbers: errors in the server's log", len(errors), "errors", "<= 0")
    part.add("odd numbers: others that were disturbed", disturbed, "sessions", "<= 0")
    part.add("odd numbers: frames answered with a picture or light", _answered(outcome), "frames")
    part.add("odd numbers: another client's frame before, 99th percentile", 1e3 * quiet_s, "ms")
    part.add("odd numbers: another client's frame beside them, 99th percentile", 1e3 * beside_s, "ms")
    part.add("odd numbers: beside them over before, 99th percentile", beside_s / quiet_s, "times", "<= 1.5")
    return part


def _answered(outcome: Outcome) -> int:
    return sum(outcome.answers.get(name, 0) for name in ("composite", "layer", "light"))


if __name__ == "__main__":
    asyncio.run(be_neighbour(sys.argv[1]))

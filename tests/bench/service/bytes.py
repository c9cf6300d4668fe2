"""Bad bytes: mutated messages (tests/service/mutations.py) into the decoder, and a share of them over a real socket.

In process, every message that decodes is taken further: its pictures are decoded as a session would. That runs in a
child whose address space is limited; a crash, a hang or a lack of memory ends it, and the rest is run by another one.
Over the socket, each connection sends a few, and then is either served on or was closed with a code and a line.
"""

from __future__ import annotations

import hashlib
import json
import re
import resource
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from protocol.codec import ProtocolError, decode_client, decode_server, encode
from protocol.frames import IDENTITY, CameraModel
from protocol.images import decode_color, decode_depth, encode_color, encode_depth
from protocol.limits import MAX_REASON_CHARS, SUBPROTOCOL
from protocol.messages import Acknowledged, Error, Frame, Hello, PlaceObject, RemoveObject, Welcome, Wishes
from tests.bench.report.finished import ROOT, Part, code_digest
from tests.bench.report.run import Run
from tests.bench.service.guests import CAMERA as GUEST_CAMERA
from tests.bench.service.guests import CUBE, WISHES, clock_frame
from tests.bench.service.process import Served, held_mb, serving
from tests.protocol.samples import CLIENT
from tests.service.mutations import Mutator

MESSAGES, QUICK_MESSAGES = 1_000_000, 20_000
CHUNK = 50_000
OVER_SOCKET, QUICK_OVER_SOCKET = 20_000, 500
A_CONNECTION = 2
SEED = 8
EXTRA_MIB = 768
"""Of address space, beyond what the child has once it is loaded: a few of the largest pictures."""
ONE_S = 2.0
"""A message that takes longer hangs."""
PATIENCE_S = 20.0
MEMORY_GOAL_MB = 3000
NAMED = re.compile(
    r"`\$|unknown field|required fields? (are|is) missing|truncated|malformed|codec can't decode|Expected `|"
    r"missing required field|Invalid (enum )?value|"
    r"nested too deeply|limit of|color\.|depth\.|frame\.|camera|hello\.|wishes|object\.|quality|place_object|panorama|"
    r"watch"
)
"""Words of which one is in every refusal that says what was wrong."""


@dataclass
class Fed:
    """What became of some messages."""

    messages: int = 0
    accepted: int = 0
    refused: int = 0
    unnamed: list[str] = field(default_factory=list)
    """Refusals that do not say the field or the limit."""
    broken: list[str] = field(default_factory=list)
    """What was no refusal at all: another error, a crash, a hang."""
    slowest_ms: float = 0.0
    grown_mb: float = 0.0
    codes: dict[str, int] = field(default_factory=dict)
    """By close code, connections; `served on`: those that were not closed."""

    def add(self, other: Fed) -> None:
        """These too."""
        self.messages += other.messages
        self.accepted += other.accepted
        self.refused += other.refused
        self.unnamed += other.unnamed[:20]
        self.broken += other.broken[:20]
        self.slowest_ms = max(self.slowest_ms, other.slowest_ms)
        self.grown_mb = max(self.grown_mb, other.grown_mb)
        self.codes = dict(Counter(self.codes) + Counter(other.codes))


def seeds() -> list[bytes]:
    """Whole messages, of the protocol's samples and as a session sends them."""
    frames = [_frame(3, codec) for codec in ("jpeg", "png", "raw")]
    return [encode(message) for message in (*CLIENT.values(), *frames)]


def _frame(index: int, codec: Any) -> Frame:
    shown = clock_frame(index, 1.0)
    return Frame(
        frame=index,
        timestamp_s=shown.timestamp_s,
        world_from_camera=IDENTITY,
        color=encode_color(shown.color[:24, :32], codec),
        depth=encode_depth(shown.depth[:24, :32]),
    )


SMALL = CameraModel(width=32, height=24, fx=28.0, fy=28.0, cx=15.5, cy=11.5)


def feed(first: int, count: int) -> Fed:
    """Mutations `first` to `first + count` into the decoder, in this process."""
    fed = Fed()
    mutator = Mutator(seeds(), SEED * 1_000_003 + first)
    before_mb = _peak_mb()
    for _ in range(count):
        data = mutator.next()
        began = time.perf_counter()
        try:
            taken_in(data)
        except ProtocolError as error:
            fed.refused += 1
            line = str(error)
            if not (NAMED.search(line) and len(line) <= MAX_REASON_CHARS and line.isprintable()):
                fed.unnamed.append(line)
        except Exception as error:  # what is being looked for
            fed.broken.append(f"{type(error).__name__}: {error} <- {data[:60]!r}")
        else:
            fed.accepted += 1
        fed.messages += 1
        fed.slowest_ms = max(fed.slowest_ms, 1e3 * (time.perf_counter() - began))
    fed.grown_mb = _peak_mb() - before_mb
    return fed


def taken_in(data: bytes) -> None:
    """As a session does it. Raises ProtocolError."""
    message = decode_client(data)
    if isinstance(message, Frame) and message.color is not None:
        decode_color(message.color, SMALL)
        if message.depth is not None:
            decode_depth(message.depth, SMALL)


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def decoder_part(run: Run, out: Path) -> Part:
    """Mutations into the decoder."""
    count = run.of(QUICK_MESSAGES, MESSAGES)
    fed, kept = Fed(), _Kept(out / "bytes.jsonl")
    for first in range(0, count, CHUNK):
        found = kept.find(first)
        if found is None:
            found = _fed_by_child(first, min(CHUNK, count - first))
            kept.keep(first, found)
        fed.add(found)
        run.say(f"mutated messages: {fed.messages} of {count}, {fed.refused} refused, {len(fed.broken)} broken")
    part = Part(details=asdict(fed))
    part.sizes["mutated messages"] = fed.messages
    name = "mutated messages"
    part.add(f"{name}: crashes, hangs, other errors than a refusal", len(fed.broken), "messages", "<= 0")
    part.add(f"{name}: refusals that do not say what was wrong", len(fed.unnamed), "messages", "<= 0")
    part.add(f"{name}: share refused", 100 * fed.refused / max(fed.messages, 1), "%")
    part.add(f"{name}: slowest", fed.slowest_ms, "ms", f"<= {1e3 * ONE_S:g}")
    part.add(f"{name}: growth of memory", fed.grown_mb, "MB", "<= 100")
    return part


class _Kept:
    """Chunks that are done, a line of JSON each: a run that was stopped goes on."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._key = code_digest(ROOT / name for name in ("protocol", "tests/service", "tests/bench"))

    def find(self, first: int) -> Fed | None:
        """The chunk that begins there."""
        if not self._path.exists():
            return None
        for line in self._path.read_text().splitlines():
            found = json.loads(line)
            if (found["key"], found["first"]) == (self._key, first):
                return Fed(**found["fed"])
        return None

    def keep(self, first: int, fed: Fed) -> None:
        """Add it."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._path.open("a") as file:
            file.write(json.dumps({"key": self._key, "first": first, "fed": asdict(fed)}) + "\n")


def _fed_by_child(first: int, count: int) -> Fed:
    """In a process with little memory; what ends it counts as one broken message."""
    command = [sys.executable, "-m", "tests.bench.service.bytes", str(first), str(count)]
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60 + count * 0.01, check=False)
    except subprocess.TimeoutExpired:
        return Fed(messages=count, broken=[f"hung within {count} from {first}"])
    if done.returncode != 0:
        return Fed(messages=count, broken=[f"died within {count} from {first}: {done.returncode} {done.stderr[-300:]}"])
    return Fed(**json.loads(done.stdout))


def socket_part(run: Run, out: Path) -> Part:
    """A share of them to a real server, beside a client that must not notice."""
    count = run.of(QUICK_OVER_SOCKET, OVER_SOCKET)
    fed, memory_mb = Fed(), []
    (out / "bytes.log").unlink(missing_ok=True)  # its errors are counted
    with serving(out / "bytes.log", "--token", "none", "--data", "none") as served:
        mutator = Mutator([*seeds(), *_requests()], SEED)
        while fed.messages < count:
            fed.add(over_a_connection(served.bare_url, [mutator.next() for _ in range(A_CONNECTION)]))
            if fed.messages % 200 == 0:
                memory_mb.append(_memory_mb(served))
                run.say(f"over the socket: {fed.messages} of {count}, {memory_mb[-1]:.0f} MB, {fed.codes}")
        memory_mb.append(_memory_mb(served))
        still_serves = is_served(served.bare_url)
        errors = [event for event in served.events() if event.get("level") == "error"]
    part = Part(details=asdict(fed) | {"errors": errors[:20], "memory_mb": memory_mb})
    part.sizes["mutated messages over the socket"] = fed.messages
    name = "mutated messages over the socket"
    part.add(f"{name}: hangs, and ends without a code and a line", len(fed.broken), "connections", "<= 0")
    part.add(f"{name}: refusals that do not say what was wrong", len(fed.unnamed), "messages", "<= 0")
    part.add(f"{name}: errors in the server's log", len(errors), "errors", "<= 0")
    part.add(f"{name}: memory of the server and its parsers, most", max(memory_mb), "MB", f"<= {MEMORY_GOAL_MB}")
    part.add(f"{name}: a client is served afterwards", float(still_serves), "", ">= 1")
    return part


def _requests() -> Iterable[bytes]:
    """As a session of the guests' camera sends them."""
    yield encode(Hello(client="guest", camera=GUEST_CAMERA, wishes=WISHES))
    yield encode(PlaceObject(request=1, object="cube", format="ply", data=CUBE, position_m=(0.0, 0.0, 1.9)))


def over_a_connection(url: str, messages: list[bytes]) -> Fed:
    """Half of the connections say hello first; then all messages, and at the end one that has to be answered."""
    fed = Fed(messages=len(messages))
    says_hello = hashlib.blake2b(messages[0], digest_size=1).digest()[0] % 2 == 0
    hello = encode(Hello(client="fuzz", camera=SMALL, wishes=Wishes(preset="gr15fast", voxel_m=0.1)))
    try:
        with _open(url) as socket:
            for data in ([hello] if says_hello else []) + messages:
                socket.send(data)
            socket.send(encode(RemoveObject(request=2**52, object="nobody")))
            _read_to_end(socket, fed)
    except ConnectionClosed as closed:
        _note_closed(closed, fed)
    except (TimeoutError, OSError) as error:
        fed.broken.append(f"{type(error).__name__}: {error}")
    return fed


def _open(url: str) -> ClientConnection:
    return connect(
        url.replace("http", "ws") + "/v1/stream",
        subprotocols=[SUBPROTOCOL],  # type: ignore[list-item]
        compression=None,
        proxy=None,
        max_size=None,
        close_timeout=2.0,
    )


def _read_to_end(socket: ClientConnection, fed: Fed) -> None:
    """Until the last message is answered. Raises ConnectionClosed, TimeoutError."""
    last = ""
    try:
        while True:
            match decode_server(bytes(socket.recv(timeout=PATIENCE_S))):  # type: ignore[arg-type]
                case Acknowledged(request=request) if request == 2**52:
                    fed.codes["served on"] = 1
                    return
                case Error(reason=reason, fatal=True):
                    last = reason
                case Acknowledged(error=str(reason)):
                    _judge(reason, fed)
    except ConnectionClosed:
        if last:
            _judge(last, fed)
        raise


def _judge(reason: str, fed: Fed) -> None:
    fed.refused += 1
    if not reason or len(reason) > MAX_REASON_CHARS:
        fed.unnamed.append(reason)


def _note_closed(closed: ConnectionClosed, fed: Fed) -> None:
    code = 1006 if closed.rcvd is None else closed.rcvd.code
    fed.codes[str(code)] = 1
    says_why = closed.rcvd is not None and (bool(closed.rcvd.reason) or code in (1000, 1001))
    if code in (1006, 1011) or not says_why:
        fed.broken.append(f"closed with {code}: {closed.rcvd.reason if closed.rcvd else 'nothing'}")


def is_served(url: str) -> bool:
    """Whether a client is welcome."""
    with _open(url) as socket:
        socket.send(encode(Hello(client="after it", camera=SMALL)))
        return isinstance(decode_server(bytes(socket.recv(timeout=PATIENCE_S))), Welcome)  # type: ignore[arg-type]


def _memory_mb(served: Served) -> float:
    return held_mb(served.process.pid)


def _limit_memory() -> None:
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    most = size + (EXTRA_MIB << 20)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


if __name__ == "__main__":
    _limit_memory()
    print(json.dumps(asdict(feed(int(sys.argv[1]), int(sys.argv[2])))))

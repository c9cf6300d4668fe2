"""Plays a server for any client: answers frames with a plain light and picture, notes what the client does wrong."""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections import Counter
from collections.abc import Iterator
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

import msgpack
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve
from websockets.typing import Subprotocol

from protocol.codec import ProtocolError, decode_client, encode
from protocol.conformance.report import Line
from protocol.conformance.scene import IDENTITY, grey_png
from protocol.limits import FEW_INFLIGHT, SUBPROTOCOL
from protocol.messages import (
    Acknowledged,
    ColorImage,
    Composite,
    Dropped,
    Error,
    Frame,
    Hello,
    Light,
    Plan,
    ServerMessage,
    Timings,
    Watch,
    Welcome,
)

PAUSE_S = 0.05
"""A client that sends nothing for so long waits for answers."""
DROPPED_EVERY = 5
"""Every fifth frame is dropped, as a busy server would: a client must go on."""
RULES = {
    "subprotocol": (f"offers the subprotocol {SUBPROTOCOL}", "Transport"),
    "binary": ("sends binary messages only", "Transport"),
    "valid": ("sends messages that are valid by the definitions", "The first two messages"),
    "hello": ("says hello or watch first, and once", "A session"),
    "size": ("sends pictures of its camera's size, raw ones with exactly their bytes", "Limits"),
    "codec": ("uses codecs that welcome names", "Colour"),
    "frames": ("numbers its frames upwards, with timestamps that increase", "Spaces and units"),
    "window": ("has at most max_inflight frames unanswered", "Flow control"),
    "pose": ("gives poses where it said so", "Spaces and units"),
    "requests": ("uses each request number once", "Connections that are lost"),
    "end": ("ends with bye or a close frame", "A session"),
}
"""What is checked of a client, by a short name, with the rule's place on the page."""


class Session:
    """What one client has said, and which rules it broke."""

    def __init__(self) -> None:
        self.broken: dict[str, str] = {}
        self.counts: Counter[str] = Counter()
        self.hello: Hello | None = None
        self.is_greeted = False
        self.unanswered = 0
        self.window = FEW_INFLIGHT
        self._last: Frame | None = None
        self._requests: dict[int, object] = {}

    def note(self, rule: str, seen: str) -> None:
        """A rule is broken; the first time counts."""
        self.broken.setdefault(rule, seen)

    def lines(self) -> Iterator[Line]:
        """The report."""
        for name, (rule, section) in RULES.items():
            yield Line(f"the client {rule}", section, self.broken.get(name))

    def answers(self, data: bytes | str) -> list[ServerMessage]:
        """Check a message; what a server says to it."""
        if isinstance(data, str):
            self.note("binary", "a text message")
            return [Error(reason="a text message was received", fatal=True)]
        try:
            message = decode_client(data)
        except ProtocolError as error:
            self.note("valid", str(error))
            return [Error(reason=str(error), fatal=True)]
        kind = str(msgpack.unpackb(data)["type"])
        self.counts[kind] += 1
        if (not self.is_greeted) != isinstance(message, Hello | Watch) and kind != "bye":
            self.note("hello", f"{kind} as message {self.counts.total()}")
        if isinstance(message, Hello | Watch):
            return self._greet(message)
        if isinstance(message, Frame):
            return self._answer(message)
        request: int | None = getattr(message, "request", None)
        if request is None:
            return []
        if self._requests.setdefault(request, message) != message:
            self.note("requests", f"request {request} is used for two")
        return [Acknowledged(request=request)]

    def _greet(self, message: Hello | Watch) -> list[ServerMessage]:
        self.is_greeted = True
        self.hello = message if isinstance(message, Hello) else None
        self.window = FEW_INFLIGHT if self.hello is None else self.hello.max_inflight
        return [Welcome(session="conformance", server="conformance", device="none", max_inflight=self.window)]

    def _answer(self, frame: Frame) -> list[ServerMessage]:
        if self.hello is None:
            return [Dropped(frame=frame.frame, reason="there was no hello")]
        self.unanswered += 1
        if self.unanswered > self.window:
            self.note("window", f"{self.unanswered} unanswered")
        self._check_order(frame)
        self._check_pictures(frame, self.hello)
        if frame.world_from_camera is None and self.hello.wishes.poses == "given":
            self.note("pose", f"frame {frame.frame} has none, and wishes.poses is given")
        if self.counts["frame"] % DROPPED_EVERY == 0:
            return [Dropped(frame=frame.frame, reason="conformance drops every fifth frame: go on")]
        return list(_light_and_picture(frame, self.hello))

    def _check_order(self, frame: Frame) -> None:
        last, self._last = self._last, frame
        if last is not None and (frame.frame <= last.frame or frame.timestamp_s <= last.timestamp_s):
            self.note("frames", f"{frame.frame} at {frame.timestamp_s} s after {last.frame} at {last.timestamp_s} s")

    def _check_pictures(self, frame: Frame, hello: Hello) -> None:
        camera, lens = hello.camera, hello.camera.depth_lens
        if frame.depth is not None:
            size = (frame.depth.width, frame.depth.height)
            is_whole = frame.depth.codec != "raw" or len(frame.depth.data) == 2 * size[0] * size[1]
            if size != (lens.width, lens.height) or not is_whole:
                self.note("size", f"depth of {size[0]}x{size[1]}, {len(frame.depth.data)} bytes")
        if frame.color is None:
            return
        size = (frame.color.width, frame.color.height)
        halves = [(-(-camera.width // by), -(-camera.height // by)) for by in (2, 4)]
        may_be_smaller = frame.color.codec in ("jpeg", "h264")
        sample_bytes = 3 if frame.color.encoding == "srgb8" else 6
        is_whole = frame.color.codec != "raw" or len(frame.color.data) == sample_bytes * size[0] * size[1]
        if (size != (camera.width, camera.height) and not (may_be_smaller and size in halves)) or not is_whole:
            self.note("size", f"colour of {size[0]}x{size[1]}, {len(frame.color.data)} bytes")
        if frame.color.codec == "h264":
            self.note("codec", "h264, which welcome.codecs did not name")


def _light_and_picture(frame: Frame, hello: Hello) -> Iterator[ServerMessage]:
    nothing = ((0.0, 0.0, 0.0),) * 15
    yield Light(
        frame=frame.frame,
        timestamp_s=frame.timestamp_s,
        sh=((1.0, 1.0, 1.0), *nothing),
        sh_std=((None, None, None),) * 16,
        sh_webxr=(1.0, 1.0, 1.0, *[0.0] * 24),
        dominant_direction=(0.0, 0.0, 0.0),
        dominant_intensity=0.0,
        condition=None,
        valid=False,
    )
    if hello.wishes.answer == "light":
        return
    width, height = hello.camera.width, hello.camera.height
    yield Composite(
        frame=frame.frame,
        timestamp_s=frame.timestamp_s,
        world_from_camera=frame.world_from_camera or tuple(IDENTITY),
        tracking="given",
        timings=Timings(),
        plan=Plan(run=(), left_out=()),
        color=ColorImage(width=width, height=height, codec="png", data=grey_png(width, height)),
    )


class ConformanceServer:
    """Listens on a port of this machine and plays a server; `sessions` has what each connection did, in order."""

    def __init__(self, port: int = 0) -> None:
        self.sessions: list[Session] = []
        self._has_ended = threading.Condition()
        self._server: Server = serve(
            self._talk,
            "127.0.0.1",
            port,
            select_subprotocol=_select,
            process_request=_only_the_stream,
            compression=None,
            max_size=None,
        )
        self.port: int = self._server.socket.getsockname()[1]

    def run(self) -> None:
        """Serve until `stop`."""
        self._server.serve_forever()

    def stop(self) -> None:
        """Stop listening."""
        self._server.shutdown()

    def wait_for(self, number: int, timeout_s: float | None = None) -> Session:
        """The session of this number, from 0, once its connection has ended. Raises TimeoutError."""
        with self._has_ended:
            if not self._has_ended.wait_for(lambda: len(self.sessions) > number, timeout_s):
                raise TimeoutError(f"connection {number} has not ended")
            return self.sessions[number]

    def _talk(self, socket: ServerConnection) -> None:
        session = Session()
        if socket.subprotocol != SUBPROTOCOL:
            session.note("subprotocol", f"{socket.subprotocol} was agreed on")
        with contextlib.suppress(ConnectionClosed):
            self._converse(socket, session)
        with contextlib.suppress(ConnectionClosed):
            socket.close()
        if not session.counts["bye"] and socket.protocol.close_rcvd is None:
            session.note("end", "the connection broke")
        with self._has_ended:
            self.sessions.append(session)
            self._has_ended.notify_all()

    def _converse(self, socket: ServerConnection, session: Session) -> None:
        """Answer once the client pauses: one that keeps to its window has to."""
        waiting: list[ServerMessage] = []
        while not session.counts["bye"]:
            try:
                data = socket.recv(timeout=PAUSE_S if waiting else None)
            except TimeoutError:
                data = None
            if data is not None:
                waiting += session.answers(data)
                if not any(isinstance(message, Error) for message in waiting):
                    continue
            for message in waiting:
                socket.send(encode(message))
                if isinstance(message, Error):
                    return
            waiting, session.unanswered = [], 0


def _select(_socket: ServerConnection, offered: Any) -> Subprotocol | None:
    return next(itertools.chain((each for each in offered if each == SUBPROTOCOL), offered), None)


def _only_the_stream(socket: ServerConnection, request: Request) -> Response | None:
    if urlsplit(request.path).path == "/v1/stream":
        return None
    return socket.respond(HTTPStatus.NOT_FOUND, "this plays /v1/stream only\n")

"""The client's end of the socket: an async class that any capturing or watching program can use."""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, field
from itertools import count
from urllib.parse import urlsplit

from websockets.asyncio.client import ClientConnection
from websockets.asyncio.client import connect as open_socket
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidURI
from websockets.typing import Subprotocol

from protocol.codec import ProtocolError, decode_server, encode
from protocol.frames import CameraModel, RgbdFrame
from protocol.images import encode_color, encode_depth
from protocol.limits import MAX_MESSAGE_BYTES, SUBPROTOCOL
from protocol.messages import (
    Acknowledged,
    Bye,
    ClientMessage,
    Composite,
    Dropped,
    Error,
    Frame,
    Hello,
    Light,
    MeshFormat,
    MeshPart,
    MoveObject,
    PlaceObject,
    Preset,
    Quality,
    RemoveObject,
    RequestMesh,
    ServerMessage,
    Vector3,
    Watch,
    Welcome,
    Wishes,
)

STREAM_PATH = "/v1/stream"
OPEN_PATIENCE_S = 10.0
UNREAD_ANSWERS = 16


class ClientError(Exception):
    """The server is absent, refuses, or has gone; one line that says which and what to do."""


@dataclass(frozen=True)
class Answer:
    """What the server made of one frame."""

    light: Light
    composite: Composite


@dataclass
class _MeshInbox:
    """The files of a mesh as their parts arrive."""

    request: int
    progress: Callable[[int, int], None]
    files: dict[MeshFormat, bytearray] = field(default_factory=dict)
    sizes: dict[MeshFormat, int] = field(default_factory=dict)

    def add(self, part: MeshPart) -> None:
        """Append a part. Raises ProtocolError for one that does not follow on."""
        data = self.files.setdefault(part.format, bytearray())
        size = self.sizes.setdefault(part.format, part.size_bytes)
        follows = part.request == self.request and part.size_bytes == size and part.offset == len(data)
        if not follows or len(data) + len(part.data) > size:
            raise ProtocolError(f"mesh_part at byte {part.offset} of {part.format} does not follow on")
        data += part.data
        self.progress(len(data), part.size_bytes)


Tap = Callable[[ClientMessage | ServerMessage], None]


class StreamClient:
    """One connection. Made by `connect`; then `hello` or `watch`; then read `answers` while sending.

    A task of its own reads the socket. Frames are to be sent by one task at a time.
    """

    def __init__(self, socket: ClientConnection, url: str, tap: Tap | None) -> None:
        self._socket = socket
        self._url = url
        self._tap = tap
        self._requests = count()
        self._camera: CameraModel | None = None
        self._lossless = False
        self._max_inflight = 1
        self._unanswered: set[int] = set()
        self._unread: deque[Answer | Dropped | Error] = deque()
        self._acknowledged: dict[int, Acknowledged] = {}
        self._mesh: _MeshInbox | None = None
        self._welcome: Welcome | None = None
        self._light: Light | None = None
        self._reason_given: str | None = None
        self._leaving = False
        self._ended = False
        self._failure: ClientError | None = None
        self._changed = asyncio.Condition()
        self._listening = asyncio.create_task(self._listen())

    @classmethod
    async def connect(cls, server_url: str, tap: Tap | None = None) -> StreamClient:
        """Open the socket of a server given as `http://host:port`, `ws://...` or `host:port`.

        `tap` is called with every message sent and received. Raises ClientError.
        """
        return cls(await _open(server_url), server_url, tap)

    async def hello(self, camera: CameraModel, wishes: Wishes | None = None, client: str = "probeless") -> Welcome:
        """Begin to capture; returns when the server has prepared the session. Raises ClientError if it refuses."""
        wishes = wishes or Wishes()
        self._camera, self._lossless = camera, wishes.lossless
        await self._send(Hello(client=client, camera=camera, wishes=wishes))
        return await self._wait_for_welcome()

    async def watch(self, session: str | None = None) -> Welcome:
        """Begin to watch a session, or the one that streams now or next. Raises ClientError if it is refused."""
        await self._send(Watch(session=session))
        return await self._wait_for_welcome()

    @property
    def has_room(self) -> bool:
        """Another frame may be sent without exceeding the server's window."""
        return len(self._unanswered) < self._max_inflight

    async def wait_for_room(self) -> None:
        """Wait until `has_room`. Raises ClientError when the server has gone."""
        await self._wait_until(lambda: self.has_room)

    async def wait_until_answered(self) -> None:
        """Wait until no frame is unanswered. Raises ClientError when the server has gone."""
        await self._wait_until(lambda: not self._unanswered)

    async def send_frame(self, frame: RgbdFrame) -> None:
        """Encode and send one frame, waiting for room in the window first. Raises ClientError.

        A session that wishes `lossless` sends raw colour, any other JPEG; depth is always bit-exact.
        """
        if self._camera is None:
            raise ClientError("a frame can only be sent after hello")
        await self.wait_for_room()
        self._unanswered.add(frame.index)
        message = await asyncio.to_thread(frame_message, frame, self._camera, self._lossless)
        await self._send(message)

    async def place_object(
        self,
        name: str,
        format_: str,
        data: bytes,
        position_m: Vector3 | None = None,
        scale: float = 1.0,
        yaw_deg: float = 0.0,
    ) -> Acknowledged:
        """Put a mesh file's bytes into the scene; the acknowledgement says in `error` what was wrong with it."""
        request = next(self._requests)
        return await self._ask(
            PlaceObject(
                request=request,
                object=name,
                format=format_,
                data=data,
                position_m=position_m,
                scale=scale,
                yaw_deg=yaw_deg,
            )
        )

    async def move_object(
        self, name: str, position_m: Vector3, scale: float = 1.0, yaw_deg: float = 0.0
    ) -> Acknowledged:
        """Move an object that was placed."""
        request = next(self._requests)
        return await self._ask(
            MoveObject(request=request, object=name, position_m=position_m, scale=scale, yaw_deg=yaw_deg)
        )

    async def remove_object(self, name: str) -> Acknowledged:
        """Take an object away."""
        return await self._ask(RemoveObject(request=next(self._requests), object=name))

    async def set_quality(
        self, preset: Preset, budget_ms: float | None = None, max_light_error_deg: float | None = None
    ) -> Acknowledged:
        """Change the preset of the running session; of `auto`, by what it is chosen. Raises ValueError."""
        chosen_by = {"budget_ms": budget_ms, "max_light_error_deg": max_light_error_deg}
        return await self._ask(Quality(request=next(self._requests), preset=preset, **chosen_by))

    async def request_mesh(
        self, progress: Callable[[int, int], None] = lambda _done, _total: None
    ) -> Mapping[MeshFormat, bytes]:
        """The files of the surface that the server has fused so far; `progress` is told bytes of each file.

        Raises ClientError where the server has none, or one that is too large.
        """
        request = next(self._requests)
        self._mesh = inbox = _MeshInbox(request, progress)
        done = await self._ask(RequestMesh(request=request))
        self._mesh = None
        if done.error is not None:
            raise ClientError(done.error)
        if not inbox.files or any(len(data) != inbox.sizes[format_] for format_, data in inbox.files.items()):
            raise ClientError(f"the server at {self._url} sent an incomplete mesh")
        return {format_: bytes(data) for format_, data in inbox.files.items()}

    async def answers(self) -> AsyncIterator[Answer | Dropped | Error]:
        """What comes back, in the order it came, until `close` or the server's end. Raises ClientError.

        An `Error` here is not fatal. Unread answers hold up the socket after a while: keep reading.
        """
        while True:
            async with self._changed:
                await self._changed.wait_for(lambda: self._unread or self._ended)
                self._changed.notify_all()
                if not self._unread:
                    break
                answer = self._unread.popleft()
            yield answer
        if self._failure is not None:
            raise self._failure

    async def close(self, reason: str = "") -> None:
        """Say bye and close; what has not arrived yet is lost."""
        self._leaving = True
        if not self._ended:
            with contextlib.suppress(ClientError):
                await self._send(Bye(reason=reason))
        await self._note_change()
        await self._socket.close()
        await self._listening

    async def _send(self, message: ClientMessage) -> None:
        """Encode and send. Raises ClientError."""
        try:
            data = encode(message)
            await self._socket.send(data)
        except ProtocolError as error:
            raise ClientError(str(error)) from error
        except ConnectionClosed as error:
            await self._listening  # what the server said last is still to be read
            raise self._failure or ClientError(f"the connection to {self._url} is closed") from error
        if self._tap is not None:
            self._tap(message)

    async def _ask(self, message: PlaceObject | MoveObject | RemoveObject | Quality | RequestMesh) -> Acknowledged:
        await self._send(message)
        await self._wait_until(lambda: message.request in self._acknowledged)
        return self._acknowledged.pop(message.request)

    async def _wait_for_welcome(self) -> Welcome:
        await self._wait_until(lambda: self._welcome is not None)
        assert self._welcome is not None
        return self._welcome

    async def _wait_until(self, holds: Callable[[], bool]) -> None:
        async with self._changed:
            await self._changed.wait_for(lambda: holds() or self._ended)
        if not holds():
            raise self._failure or ClientError(f"the connection to {self._url} is closed")

    async def _note_change(self) -> None:
        async with self._changed:
            self._changed.notify_all()

    async def _listen(self) -> None:
        """Take messages until the connection ends, and keep how it ended."""
        try:
            async for data in self._socket:
                await self._take(decode_server(data.encode() if isinstance(data, str) else data))
                await self._note_change()
        except ConnectionClosed as error:
            self._failure = None if self._leaving else self._explain(error)
        except ProtocolError as error:
            self._failure = ClientError(f"the server at {self._url} sent what is no message: {error}")
            await self._socket.close(1007)
        finally:
            self._ended = True
            await self._note_change()

    def _explain(self, error: ConnectionClosed) -> ClientError:
        reason = self._reason_given or (error.rcvd.reason if error.rcvd is not None else "")
        if error.rcvd is None:
            return ClientError(f"the server at {self._url} has gone: the connection was lost")
        return ClientError(f"the server at {self._url} closed the connection: {reason or f'code {error.rcvd.code}'}")

    async def _take(self, message: ServerMessage) -> None:
        if self._tap is not None:
            self._tap(message)
        match message:
            case Welcome():
                self._welcome = message
                self._max_inflight = message.max_inflight
            case Light():
                self._light = message
            case Composite() if self._light is not None:
                await self._deliver(Answer(self._light, message))
                self._unanswered.discard(message.frame)
            case Dropped():
                await self._deliver(message)
                self._unanswered.discard(message.frame)
            case MeshPart() if self._mesh is not None:
                self._mesh.add(message)
            case Acknowledged():
                self._acknowledged[message.request] = message
            case Error(fatal=False):
                await self._deliver(message)
            case Error() | Bye():
                self._reason_given = message.reason

    async def _deliver(self, answer: Answer | Dropped | Error) -> None:
        """Keep an answer for `answers`, once there is room for it."""
        async with self._changed:
            await self._changed.wait_for(lambda: len(self._unread) < UNREAD_ANSWERS or self._leaving)
            self._unread.append(answer)


def stream_url(server_url: str) -> str:
    """The socket's URL of a server given as `http(s)://host:port`, `ws(s)://host:port[/v1/stream]` or `host:port`."""
    parts = urlsplit(server_url if "://" in server_url else f"ws://{server_url}")
    scheme = {"http": "ws", "https": "wss"}.get(parts.scheme, parts.scheme)
    path = parts.path if parts.path.strip("/") else STREAM_PATH
    return f"{scheme}://{parts.netloc}{path}"


def frame_message(frame: RgbdFrame, camera: CameraModel, lossless: bool) -> Frame:
    """One frame as it goes over the wire: colour raw where every bit counts or is linear, else JPEG."""
    codec = "raw" if lossless or camera.color_encoding == "linear16" else "jpeg"
    pose = frame.world_from_camera
    return Frame(
        frame=frame.index,
        timestamp_s=frame.timestamp_s,
        world_from_camera=None if pose is None else tuple(pose.ravel().tolist()),
        color=encode_color(frame.color, codec, camera.color_encoding),
        depth=encode_depth(frame.depth),
        exposure=frame.exposure,
    )


async def _open(server_url: str) -> ClientConnection:
    """An open socket that speaks this version. Raises ClientError."""
    try:
        socket = await open_socket(
            stream_url(server_url),
            subprotocols=[Subprotocol(SUBPROTOCOL)],
            compression=None,
            max_size=MAX_MESSAGE_BYTES,
            open_timeout=OPEN_PATIENCE_S,
            proxy=None,
        )
    except (InvalidURI, ValueError) as error:
        raise ClientError(f"{server_url} is no server address: give http://HOST:PORT") from error
    except InvalidHandshake as error:
        raise ClientError(f"what answers at {server_url} is no probeless server ({error})") from error
    except (OSError, TimeoutError) as error:
        why = str(error) or "no answer"
        raise ClientError(f"no server at {server_url} ({why}): start one with: probeless serve") from error
    if socket.subprotocol != SUBPROTOCOL:
        await socket.close()
        raise ClientError(f"what answers at {server_url} does not speak {SUBPROTOCOL}: use the same version on both")
    return socket

"""The client's end of the socket: an async class that any capturing or watching program can use."""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import count
from typing import TypeGuard

from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosed

from client.streaming.access import Access, stream_url, without_query
from client.streaming.coding import DEFAULT_CODING, Coding, frame_message
from client.streaming.opening import ClientError, open_client_socket
from client.streaming.video import VideoEncoder
from protocol.codec import ProtocolError, decode_server, encode
from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import (
    Acknowledged,
    Bye,
    ClientMessage,
    Composite,
    Dropped,
    Error,
    Frame,
    Hello,
    Layer,
    Light,
    Marker,
    MeshFormat,
    MeshPart,
    MoveObject,
    ObjectFormat,
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

__all__ = ["Access", "Answer", "ClientError", "Coding", "RoomPlace", "StreamClient", "frame_message", "stream_url"]

KEEP_S = 30.0
"""For which the server keeps a session whose connection is lost, and a client tries to come back."""
RETRY_S = (0.05, 0.1, 0.2, 0.4, 0.8)
"""Between tries; the last again and again."""
GONE, TRY_LATER = 4410, 1013
RESTART, KEEPALIVE = 1012, 1011
UNREAD_ANSWERS = 16


@dataclass(frozen=True)
class Answer:
    """What the server made of one frame."""

    light: Light
    composite: Composite | None = None
    """As `wishes.answer` is where nothing is said."""
    layer: Layer | None = None
    """Where it is `layer`."""

    @property
    def drawn(self) -> Composite | Layer | None:
        """None: the light is the whole answer."""
        return self.layer if self.composite is None else self.composite


@dataclass
class _MeshInbox:
    """The files of a mesh as their parts arrive."""

    request: int
    progress: Callable[[int, int], None]
    files: dict[MeshFormat, bytearray] = field(default_factory=dict)
    sizes: dict[MeshFormat, int] = field(default_factory=dict)

    def begin_anew(self) -> None:
        """The files are sent again."""
        self.files.clear()
        self.sizes.clear()

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
Request = PlaceObject | MoveObject | RemoveObject | Quality | RequestMesh


@dataclass(frozen=True)
class RoomPlace:
    """The room that a client joins, and what it says of its world's place there (see `Hello`)."""

    name: str
    key: str | None = None
    room_from_world: tuple[float, ...] | None = None
    marker: Marker | None = None


class StreamClient:
    """One session. Made by `connect`; then `hello` or `watch`; then read `answers` while sending.

    A task of its own reads the socket. Frames are to be sent by one task at a time. A capturing client whose connection
    is lost comes back by itself and goes on: what it asked for is done once, and frames that were on the way are told
    as dropped, or in a lossless session sent again.
    """

    def __init__(self, socket: ClientConnection, server_url: str, access: Access, tap: Tap | None) -> None:
        self._socket = socket
        self._server_url = server_url
        self._access = access
        self._url = without_query(server_url)
        self._tap = tap
        self._hello: Hello | None = None
        self._is_connected = True
        self.reconnected = 0
        """Times that a lost connection was restored."""
        self.video: VideoEncoder | None = None
        """By which colour is sent; to be set after `hello`, where `welcome.codecs` has `h264`."""
        self._requests = count()
        self._max_inflight = 1
        self._unanswered: dict[int, Frame | None] = {}
        """By number; what was sent only where the session is lossless."""
        self._lost: set[int] = set()
        """Frames that a connection took along; late answers to them are none."""
        self._unacknowledged: dict[int, Request] = {}
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
    async def connect(cls, server_url: str, tap: Tap | None = None, access: Access | None = None) -> StreamClient:
        """Open the socket of a server given as `http(s)://host:port[/?token=...]`, `ws(s)://...` or `host:port`.

        `tap` is called with every message sent and received. Raises ClientError.
        """
        socket = await open_client_socket(server_url, access or Access())
        return cls(socket, server_url, access or Access(), tap)

    async def hello(
        self,
        camera: CameraModel,
        wishes: Wishes | None = None,
        client: str = "probeless",
        room: RoomPlace | None = None,
        keep_s: float = KEEP_S,
    ) -> Welcome:
        """Begin to capture; returns when the server has prepared the session. Raises ClientError if it refuses.

        `room`: to share with others. `keep_s`: for how long a lost connection may be restored.
        """
        place = room or RoomPlace("")
        self._hello = Hello(
            client=client,
            camera=camera,
            wishes=wishes or Wishes(),
            room=place.name or None,
            room_key=place.key,
            room_from_world=place.room_from_world,
            marker=place.marker,
            keep_s=keep_s,
        )
        await self._send(self._hello)
        return await self._wait_for_welcome()

    async def watch(self, session: str | None = None, room: str | None = None, room_key: str | None = None) -> Welcome:
        """Begin to watch a session, or the one that streams now or next. Raises ClientError if it is refused."""
        await self._send(Watch(session=session, room=room, room_key=room_key))
        return await self._wait_for_welcome()

    @property
    def unanswered(self) -> int:
        """Frames that were sent and have no answer yet."""
        return len(self._unanswered)

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

    async def ping(self) -> float:
        """Seconds that an empty message takes there and back. Raises ClientError."""
        try:
            return await (await self._socket.ping())
        except ConnectionClosed as error:
            raise ClientError(f"the connection to {self._url} is closed") from error

    async def send_frame(self, frame: RgbdFrame, coding: Coding = DEFAULT_CODING) -> None:
        """Encode and send one frame, waiting for room in the window first. Raises ClientError.

        A session that wishes `lossless` sends raw colour and exact depth, any other JPEG and depth as `coding` says.
        """
        await self.wait_for_room()
        await self.send_encoded(await self.encode_frame(frame, coding))

    async def encode_frame(self, frame: RgbdFrame, coding: Coding = DEFAULT_CODING) -> Frame:
        """A frame as `send_frame` sends it, encoded in a thread of its own. Raises ClientError before `hello`."""
        if self._hello is None:
            raise ClientError("a frame can only be sent after hello")
        lossless = self._hello.wishes.lossless
        if self._welcome is not None and coding.depth_codec not in self._welcome.depth_codecs:
            coding = replace(coding, depth_codec="zstd-delta")  # a server of before
        return await asyncio.to_thread(frame_message, frame, self._hello.camera, lossless, coding, self.video)

    async def send_encoded(self, message: Frame) -> None:
        """Send what `encode_frame` made, waiting for room in the window first. Raises ClientError."""
        if self._hello is None:
            raise ClientError("a frame can only be sent after hello")
        await self.wait_for_room()
        await self._wait_until(lambda: self._is_connected)
        self._unanswered[message.frame] = message if self._hello.wishes.lossless else None
        await self._send(message)

    async def place_object(
        self,
        name: str,
        format_: ObjectFormat,
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
        """Encode and send; while the connection is lost, once it is restored. Raises ClientError."""
        try:
            data = encode(message)
        except ProtocolError as error:
            raise ClientError(str(error)) from error
        await self._wait_until(lambda: self._is_connected)
        if isinstance(message, Frame) and self._hello is not None:  # from now on it is answered, or told to be lost
            self._unanswered[message.frame] = message if self._hello.wishes.lossless else None
        socket = self._socket
        try:
            await socket.send(data)
        except ConnectionClosed as error:
            if not await self._is_sent_again(socket):
                raise self._failure or ClientError(f"the connection to {self._url} is closed") from error
        if self._tap is not None:
            self._tap(message)

    async def _is_sent_again(self, socket: ClientConnection) -> bool:
        """After a socket broke: whether another one took its place, by which all that matters is sent once more."""
        async with self._changed:
            await self._changed.wait_for(lambda: self._ended or (self._is_connected and self._socket is not socket))
        return not self._ended

    async def _ask(self, message: Request) -> Acknowledged:
        self._unacknowledged[message.request] = message
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
        """Take messages until the session ends, and keep how it ended."""
        try:
            while True:
                try:
                    async for data in self._socket:
                        await self._take(decode_server(data.encode() if isinstance(data, str) else data))
                        await self._note_change()
                    break
                except ConnectionClosed as error:
                    if self._leaving:
                        break
                    if not self._is_lost(error):
                        self._failure = self._explain(error)
                        break
                    await self._restore(self._explain(error))
        except ClientError as error:
            self._failure = error
        except ProtocolError as error:
            self._failure = ClientError(f"the server at {self._url} sent what is no message: {error}")
            await self._socket.close(1007)
        finally:
            self._ended = True
            await self._note_change()

    def _is_lost(self, error: ConnectionClosed) -> bool:
        """Whether a session that is kept lost its connection."""
        if self._hello is None or self._welcome is None or self._welcome.key is None:
            return False
        if error.rcvd is None or (error.rcvd.code == KEEPALIVE and "keepalive" in error.rcvd.reason):
            return True
        return error.rcvd.code == RESTART and self._hello.room is not None

    async def _restore(self, lost: ClientError) -> None:
        """Come back by another connection. Raises ClientError where the server does not want that, or is not there."""
        assert self._hello is not None
        assert self._welcome is not None
        self._is_connected = False
        until_s = asyncio.get_running_loop().time() + self._hello.keep_s
        hello = Hello(client=self._hello.client, camera=self._hello.camera, resume=self._welcome.key)
        for tries in count():
            if self._leaving or asyncio.get_running_loop().time() > until_s:
                raise ClientError(f"{lost}, and could not be restored")
            try:
                socket = await open_client_socket(self._server_url, self._access)
                welcome = await self._greeted(socket, hello)
            except ConnectionClosed as refused:
                code = None if refused.rcvd is None else refused.rcvd.code
                if code == GONE and self._hello.room is not None:
                    hello = self._hello  # the room outlives its sessions
                elif code is not None and code not in (TRY_LATER, RESTART):
                    raise self._explain(refused) from refused
            except (ClientError, TimeoutError):
                pass  # not there yet
            else:
                await self._go_on(socket, welcome)
                return
            await asyncio.sleep(RETRY_S[min(tries, len(RETRY_S) - 1)])

    async def _greeted(self, socket: ClientConnection, hello: Hello) -> Welcome:
        """The answer to `hello`. Raises ConnectionClosed, TimeoutError, ProtocolError."""
        async with asyncio.timeout(KEEP_S):
            await socket.send(encode(hello))
            while True:
                data = await socket.recv()
                match decode_server(data.encode() if isinstance(data, str) else data):
                    case Welcome() as welcome:
                        return welcome
                    case Error() as error:
                        self._reason_given = error.reason

    async def _go_on(self, socket: ClientConnection, welcome: Welcome) -> None:
        """Take the new connection, and send what has no answer yet again."""
        self._socket, self._welcome, self._reason_given = socket, welcome, None
        if self.video is not None:
            self.video.need_key()
        if self._mesh is not None:
            self._mesh.begin_anew()
        for request in self._unacknowledged.values():
            await socket.send(encode(request))
        for number, frame in list(self._unanswered.items()):
            if frame is None:
                del self._unanswered[number]
                self._lost.add(number)
                self._unread.append(Dropped(frame=number, reason="lost with the connection, which was restored"))
            else:
                await socket.send(encode(frame))
        self.reconnected += 1
        self._is_connected = True
        await self._note_change()

    def _explain(self, error: ConnectionClosed) -> ClientError:
        reason = self._reason_given or (error.rcvd.reason if error.rcvd is not None else "")
        if error.rcvd is None:
            return ClientError(f"the server at {self._url} has gone: the connection was lost")
        if error.rcvd.code == RESTART and self._hello is not None and self._hello.room is None:
            reason = f"{reason}; a session without a room ends with its server"
        return ClientError(f"the server at {self._url} closed the connection: {reason or f'code {error.rcvd.code}'}")

    def _ends_answer(self, message: ServerMessage) -> TypeGuard[Composite | Layer | Light | Dropped]:
        """Whether nothing else comes for its frame."""
        if isinstance(message, Light):
            return self._expects_light_only
        return isinstance(message, Composite | Layer | Dropped)

    @property
    def _expects_light_only(self) -> bool:
        return self._hello is not None and self._hello.wishes.answer == "light"

    async def _take(self, message: ServerMessage) -> None:
        if self._tap is not None:
            self._tap(message)
        if self._ends_answer(message) and message.frame in self._lost:
            self._lost.discard(message.frame)  # it was still worked on, but is told to be lost already
            return
        match message:
            case Welcome():
                self._welcome = message
                self._max_inflight = message.max_inflight
            case Light():
                self._light = message
                if self._expects_light_only:
                    await self._finish(message.frame, Answer(message))
            case Composite() if self._light is not None:
                await self._finish(message.frame, Answer(self._light, composite=message))
            case Layer() if self._light is not None:
                await self._finish(message.frame, Answer(self._light, layer=message))
            case Dropped():
                await self._finish(message.frame, message)
            case MeshPart() if self._mesh is not None:
                self._mesh.add(message)
            case Acknowledged() if message.request in self._unacknowledged:
                del self._unacknowledged[message.request]
                self._acknowledged[message.request] = message
            case Error(fatal=False):
                await self._deliver(message)
            case Error() | Bye():
                self._reason_given = message.reason

    async def _finish(self, frame: int, answer: Answer | Dropped) -> None:
        """Deliver the last message about a frame."""
        await self._deliver(answer)
        self._unanswered.pop(frame, None)

    async def _deliver(self, answer: Answer | Dropped | Error) -> None:
        """Keep an answer for `answers`, once there is room for it."""
        if isinstance(answer, Dropped) and self.video is not None:
            self.video.need_key()
        async with self._changed:
            await self._changed.wait_for(lambda: len(self._unread) < UNREAD_ANSWERS or self._leaving)
            self._unread.append(answer)

"""Asynchronous client of the protocol, for programs that capture or watch."""

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
from protocol.limits import FEW_INFLIGHT
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
    Panorama,
    PanoramaFormat,
    PlaceObject,
    Preset,
    Quality,
    RemoveObject,
    RequestMesh,
    RequestPanorama,
    ServerMessage,
    Spot,
    Vector3,
    Watch,
    Welcome,
    Wishes,
)

__all__ = ["Access", "Answer", "ClientError", "Coding", "RoomPlace", "StreamClient", "frame_message", "stream_url"]

KEEP_S = 30.0
"""How long the server keeps a session without a connection, and the client tries to reconnect."""
RETRY_S = (0.05, 0.1, 0.2, 0.4, 0.8)
"""Delays between attempts to reconnect; the last is repeated."""
GONE, TRY_LATER = 4410, 1013
RESTART, KEEPALIVE = 1012, 1011
UNREAD_ANSWERS = 16


@dataclass(frozen=True)
class Answer:
    """The server's answer to one frame."""

    light: Light
    composite: Composite | None = None
    """Set if `wishes.answer` is `picture`."""
    layer: Layer | None = None
    """Set if `wishes.answer` is `layer`."""

    @property
    def drawn(self) -> Composite | Layer | None:
        """The composite or layer; None if the answer is only a light."""
        return self.layer if self.composite is None else self.composite


@dataclass
class _MeshInbox:
    """Collects the parts of requested mesh files."""

    request: int
    progress: Callable[[int, int], None]
    files: dict[MeshFormat, bytearray] = field(default_factory=dict)
    sizes: dict[MeshFormat, int] = field(default_factory=dict)

    def restart(self) -> None:
        """Discard all parts; the server sends the files again."""
        self.files.clear()
        self.sizes.clear()

    def add(self, part: MeshPart) -> None:
        """Append a part. Raises ProtocolError if it is not the next one."""
        data = self.files.setdefault(part.format, bytearray())
        size = self.sizes.setdefault(part.format, part.size_bytes)
        is_next = part.request == self.request and part.size_bytes == size and part.offset == len(data)
        if not is_next or len(data) + len(part.data) > size:
            raise ProtocolError(f"mesh_part at byte {part.offset} of {part.format} does not follow on")
        data += part.data
        self.progress(len(data), part.size_bytes)


Tap = Callable[[ClientMessage | ServerMessage], None]
Request = PlaceObject | MoveObject | RemoveObject | Quality | RequestMesh | RequestPanorama


@dataclass(frozen=True)
class RoomPlace:
    """The room to join and the pose of the client's world in it (see `Hello`)."""

    name: str
    key: str | None = None
    room_from_world: tuple[float, ...] | None = None
    marker: Marker | None = None


class StreamClient:
    """One session: `connect`, then `hello` or `watch`, then read `answers` while sending.

    A background task reads the socket. Only one task may send frames at a time. A capturing client reconnects after a
    lost connection: each request is executed once; unanswered frames are reported as `Dropped`, or sent again in a
    lossless session.
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
        """Number of reconnections."""
        self.video: VideoEncoder | None = None
        """Encoder of colour; set it after `hello`, if `welcome.codecs` contains `h264`."""
        self._requests = count()
        self._max_inflight = 1
        self._unanswered: dict[int, Frame | None] = {}
        """By frame number; the message is kept only in a lossless session."""
        self._lost: set[int] = set()
        """Frames lost with a connection; late answers to them are ignored."""
        self._unacknowledged: dict[int, Request] = {}
        self._unread: deque[Answer | Dropped | Error] = deque()
        self._acknowledged: dict[int, Acknowledged] = {}
        self._mesh: _MeshInbox | None = None
        self._panoramas: dict[int, Panorama] = {}
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
        """Connect to a server given as `http(s)://host:port[/?token=...]`, `ws(s)://...` or `host:port`.

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
        max_inflight: int = FEW_INFLIGHT,
    ) -> Welcome:
        """Begin to capture; returns when the server has prepared the session. Raises ClientError if it refuses.

        `room`: the room to share; None: a room of its own. `keep_s`: how long the session survives a lost connection.
        `max_inflight`: how many frames may be unanswered, 1 to 8; more than 2 only with pacing (`adaptive`).
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
            max_inflight=max_inflight,
        )
        await self._send(self._hello)
        return await self._wait_for_welcome()

    async def watch(self, session: str | None = None, room: str | None = None, room_key: str | None = None) -> Welcome:
        """Watch a session; default: the one that streams now or next. Raises ClientError if the server refuses."""
        await self._send(Watch(session=session, room=room, room_key=room_key))
        return await self._wait_for_welcome()

    @property
    def unanswered(self) -> int:
        """Number of frames without an answer."""
        return len(self._unanswered)

    @property
    def has_room(self) -> bool:
        """Whether another frame fits the server's window."""
        return len(self._unanswered) < self._max_inflight

    async def wait_for_room(self) -> None:
        """Wait until `has_room`. Raises ClientError if the session ends."""
        await self._wait_until(lambda: self.has_room)

    async def wait_until_answered(self) -> None:
        """Wait until all frames are answered. Raises ClientError if the session ends."""
        await self._wait_until(lambda: not self._unanswered)

    async def ping(self) -> float:
        """Round trip of an empty message in seconds. Raises ClientError."""
        try:
            return await (await self._socket.ping())
        except ConnectionClosed as error:
            raise ClientError(f"the connection to {self._url} is closed") from error

    async def send_frame(self, frame: RgbdFrame, coding: Coding = DEFAULT_CODING) -> None:
        """Encode one frame, wait until it fits the window, and send it. Raises ClientError.

        A lossless session sends raw colour and exact depth and ignores `coding`.
        """
        await self.wait_for_room()
        await self.send_encoded(await self.encode_frame(frame, coding))

    async def encode_frame(self, frame: RgbdFrame, coding: Coding = DEFAULT_CODING) -> Frame:
        """Encode a frame as `send_frame` does, in another thread. Raises ClientError before `hello`."""
        if self._hello is None:
            raise ClientError("a frame can only be sent after hello")
        lossless = self._hello.wishes.lossless
        if self._welcome is not None and coding.depth_codec not in self._welcome.depth_codecs:
            coding = replace(coding, depth_codec="zstd-delta")  # an earlier server
        return await asyncio.to_thread(frame_message, frame, self._hello.camera, lossless, coding, self.video)

    async def send_encoded(self, message: Frame) -> None:
        """Wait until the window has room, and send a message of `encode_frame`. Raises ClientError."""
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
        *,
        spot: Spot | None = None,
        height_m: float | None = None,
    ) -> Acknowledged:
        """Place the mesh file `data` in the scene; `error` of the acknowledgement says why it was refused.

        `spot`: in place of a position, a place that the server finds in the next frame that shows it, whose notes say
        where. `height_m` is in place of `scale`.
        """
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
                spot=spot,
                height_m=height_m,
            )
        )

    async def move_object(
        self, name: str, position_m: Vector3, scale: float = 1.0, yaw_deg: float = 0.0
    ) -> Acknowledged:
        """Move a placed object."""
        request = next(self._requests)
        return await self._ask(
            MoveObject(request=request, object=name, position_m=position_m, scale=scale, yaw_deg=yaw_deg)
        )

    async def remove_object(self, name: str) -> Acknowledged:
        """Remove an object."""
        return await self._ask(RemoveObject(request=next(self._requests), object=name))

    async def set_quality(
        self, preset: Preset, budget_ms: float | None = None, max_light_error_deg: float | None = None
    ) -> Acknowledged:
        """Change the preset of the session; the limits are for `auto`. Raises ValueError."""
        request = next(self._requests)
        return await self._ask(
            Quality(request=request, preset=preset, budget_ms=budget_ms, max_light_error_deg=max_light_error_deg)
        )

    async def request_mesh(
        self, progress: Callable[[int, int], None] = lambda _done, _total: None
    ) -> Mapping[MeshFormat, bytes]:
        """Mesh files of the surface fused so far; `progress` receives bytes done and total of each file.

        Raises ClientError if there is no surface, or if it is too large.
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

    async def request_panorama(self, format_: PanoramaFormat, position_m: Vector3 | None = None) -> Panorama:
        """The light that arrives at a place as a lat-long file, after the frames sent so far.

        `position_m`: world; None: the first virtual object, else the middle of what the last frame sees. Raises
        ClientError if there is no light yet.
        """
        request = next(self._requests)
        done = await self._ask(RequestPanorama(request=request, format=format_, position_m=position_m))
        panorama = self._panoramas.pop(request, None)
        if done.error is not None or panorama is None:
            raise ClientError(done.error or f"the server at {self._url} acknowledged a panorama and sent none")
        return panorama

    async def answers(self) -> AsyncIterator[Answer | Dropped | Error]:
        """Answers in the order of arrival, until `close` or the end of the session. Raises ClientError.

        An `Error` here is not fatal. Keep reading: too many unread answers block the socket.
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
        """Send `Bye` and close; answers that have not arrived are lost."""
        self._leaving = True
        if not self._ended:
            with contextlib.suppress(ClientError):
                await self._send(Bye(reason=reason))
        await self._note_change()
        await self._socket.close()
        await self._listening

    async def _send(self, message: ClientMessage) -> None:
        """Encode and send, after reconnecting if the connection is lost. Raises ClientError."""
        try:
            data = encode(message)
        except ProtocolError as error:
            raise ClientError(str(error)) from error
        await self._wait_until(lambda: self._is_connected)
        if isinstance(message, Frame) and self._hello is not None:  # from here on answered or reported as lost
            self._unanswered[message.frame] = message if self._hello.wishes.lossless else None
        socket = self._socket
        try:
            await socket.send(data)
        except ConnectionClosed as error:
            if not await self._is_resent(socket):
                raise self._failure or ClientError(f"the connection to {self._url} is closed") from error
        if self._tap is not None:
            self._tap(message)

    async def _is_resent(self, socket: ClientConnection) -> bool:
        """Wait for the reconnection after `socket` broke, which sends everything again; False if the session ended."""
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
        """Handle messages until the session ends, and store its failure."""
        try:
            while True:
                try:
                    async for data in self._socket:
                        await self._handle(decode_server(data.encode() if isinstance(data, str) else data))
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
        """Whether the connection broke in a way that allows to resume the session."""
        if self._hello is None or self._welcome is None or self._welcome.key is None:
            return False
        if error.rcvd is None or (error.rcvd.code == KEEPALIVE and "keepalive" in error.rcvd.reason):
            return True
        return error.rcvd.code == RESTART and self._hello.room is not None

    async def _restore(self, lost: ClientError) -> None:
        """Reconnect. Raises ClientError if the server refuses or stays unreachable."""
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
                welcome = await self._welcome_of(socket, hello)
            except ConnectionClosed as refused:
                code = None if refused.rcvd is None else refused.rcvd.code
                if code == GONE and self._hello.room is not None:
                    hello = self._hello  # the session is gone, the room is not: join it anew
                elif code is not None and code not in (TRY_LATER, RESTART):
                    raise self._explain(refused) from refused
            except (ClientError, TimeoutError):
                pass  # not reachable yet
            else:
                await self._resume(socket, welcome)
                return
            await asyncio.sleep(RETRY_S[min(tries, len(RETRY_S) - 1)])

    async def _welcome_of(self, socket: ClientConnection, hello: Hello) -> Welcome:
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

    async def _resume(self, socket: ClientConnection, welcome: Welcome) -> None:
        """Use the new connection and send unanswered requests again."""
        self._socket, self._welcome, self._reason_given = socket, welcome, None
        if self.video is not None:
            self.video.need_key()
        if self._mesh is not None:
            self._mesh.restart()
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
        """Whether this is the last message about its frame."""
        if isinstance(message, Light):
            return self._expects_light_only
        return isinstance(message, Composite | Layer | Dropped)

    @property
    def _expects_light_only(self) -> bool:
        return self._hello is not None and self._hello.wishes.answer == "light"

    async def _handle(self, message: ServerMessage) -> None:
        if self._tap is not None:
            self._tap(message)
        if self._ends_answer(message) and self._hello is not None and message.frame not in self._unanswered:
            self._lost.discard(message.frame)  # reported as lost, or sent again while its answer was on the way
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
            case Error(fatal=False):
                await self._deliver(message)
            case Error() | Bye():
                self._reason_given = message.reason
            case MeshPart() | Panorama() | Acknowledged():
                self._note_request(message)

    def _note_request(self, message: MeshPart | Panorama | Acknowledged) -> None:
        """Keep what answers a request until its sender takes it."""
        match message:
            case MeshPart() if self._mesh is not None:
                self._mesh.add(message)
            case Panorama() if message.request in self._unacknowledged:
                self._panoramas[message.request] = message
            case Acknowledged() if message.request in self._unacknowledged:
                del self._unacknowledged[message.request]
                self._acknowledged[message.request] = message

    async def _finish(self, frame: int, answer: Answer | Dropped) -> None:
        """Deliver the last message about a frame."""
        await self._deliver(answer)
        self._unanswered.pop(frame, None)

    async def _deliver(self, answer: Answer | Dropped | Error) -> None:
        """Queue an answer for `answers`; waits while the queue is full."""
        if isinstance(answer, Dropped) and self.video is not None:
            self.video.need_key()
        async with self._changed:
            await self._changed.wait_for(lambda: len(self._unread) < UNREAD_ANSWERS or self._leaving)
            self._unread.append(answer)

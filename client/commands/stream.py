"""`probeless stream`: a source over the socket at its own frame rate, and what comes back into a folder."""

from __future__ import annotations

import asyncio
import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from client.commands.stopping import stop_on_interrupt
from client.display.layers import decode_layer, put_over, shown_picture
from client.display.output_folder import FrameOutput, OutputWriter
from client.display.stream_statistics import STAGES, StreamFigures
from client.display.stream_view import StreamView
from client.errors import OutputError, SourceError
from client.objects.object_file import ObjectFile, pack_mesh
from client.sources.frame_source import ENDLESS, Source, is_live
from client.streaming.adaptive import Adaptive, Measured
from client.streaming.client import Access, Answer, ClientError, RoomPlace, StreamClient
from client.streaming.coding import Coding, picture_bytes
from client.streaming.video import IS_POSSIBLE, VideoEncoder
from protocol.frames import CameraModel
from protocol.images import Color, decode_color
from protocol.messages import (
    ClientMessage,
    Dropped,
    Error,
    Layer,
    MeshFormat,
    ObjectFormat,
    ServerMessage,
    Welcome,
    Wishes,
)
from protocol.recording import write_message

LOOK_S = 0.002
"""Between looks whether a camera's next frame may go."""


@dataclass
class StreamSummary:
    """What became of a source's frames."""

    server: str = ""
    device: str = ""
    session: str = ""
    sent: int = 0
    answered: int = 0
    skipped: int = 0
    """Not sent: the server was busy with earlier ones when their time came."""
    dropped: int = 0
    """Sent, and refused or replaced by the server."""
    seconds: float = 0.0
    """From the first frame's sending to the last answer."""
    first_picture_s: float = math.nan
    """From connecting until the first answer was shown."""
    reconnected: int = 0
    latency_ms: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """p50 and p99 of the last frames, by `stream_figures.STAGES`."""


@dataclass(frozen=True)
class Sending:
    """How frames are sent and shown."""

    adapts: bool = True
    """Quality, size and rate follow the link; of `realtime` only."""
    depth_noise_per_m: float | None = None
    """Depth may be moved by this times z^2 (metres); None: it is sent bit for bit."""
    view: bool = False
    """The picture in the terminal."""
    video: bool = False
    """Colour goes as H.264; not in a lossless session."""


def stream(
    source: Source,
    server_url: str,
    objects: Sequence[ObjectFile] = (),
    wishes: Wishes | None = None,
    out: Path | None = None,
    lossless: bool = False,
    record: Path | None = None,
    realtime: bool = True,
    *,
    frames: range | None = None,
    mesh: bool = False,
    room: RoomPlace | None = None,
    access: Access | None = None,
    sending: Sending | None = None,
    console: Console | None = None,
) -> StreamSummary:
    """Send `frames` of the source (default: all) to the server and write its answers into `out`, where one is given.

    `realtime` keeps the source's frame rate and skips frames while the server is busy; without it every frame is sent
    as soon as there is room. `lossless` sends raw colour and waits for each answer, so that every frame is answered
    with the very pixels of the server's picture. `mesh` asks for the scene's mesh after the last answer and writes it
    into `out`. `record` gets every message sent and received. `room`: to share with others. `access`: what lets the
    client in, if not the URL. `sending`: what may be left out on the way.
    Raises ClientError, UserError, each with one clear line. Progress goes to `console` (default: standard error).
    """
    wishes = msgspec.structs.replace(wishes or Wishes(), lossless=lossless)
    others = (realtime and not lossless, mesh, room, access, sending or Sending())
    job = _Job(source, frames or range(len(source)), server_url, objects, wishes, *others)
    console = console or Console(stderr=True)
    with _recorder(record) as tap, contextlib.ExitStack() as stack:
        stopping = stack.enter_context(stop_on_interrupt(is_live(source)))
        writer = stack.enter_context(OutputWriter(out)) if out is not None else None
        figures, progress = StreamFigures(), _progress(console)
        view = stack.enter_context(StreamView(console, progress, figures, job.sending.view))
        return asyncio.run(_Stream(job, writer, progress, stopping, figures, view).run(tap))


@dataclass(frozen=True)
class _Job:
    """What is to be sent, where and how."""

    source: Source
    frames: range
    server_url: str
    objects: Sequence[ObjectFile]
    wishes: Wishes
    realtime: bool
    mesh: bool
    room: RoomPlace | None
    access: Access | None
    sending: Sending


class _Stream:
    """One connection's sending and receiving, side by side on one event loop."""

    def __init__(
        self,
        job: _Job,
        writer: OutputWriter | None,
        progress: Progress,
        stopping: threading.Event,
        figures: StreamFigures,
        view: StreamView,
    ) -> None:
        self._job = job
        self._writer = writer
        self._progress = progress
        self._stopping, self._figures, self._view = stopping, figures, view
        self._adaptive = _adaptive(job, math.inf)
        self._fixed = Coding(depth_noise_per_m=job.sending.depth_noise_per_m)
        self._out: dict[int, tuple[float, int]] = {}
        """When each frame without an answer was sent, and its bytes."""
        self._pictures: dict[int, Color] = {}
        """Of frames without an answer, for what is put over them here."""
        self._last_sent_s = -math.inf
        self._began_s = 0.0
        total = None if job.frames.stop >= ENDLESS else len(job.frames)
        self._bar = progress.add_task(job.source.name, total=total, note="connecting")
        self._summary = StreamSummary()
        self._told: set[str] = set()

    async def run(self, tap: Callable[[ClientMessage | ServerMessage], None] | None) -> StreamSummary:
        meshes = [pack_mesh(item.path) for item in self._job.objects]  # a bad file is told before anything is sent
        self._began_s = time.perf_counter()
        client = await StreamClient.connect(self._job.server_url, tap, self._job.access)
        try:
            job = self._job
            welcome = await client.hello(job.source.camera, job.wishes, "probeless stream", job.room)
            self._note_welcome(welcome)
            if job.sending.video and not job.wishes.lossless:
                client.video = open_video(welcome)
                self._view.codec = "H.264"
            await self._place_objects(client, meshes)
            if self._adaptive is not None:
                self._adaptive = _adaptive(job, await client.ping())
            await self._exchange(client)
        finally:
            await client.close("the source has ended")
        found = {stage: self._figures.percentiles(stage) for stage in STAGES}
        self._summary.latency_ms = {stage: pair for stage, pair in found.items() if pair is not None}
        return self._summary

    def _note_welcome(self, welcome: Welcome) -> None:
        self._summary.server, self._summary.device = welcome.server, welcome.device
        self._summary.session = welcome.session

    async def _place_objects(self, client: StreamClient, meshes: list[tuple[ObjectFormat, bytes]]) -> None:
        for number, (item, (format_, data)) in enumerate(zip(self._job.objects, meshes, strict=True)):
            name = f"object-{number}" if self._job.room is None else f"{self._summary.session}-object-{number}"
            done = await client.place_object(name, format_, data, item.position_m, item.scale, item.yaw_deg)
            if done.error is not None:
                raise ClientError(f"{item.path}: {done.error}")
            for note in done.notes:
                self._tell(f"{item.path.name}: {note}")

    async def _exchange(self, client: StreamClient) -> None:
        """Send all frames while reading answers; ends when the last frame is answered."""
        start_s = time.perf_counter()
        receiving = asyncio.create_task(self._receive(client))
        sending = asyncio.create_task(self._send(client))
        try:
            await asyncio.wait((receiving, sending), return_when=asyncio.FIRST_COMPLETED)
            if not receiving.done():
                await client.close("the source has ended")
            await receiving
            await sending
        finally:
            receiving.cancel()
            sending.cancel()
            await asyncio.gather(receiving, sending, return_exceptions=True)
        self._summary.seconds = time.perf_counter() - start_s

    async def _send(self, client: StreamClient) -> None:
        """Send all frames and wait for the last answer; also where the source is damaged on the way."""
        try:
            await (self._send_live(client) if is_live(self._job.source) else self._send_frames(client))
        except SourceError:
            await client.wait_until_answered()
            raise
        await client.wait_until_answered()
        if self._job.mesh:
            await self._fetch_mesh(client)

    async def _send_frames(self, client: StreamClient) -> None:
        start_s = time.perf_counter()
        for number, position in enumerate(self._job.frames):
            if self._job.realtime:
                await asyncio.sleep(start_s + number / self._job.source.fps - time.perf_counter())
                if not self._may_send(client):
                    self._summary.skipped += 1
                    self._advance()
                    continue
            await self._send_one(client, position)

    def _may_send(self, client: StreamClient) -> bool:
        """Whether the server and the link are free for a frame: it would grow old waiting for them."""
        if self._adaptive is None or not client.has_room:
            return client.has_room
        return self._adaptive.may_send(time.perf_counter(), self._last_sent_s, client.unanswered)

    async def _send_one(self, client: StreamClient, position: int) -> None:
        frame = await asyncio.to_thread(self._job.source.__getitem__, position)
        captured_s = time.perf_counter()
        coding = self._fixed if self._adaptive is None else self._adaptive.coding
        message = await client.encode_frame(frame, coding)
        sent_s = self._last_sent_s = time.perf_counter()
        size = picture_bytes(message)
        self._out[frame.index] = sent_s, size
        if self._job.wishes.answer == "layer":
            self._pictures[frame.index] = frame.color
        self._figures.note_sent(frame.index, captured_s, sent_s, size)
        await client.send_encoded(message)
        self._summary.sent += 1
        if self._job.wishes.lossless:
            await client.wait_until_answered()

    async def _send_live(self, client: StreamClient) -> None:
        """Whenever there is room, the newest frame of a camera, until Ctrl-C or the last that was asked for."""
        for position in self._job.frames:
            await client.wait_for_room()
            if self._stopping.is_set():
                return
            while not self._may_send(client) and not self._stopping.is_set():
                await asyncio.sleep(LOOK_S)
            await self._send_one(client, position)
            self._summary.skipped = getattr(self._job.source, "missed", 0)

    async def _fetch_mesh(self, client: StreamClient) -> None:
        bar = self._progress.add_task("mesh", total=None, note="the server makes it")

        def show(done: int, total: int) -> None:
            self._progress.update(bar, completed=done, total=total, note="bytes of each file")

        files: Mapping[MeshFormat, bytes] = await client.request_mesh(show)
        if self._writer is not None:
            await asyncio.to_thread(self._writer.write_mesh, files)

    async def _receive(self, client: StreamClient) -> None:
        async for answer in client.answers():
            match answer:
                case Answer():
                    await self._keep(answer, client.reconnected)
                case Dropped():
                    self._note_dropped(answer)
                case Error():
                    self._tell(answer.reason)

    async def _keep(self, answer: Answer, reconnected: int) -> None:
        returned_s = time.perf_counter()
        drawn, size = answer.drawn, answer_bytes(answer)
        computed_s = 0.0 if drawn is None else drawn.timings.total / 1e3
        if self._adaptive is not None:
            waited_s = None if drawn is None or not drawn.waited_ms else drawn.waited_ms / 1e3
            measured = Measured(0.0, returned_s, computed_s, 0, bytes_down=size, waited_s=waited_s)
            self._measure(answer.light.frame, measured, reconnected)
        picture = await asyncio.to_thread(self._kept_picture, answer)
        coding = self._fixed if self._adaptive is None else self._adaptive.coding
        shown_s = time.perf_counter()
        if not self._summary.answered:
            self._summary.first_picture_s = shown_s - self._began_s
        self._view.show(shown_s, answer.light, drawn, picture, coding, reconnected)
        waited_ms = 0.0 if drawn is None else drawn.waited_ms
        self._figures.note_answer(answer.light.frame, returned_s, shown_s, computed_s, size, waited_ms / 1e3)
        for note in () if drawn is None else drawn.notes:
            self._tell(note)
        self._summary.answered += 1
        self._advance()

    def _kept_picture(self, answer: Answer) -> NDArray[np.uint8] | None:
        """Write an answer where there is a folder; its picture, where it has one that is wanted."""
        own = self._pictures.pop(answer.light.frame, None)
        if answer.drawn is None:
            if self._writer is not None:
                self._writer.write_light(answer.light)
            return None
        if self._writer is None and not self._view.wants_pictures:
            return None
        output = frame_output(answer, self._job.source.camera, own)
        if self._writer is not None:
            self._writer.write(output)
        return output.color

    def _measure(self, number: int, answered: Measured, reconnected: int) -> None:
        """Tell what the frame's way was like; when and with how many bytes it was sent is known here."""
        assert self._adaptive is not None
        if reconnected != self._summary.reconnected:
            self._summary.reconnected = reconnected
            self._adaptive.note_lost()
            self._out.clear()
        sent = self._out.pop(number, None)
        if sent is not None:
            self._adaptive.note(replace(answered, sent_s=sent[0], bytes_up=sent[1]))

    def _note_dropped(self, dropped: Dropped) -> None:
        if self._job.wishes.lossless:
            raise ClientError(f"frame {dropped.frame}: {dropped.reason}")
        self._summary.dropped += 1
        self._out.pop(dropped.frame, None)
        self._pictures.pop(dropped.frame, None)
        self._figures.forget(dropped.frame)
        self._tell(f"frame {dropped.frame}: {dropped.reason}")
        self._advance()

    def _advance(self) -> None:
        done = self._summary
        note = f"{done.answered} answered, {done.skipped} skipped, {done.dropped} dropped"
        self._progress.update(self._bar, advance=1, note=note)

    def _tell(self, line: str) -> None:
        if line not in self._told:
            self._told.add(line)
            self._progress.console.print(line, markup=False, highlight=False, soft_wrap=True)


def open_video(welcome: Welcome) -> VideoEncoder:
    """What colour is sent with. Raises ClientError where either side has no PyAV."""
    if "h264" not in welcome.codecs:
        raise ClientError(
            f"{welcome.server} reads no H.264 (it lacks PyAV: make install-video there); leave out --video"
        )
    if not IS_POSSIBLE:
        raise ClientError("--video h264 needs PyAV, which is not installed: make install-video, or pip install av")
    return VideoEncoder()


def _adaptive(job: _Job, delay_s: float) -> Adaptive | None:
    """What follows the link, where quality may. A light alone does not say how long the server took for it."""
    if not job.realtime or not job.sending.adapts or job.wishes.answer == "light":
        return None
    return Adaptive(1 / job.source.fps, delay_s, job.sending.depth_noise_per_m)


def frame_output(answer: Answer, camera: CameraModel, own: Color | None = None) -> FrameOutput:
    """An answer as the output writer takes it: its picture decoded, or its layer put over the frame's `own` picture.

    Raises ProtocolError for what cannot be decoded.
    """
    drawn = answer.drawn
    assert drawn is not None
    if isinstance(drawn, Layer):
        assert own is not None
        color = put_over(decode_layer(drawn, camera), shown_picture(own, camera), camera)
    else:
        color = np.asarray(decode_color(drawn.color, camera, "srgb8"), np.uint8)
    return FrameOutput(
        frame=drawn.frame,
        timestamp_s=drawn.timestamp_s,
        color=color,
        light=answer.light,
        world_from_camera=np.array(drawn.world_from_camera, np.float64).reshape(4, 4),
        tracking=drawn.tracking,
        timings=drawn.timings,
        plan=drawn.plan,
        notes=drawn.notes,
    )


def answer_bytes(answer: Answer) -> int:
    """Bytes of an answer's pictures; the rest is small."""
    if answer.composite is not None:
        return len(answer.composite.color.data)
    parts = () if answer.layer is None else (answer.layer.virtual, answer.layer.ratio)
    return sum(len(part.color.data) + len(part.depth.data) for part in parts if part is not None)


@contextlib.contextmanager
def _recorder(path: Path | None) -> Iterator[Callable[[ClientMessage | ServerMessage], None] | None]:
    """A function that appends each message to the file, or None where there is no file. Raises OutputError."""
    if path is None:
        yield None
        return
    with _told_as_output_error(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("wb")

    def record(message: ClientMessage | ServerMessage) -> None:
        with _told_as_output_error(path):
            write_message(file, message)

    with file:
        yield record


@contextlib.contextmanager
def _told_as_output_error(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); name another file with --record") from error


def _progress(console: Console) -> Progress:
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
    )
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)

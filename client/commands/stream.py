"""`probeless stream`: send a source to a server at its frame rate, show and write the answers."""

from __future__ import annotations

import asyncio
import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from client.commands.stopping import stop_on_interrupt
from client.display.layers import decode_layer, put_over
from client.display.stream_statistics import STAGES, StreamStatistics
from client.display.stream_view import StreamView
from client.errors import OutputError, SourceError
from client.objects.in_view import ObjectsInView
from client.objects.object_file import ObjectFile, object_id, pack_mesh
from client.options.light_places import PanoramaOut, write_panorama
from client.results.description import describe
from client.results.frame_output import FrameOutput, captured_of
from client.results.output_folder import OutputWriter
from client.results.write_behind import WriteBehind
from client.sources.frame_source import ENDLESS, Source, is_live
from client.streaming.adaptive import SMOOTHING, Adaptive, AnsweredFrame
from client.streaming.client import Access, Answer, ClientError, RoomPlace, StreamClient
from client.streaming.coding import Coding, picture_bytes
from client.streaming.video import IS_POSSIBLE, VideoEncoder
from protocol.frames import CameraModel, RgbdFrame
from protocol.images import decode_color
from protocol.limits import FEW_INFLIGHT, MOST_INFLIGHT
from protocol.messages import (
    NOT_SAVED,
    ClientMessage,
    Dropped,
    Error,
    Layer,
    Light,
    MeshFormat,
    ObjectFormat,
    ServerMessage,
    Welcome,
    Wishes,
)
from protocol.recording import write_message

POLL_S = 0.002
"""Interval of checking whether the next frame of a live source may be sent."""

MOST_CAPTURED = 64
"""Frames kept until they are answered; more have been lost with a connection."""


@dataclass
class StreamSummary:
    """Result of a stream: counts of frames and times."""

    server: str = ""
    device: str = ""
    session: str = ""
    sent: int = 0
    answered: int = 0
    skipped: int = 0
    """Not sent, because the server was busy with earlier frames."""
    dropped: int = 0
    """Sent, but refused or replaced by the server."""
    seconds: float = 0.0
    """From sending the first frame to the last answer."""
    first_picture_s: float = math.nan
    """From connecting to showing the first answer."""
    reconnected: int = 0
    light: Light | None = None
    """Of the last answer."""
    latency_ms: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """p50 and p99 over the last frames, by stage of `stream_statistics.STAGES`."""


@dataclass(frozen=True)
class Sending:
    """How frames are sent and shown."""

    adapts: bool = True
    """Adapt quality, size and rate to the link; only with `realtime`."""
    depth_noise_per_m: float | None = None
    """Depth may change by up to this times z^2 (metres); None: depth is exact."""
    view: bool = False
    """Show the picture in the terminal."""
    video: bool = False
    """Send colour as H.264; ignored in a lossless session."""


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
    panorama: PanoramaOut | None = None,
    room: RoomPlace | None = None,
    access: Access | None = None,
    sending: Sending | None = None,
    console: Console | None = None,
    overwrite: bool = False,
    video: bool = False,
    rerun: Path | None = None,
) -> StreamSummary:
    """Send `frames` of the source (default: all) to the server and write the answers into the folder `out`, if given.

    `realtime` keeps the source's frame rate and skips frames while the server is busy; otherwise every frame is sent as
    soon as the window has room. `lossless` sends raw colour, waits for each answer, and receives exact pictures.
    `mesh` requests the scene's mesh after the last answer and writes it into `out`; `panorama` the light at a place.
    `record`: file for all messages. `overwrite`: `out` may hold an earlier run. `video`: write video.mp4 into `out`.
    `rerun`: file of a recording for the rerun viewer, with `out`.
    `room`: the room to share. `access`: access options that the URL does not contain. `console`: default stderr.
    Raises ClientError, UserError, each with one line.
    """
    wishes = msgspec.structs.replace(wishes or Wishes(), lossless=lossless)
    others = (realtime and not lossless, mesh, panorama, room, access, sending or Sending())
    job = _Job(source, frames or range(len(source)), server_url, objects, wishes, *others)
    console = console or Console(stderr=True)
    with _recorder(record) as tap, contextlib.ExitStack() as stack:
        stopping = stack.enter_context(stop_on_interrupt(is_live(source)))
        writer = None
        if out is not None:
            total = None if job.frames.stop >= ENDLESS else len(job.frames)
            said = describe(source, total, objects)
            writing = OutputWriter(out, said, overwrite=overwrite, video=video, rerun=rerun)
            writer = stack.enter_context(writing)
        statistics, progress = StreamStatistics(), _progress(console)
        view = stack.enter_context(StreamView(console, progress, statistics, job.sending.view))
        return asyncio.run(_Stream(job, writer, progress, stopping, statistics, view).run(tap))


@dataclass(frozen=True)
class _Job:
    """Parameters of `stream`."""

    source: Source
    frames: range
    server_url: str
    objects: Sequence[ObjectFile]
    wishes: Wishes
    realtime: bool
    mesh: bool
    panorama: PanoramaOut | None
    room: RoomPlace | None
    access: Access | None
    sending: Sending


class _Stream:
    """Sends frames and receives answers concurrently on one event loop."""

    def __init__(
        self,
        job: _Job,
        writer: OutputWriter | None,
        progress: Progress,
        stopping: threading.Event,
        statistics: StreamStatistics,
        view: StreamView,
    ) -> None:
        self._job = job
        self._writer = writer
        self._progress = progress
        self._stopping, self._statistics, self._view = stopping, statistics, view
        self._adaptive = _adaptive(job, math.inf)
        self._fixed = Coding(depth_noise_per_m=job.sending.depth_noise_per_m)
        self._in_flight: dict[int, tuple[float, int]] = {}
        """Frame number -> time of sending and bytes, for unanswered frames."""
        self._captured: dict[int, RgbdFrame] = {}
        """Unanswered frames; layers are composed over their pictures, and the page of results shows them."""
        self._behind = WriteBehind()
        """Writes answers after they were shown."""
        self._last_sent_s = -math.inf
        self._preparing_s = 0.0
        """To read and encode a frame, which is not on its way before."""
        self._began_s = 0.0
        total = None if job.frames.stop >= ENDLESS else len(job.frames)
        self._bar = progress.add_task(job.source.name, total=total, note="connecting")
        self._summary = StreamSummary()
        self._in_view = ObjectsInView(job.source.camera, (), ())
        self._printed: set[str] = set()

    async def run(self, tap: Callable[[ClientMessage | ServerMessage], None] | None) -> StreamSummary:
        meshes = [pack_mesh(item.path) for item in self._job.objects]  # a bad file is an error before anything is sent
        self._began_s = time.perf_counter()
        client = await StreamClient.connect(self._job.server_url, tap, self._job.access)
        try:
            job = self._job
            window = FEW_INFLIGHT if self._adaptive is None else MOST_INFLIGHT
            welcome = await client.hello(
                job.source.camera, job.wishes, "probeless stream", job.room, max_inflight=window
            )
            self._note_welcome(welcome)
            if job.sending.video and not job.wishes.lossless:
                client.video = open_video(welcome)
                self._view.codec = "H.264"
            await self._place_objects(client, meshes)
            if self._adaptive is not None:
                self._adaptive = _adaptive(job, await client.ping())
            with self._behind:
                await self._exchange(client)
        finally:
            await client.close("the source has ended")
        found = {stage: self._statistics.percentiles(stage) for stage in STAGES}
        self._summary.latency_ms = {stage: pair for stage, pair in found.items() if pair is not None}
        return self._summary

    def _note_welcome(self, welcome: Welcome) -> None:
        self._summary.server, self._summary.device = welcome.server, welcome.device
        self._summary.session = welcome.session
        if self._writer is not None:
            self._writer.note_device(welcome.device)

    async def _place_objects(self, client: StreamClient, meshes: list[tuple[ObjectFormat, bytes]]) -> None:
        prefix = "" if self._job.room is None else f"{self._summary.session}-"
        names = [prefix + object_id(number) for number in range(len(meshes))]
        self._in_view = ObjectsInView(self._job.source.camera, self._job.objects, names)
        for name, item, (format_, data) in zip(names, self._job.objects, meshes, strict=True):
            done = await client.place_object(
                name,
                format_,
                data,
                item.position_m,
                item.scale,
                item.yaw_deg,
                spot=item.spot,
                height_m=item.height_m,
            )
            if done.error is not None and not done.error.startswith(NOT_SAVED):
                raise ClientError(f"{item.path}: {done.error}")
            for note in (*([] if done.error is None else [done.error]), *done.notes):
                self._print_once(f"{item.path.name}: {note}")

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
            await asyncio.to_thread(self._behind.finish)
        finally:
            receiving.cancel()
            sending.cancel()
            await asyncio.gather(receiving, sending, return_exceptions=True)
        self._summary.seconds = time.perf_counter() - start_s
        for line in self._in_view.problems():
            self._print_once(line)

    async def _send(self, client: StreamClient) -> None:
        """Send all frames and wait for the last answer, also if reading the source fails."""
        try:
            await (self._send_live(client) if is_live(self._job.source) else self._send_frames(client))
        except SourceError:
            await client.wait_until_answered()
            raise
        await client.wait_until_answered()
        if self._job.mesh:
            await self._fetch_mesh(client)
        if self._job.panorama is not None:
            asked = self._job.panorama
            found = await client.request_panorama(asked.format, asked.position_m)
            await asyncio.to_thread(write_panorama, asked.path, found.data)

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
        """Whether a frame prepared from now on would not wait for the server or the link."""
        if self._adaptive is None or not client.has_room:
            return client.has_room
        sent_s = time.perf_counter() + self._preparing_s
        return self._adaptive.may_send(sent_s, self._last_sent_s, client.unanswered)

    async def _send_one(self, client: StreamClient, position: int) -> None:
        begun_s = time.perf_counter()
        frame = await asyncio.to_thread(self._job.source.__getitem__, position)
        captured_s = time.perf_counter()
        coding = self._fixed if self._adaptive is None else self._adaptive.coding
        message = await client.encode_frame(frame, coding)
        sent_s = self._last_sent_s = time.perf_counter()
        self._preparing_s += SMOOTHING * (sent_s - begun_s - self._preparing_s)
        size = picture_bytes(message)
        self._in_flight[frame.index] = sent_s, size
        if self._writer is not None or self._job.wishes.answer == "layer":
            self._captured[frame.index] = frame
            if len(self._captured) > MOST_CAPTURED:
                del self._captured[next(iter(self._captured))]
        self._statistics.note_sent(frame.index, captured_s, sent_s, size)
        await client.send_encoded(message)
        self._summary.sent += 1
        if self._job.wishes.lossless:
            await client.wait_until_answered()

    async def _send_live(self, client: StreamClient) -> None:
        """Send the newest frame of a camera whenever there is room, until Ctrl-C or the last requested frame."""
        for position in self._job.frames:
            await client.wait_for_room()
            if self._stopping.is_set():
                return
            while not self._may_send(client) and not self._stopping.is_set():
                await asyncio.sleep(POLL_S)
            await self._send_one(client, position)
            self._summary.skipped = getattr(self._job.source, "missed", 0)

    async def _fetch_mesh(self, client: StreamClient) -> None:
        bar = self._progress.add_task("mesh", total=None, note="the server computes it")

        def show(done: int, total: int) -> None:
            self._progress.update(bar, completed=done, total=total, note="bytes of each file")

        files: Mapping[MeshFormat, bytes] = await client.request_mesh(show)
        if self._writer is not None:
            await asyncio.to_thread(self._behind.finish)
            await asyncio.to_thread(self._writer.write_mesh, files)

    async def _receive(self, client: StreamClient) -> None:
        async for answer in client.answers():
            match answer:
                case Answer():
                    await self._handle_answer(answer, client.reconnected)
                case Dropped():
                    self._note_dropped(answer)
                case Error():
                    self._print_once(answer.reason)

    async def _handle_answer(self, answer: Answer, reconnected: int) -> None:
        returned_s = time.perf_counter()
        drawn, size = answer.drawn, answer_bytes(answer)
        computed_s = 0.0 if drawn is None else drawn.timings.total / 1e3
        if self._adaptive is not None:
            waited_s = None if drawn is None or not drawn.waited_ms else drawn.waited_ms / 1e3
            measured = AnsweredFrame(0.0, returned_s, computed_s, 0, bytes_down=size, waited_s=waited_s)
            self._measure(answer.light.frame, measured, reconnected)
        output = await asyncio.to_thread(self._decoded, answer)
        coding = self._fixed if self._adaptive is None else self._adaptive.coding
        shown_s = time.perf_counter()
        if not self._summary.answered:
            self._summary.first_picture_s = shown_s - self._began_s
        picture = None if output is None else output.color
        self._view.show(shown_s, answer.light, drawn, picture, coding, reconnected)
        waited_ms = 0.0 if drawn is None else drawn.waited_ms
        self._statistics.note_answer(answer.light.frame, returned_s, shown_s, computed_s, size, waited_ms / 1e3)
        if drawn is not None:
            pose = np.array(drawn.world_from_camera, np.float64).reshape(4, 4)
            self._in_view.note(answer.light, pose)
            for note in drawn.notes:
                self._print_once(note)
        self._summary.answered += 1
        self._summary.light = answer.light
        self._advance()
        if self._writer is not None:
            self._behind.begin(
                partial(self._writer.write_light, answer.light)
                if output is None
                else partial(self._writer.write, output)
            )
            while (written := self._behind.due()) is not None:
                await asyncio.wrap_future(written)

    def _decoded(self, answer: Answer) -> FrameOutput | None:
        """The answer with its picture; None if there is none, or nobody wants it."""
        own = self._captured.pop(answer.light.frame, None)
        if answer.drawn is None or (self._writer is None and not self._view.wants_pictures):
            return None
        return frame_output(answer, self._job.source.camera, own)

    def _measure(self, number: int, answered: AnsweredFrame, reconnected: int) -> None:
        """Pass a measurement to the adaptation, completed by the time of sending and the bytes sent."""
        assert self._adaptive is not None
        if reconnected != self._summary.reconnected:
            self._summary.reconnected = reconnected
            self._adaptive.note_reconnection()
            self._in_flight.clear()
        sent = self._in_flight.pop(number, None)
        if sent is not None:
            self._adaptive.note(replace(answered, sent_s=sent[0], bytes_up=sent[1]))

    def _note_dropped(self, dropped: Dropped) -> None:
        if self._job.wishes.lossless:
            raise ClientError(f"frame {dropped.frame}: {dropped.reason}")
        self._summary.dropped += 1
        self._in_flight.pop(dropped.frame, None)
        self._captured.pop(dropped.frame, None)
        self._statistics.forget(dropped.frame)
        self._print_once(f"frame {dropped.frame}: {dropped.reason}")
        self._advance()

    def _advance(self) -> None:
        done = self._summary
        note = f"{done.answered} answered, {done.skipped} skipped, {done.dropped} dropped"
        self._progress.update(self._bar, advance=1, note=note)

    def _print_once(self, line: str) -> None:
        if line not in self._printed:
            self._printed.add(line)
            self._progress.console.print(line, markup=False, highlight=False, soft_wrap=True)


def open_video(welcome: Welcome) -> VideoEncoder:
    """Encoder of colour. Raises ClientError if the server or this client lacks PyAV."""
    if "h264" not in welcome.codecs:
        raise ClientError(
            f"{welcome.server} reads no H.264 (it lacks PyAV: make install-video there); leave out --color"
        )
    if not IS_POSSIBLE:
        raise ClientError("--color h264 needs PyAV, which is not installed: make install-video, or pip install av")
    return VideoEncoder()


def _adaptive(job: _Job, delay_s: float) -> Adaptive | None:
    """The adaptation to the link, if enabled; not for lights alone, which do not report the computing time."""
    if not job.realtime or not job.sending.adapts or job.wishes.answer == "light":
        return None
    return Adaptive(1 / job.source.fps, delay_s, job.sending.depth_noise_per_m)


def frame_output(answer: Answer, camera: CameraModel, own: RgbdFrame | None = None) -> FrameOutput:
    """An answer for the output folder: its decoded picture, or its layer composed over the picture of its frame `own`.

    Raises ProtocolError if it cannot be decoded.
    """
    drawn = answer.drawn
    assert drawn is not None
    captured = None if own is None else captured_of(own, camera)
    if isinstance(drawn, Layer):
        assert captured is not None
        color = put_over(decode_layer(drawn, camera), captured.color, camera)
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
        captured=captured,
    )


def answer_bytes(answer: Answer) -> int:
    """Bytes of an answer's pictures; the rest is small."""
    if answer.composite is not None:
        return len(answer.composite.color.data)
    parts = () if answer.layer is None else (answer.layer.virtual, answer.layer.ratio)
    return sum(len(part.color.data) + len(part.depth.data) for part in parts if part is not None)


@contextlib.contextmanager
def _recorder(path: Path | None) -> Iterator[Callable[[ClientMessage | ServerMessage], None] | None]:
    """A function that appends a message to the file; None without a file. Raises OutputError."""
    if path is None:
        yield None
        return
    with _as_output_error(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("wb")

    def record(message: ClientMessage | ServerMessage) -> None:
        with _as_output_error(path):
            write_message(file, message)

    with file:
        yield record


@contextlib.contextmanager
def _as_output_error(path: Path) -> Iterator[None]:
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

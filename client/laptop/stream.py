"""`probeless stream`: a source over the socket at its own frame rate, and what comes back into a folder."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from client.client import Access, Answer, ClientError, RoomPlace, StreamClient
from client.laptop.errors import OutputError, SourceError
from client.laptop.objects import ObjectFile, pack_mesh
from client.laptop.output import FrameOutput, OutputWriter
from client.laptop.source import Source
from protocol.frames import CameraModel
from protocol.images import decode_color
from protocol.messages import ClientMessage, Dropped, Error, MeshFormat, ServerMessage, Welcome, Wishes
from protocol.recording import write_message


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
    console: Console | None = None,
) -> StreamSummary:
    """Send `frames` of the source (default: all) to the server and write its answers into `out`, where one is given.

    `realtime` keeps the source's frame rate and skips frames while the server is busy; without it every frame is sent
    as soon as there is room. `lossless` sends raw colour and waits for each answer, so that every frame is answered
    with the very pixels of the server's picture. `mesh` asks for the scene's mesh after the last answer and writes it
    into `out`. `record` gets every message sent and received. `room`: to share with others. `access`: what lets the
    client in, if not the URL.
    Raises ClientError, UserError, each with one clear line. Progress goes to `console` (default: standard error).
    """
    wishes = msgspec.structs.replace(wishes or Wishes(), lossless=lossless)
    others = (realtime and not lossless, mesh, room, access)
    job = _Job(source, frames or range(len(source)), server_url, objects, wishes, *others)
    console = console or Console(stderr=True)
    with _recorder(record) as tap, contextlib.ExitStack() as stack:
        writer = stack.enter_context(OutputWriter(out)) if out is not None else None
        progress = stack.enter_context(_progress(console))
        return asyncio.run(_Stream(job, writer, progress).run(tap))


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


class _Stream:
    """One connection's sending and receiving, side by side on one event loop."""

    def __init__(self, job: _Job, writer: OutputWriter | None, progress: Progress) -> None:
        self._job = job
        self._writer = writer
        self._progress = progress
        self._bar = progress.add_task(job.source.name, total=len(job.frames), note="connecting")
        self._summary = StreamSummary()
        self._told: set[str] = set()

    async def run(self, tap: Callable[[ClientMessage | ServerMessage], None] | None) -> StreamSummary:
        meshes = [pack_mesh(item.path) for item in self._job.objects]  # a bad file is told before anything is sent
        client = await StreamClient.connect(self._job.server_url, tap, self._job.access)
        try:
            job = self._job
            self._note_welcome(await client.hello(job.source.camera, job.wishes, "probeless stream", job.room))
            await self._place_objects(client, meshes)
            await self._exchange(client)
        finally:
            await client.close("the source has ended")
        return self._summary

    def _note_welcome(self, welcome: Welcome) -> None:
        self._summary.server, self._summary.device = welcome.server, welcome.device
        self._summary.session = welcome.session

    async def _place_objects(self, client: StreamClient, meshes: list[tuple[str, bytes]]) -> None:
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
            await self._send_frames(client)
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
                if not client.has_room:
                    self._summary.skipped += 1
                    self._advance()
                    continue
            await client.send_frame(await asyncio.to_thread(self._job.source.__getitem__, position))
            self._summary.sent += 1
            if self._job.wishes.lossless:
                await client.wait_until_answered()

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
                    await self._keep(answer)
                case Dropped():
                    self._note_dropped(answer)
                case Error():
                    self._tell(answer.reason)

    async def _keep(self, answer: Answer) -> None:
        if self._writer is not None:
            output = await asyncio.to_thread(frame_output, answer, self._job.source.camera)
            await asyncio.to_thread(self._writer.write, output)
        for note in answer.composite.notes:
            self._tell(note)
        self._summary.answered += 1
        self._advance()

    def _note_dropped(self, dropped: Dropped) -> None:
        if self._job.wishes.lossless:
            raise ClientError(f"frame {dropped.frame}: {dropped.reason}")
        self._summary.dropped += 1
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


def frame_output(answer: Answer, camera: CameraModel) -> FrameOutput:
    """An answer as the output writer takes it; the picture decoded. Raises ProtocolError."""
    composite = answer.composite
    return FrameOutput(
        frame=composite.frame,
        timestamp_s=composite.timestamp_s,
        color=decode_color(composite.color, camera, "srgb8"),
        light=answer.light,
        world_from_camera=np.array(composite.world_from_camera, np.float64).reshape(4, 4),
        tracking=composite.tracking,
        timings=composite.timings,
        plan=composite.plan,
        notes=composite.notes,
    )


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

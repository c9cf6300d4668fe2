"""Clients for the faults: small pictures of a wall into a room, objects that come and go, and how each one ended.

The wall is a clock: the longer a guest has been streaming, the more of it its frames show, so that a mesh of the room
tells until when its frames have been fused.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import time
from collections.abc import Awaitable
from dataclasses import dataclass, field

import numpy as np
import trimesh

from client.streaming.client import Answer, ClientError, RoomPlace, StreamClient
from protocol.frames import IDENTITY, CameraModel, RgbdFrame
from protocol.messages import Acknowledged, Wishes
from tests.scenes.plain_light import PLAIN_LIGHT

CAMERA = CameraModel(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5)
WALL_M = 2.0
BOUNDS = (-1.2, -0.9, 1.5, 1.2, 0.9, 2.4)
WISHES = Wishes(poses="given", volume_m=BOUNDS, voxel_m=0.02, preset="gr15fast", up=(0, -1, 0), **PLAIN_LIGHT)
FIRST_PX, LAST_PX = 30, 155
FULL_S = 15.0
"""Until the whole wall is shown."""
PERIOD_S = 0.1
CUBE = trimesh.creation.box((0.1, 0.1, 0.1)).export(file_type="ply")
ROOM_PATIENCE_S, FULL_PATIENCE_S = 60.0, 15.0
_U, _V = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
_COLOR = np.stack([120 + 60 * np.sin(_U / 7), 110 + 50 * np.cos(_V / 5), 100 + 0 * _U], axis=-1).astype(np.uint8)


def clock_frame(index: int, shown_s: float) -> RgbdFrame:
    """The wall, as far as it is shown when a guest has been streaming for so long."""
    depth = np.full((CAMERA.height, CAMERA.width), int(1000 * WALL_M), np.uint16)
    depth[:, int(FIRST_PX + (LAST_PX - FIRST_PX) * min(shown_s / FULL_S, 1.0)) :] = 0
    return RgbdFrame(index, index / 10, _COLOR, depth, np.eye(4))


def clock_s(ply: bytes) -> float:
    """What the mesh of a room says: until when, of a guest's streaming, it has been fused. Good to 0.3 s."""
    vertices = np.asarray(trimesh.load(io.BytesIO(ply), file_type="ply", process=False).vertices)
    edge_px = CAMERA.cx + CAMERA.fx * float(vertices[:, 0].max()) / WALL_M
    return (edge_px - FIRST_PX) / (LAST_PX - FIRST_PX) * FULL_S


@dataclass
class Guest:
    """One client in a room."""

    url: str
    room: str | None
    name: str = "guest"
    keep_s: float = ROOM_PATIENCE_S
    answered: int = 0
    answered_at: float = 0.0
    """By time.perf_counter, as all times here."""
    shown_s: float = 0.0
    """Of the clock, in the last frame that was answered."""
    ended: str | None = None
    """The line that it ended with."""
    objects: dict[str, bool] = field(default_factory=dict)
    """That were acknowledged, and whether each is to be there."""
    problems: list[str] = field(default_factory=list)
    is_paused: bool = False
    longest_gap_s: float = 0.0
    """Between two answers, from when `watch_gaps` was called."""

    async def begin(self) -> Guest:
        """Enter, trying again for a while where the server is full. Raises ClientError."""
        place = None if self.room is None else RoomPlace(self.room, room_from_world=IDENTITY)
        until = time.perf_counter() + FULL_PATIENCE_S
        while True:
            self._client = await StreamClient.connect(self.url)
            try:
                await self._client.hello(CAMERA, WISHES, self.name, place, keep_s=self.keep_s)
                break
            except ClientError as error:
                if "server is full" not in str(error) or time.perf_counter() > until:
                    raise
            await asyncio.sleep(1.0)
        self._tasks = [asyncio.create_task(self._kept(task)) for task in (self._send(), self._read())]
        return self

    async def _kept(self, work: Awaitable[None]) -> None:
        try:
            await work
        except ClientError as error:
            self.ended = self.ended or str(error)

    async def _send(self) -> None:
        self._sent: dict[int, float] = {}
        began, index = time.perf_counter(), 0
        while True:
            await asyncio.sleep(PERIOD_S)
            if self.is_paused:
                continue
            await self._client.wait_for_room()
            self._sent[index] = time.perf_counter() - began
            await self._client.send_frame(clock_frame(index, self._sent[index]))
            index += 1

    async def _read(self) -> None:
        async for answer in self._client.answers():
            if isinstance(answer, Answer):
                now = time.perf_counter()
                if self.answered_at:
                    self.longest_gap_s = max(self.longest_gap_s, now - self.answered_at)
                self.answered, self.answered_at = self.answered + 1, now
                self.shown_s = self._sent[answer.composite.frame]
        self.ended = self.ended or "the server has closed the session"

    def watch_gaps(self) -> None:
        """Forget the gaps so far."""
        self.longest_gap_s = 0.0

    async def place(self, name: str, data: bytes = CUBE, at: tuple[float, float, float] = (0.0, 0.3, 1.9)) -> None:
        """Place an object; what is acknowledged is kept, what is refused too."""
        done = await self._asked(self._client.place_object(name, "ply", data, at))
        if done is not None and done.error is None:
            self.objects[name] = True

    async def remove(self, name: str) -> None:
        """Remove an object."""
        done = await self._asked(self._client.remove_object(name))
        if done is not None and done.error is None:
            self.objects[name] = False

    async def change_quality(self, preset: str) -> None:
        """Another preset from the next frame on."""
        await self._asked(self._client.set_quality(preset))  # type: ignore[arg-type]

    async def _asked(self, asking: Awaitable[Acknowledged]) -> Acknowledged | None:
        try:
            done = await asking
        except ClientError as error:
            self.ended = self.ended or str(error)
            return None
        if done.error is not None:
            self.problems.append(done.error)
        return done

    async def lost_objects(self, asked: dict[str, bool]) -> list[str]:
        """Those that are not as they were asked for and acknowledged. Takes them all away. Raises ClientError."""
        wrong = []
        for name, is_there in asked.items():
            done = await self._client.remove_object(name)
            if (done.error is None) != is_there:
                wrong.append(name)
        return wrong

    async def fused_until_s(self) -> float:
        """By the clock; 0 where nothing is there. Raises ClientError where the session is over.

        For a guest that is paused: a frame without a single depth, which adds nothing, tells the server where it looks.
        """
        index = max(self._sent) + 1000
        self._sent[index] = self.shown_s
        blank = clock_frame(index, 0.0)
        await self._client.send_frame(RgbdFrame(index, blank.timestamp_s, blank.color, 0 * blank.depth, np.eye(4)))
        await self._client.wait_until_answered()
        try:
            return clock_s((await self._client.request_mesh())["ply"])
        except ClientError as error:
            if "no surface" in str(error):
                return 0.0
            raise

    async def goes_on(self, limit_s: float, frames: int = 2) -> bool:
        """Whether so many more frames are answered in time; False too where it has ended."""
        until, enough = time.perf_counter() + limit_s, self.answered + frames
        while self.answered < enough and self.ended is None and time.perf_counter() < until:
            await asyncio.sleep(0.02)
        return self.answered >= enough

    async def leave(self) -> None:
        """Whatever state it is in."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        with contextlib.suppress(ClientError, TimeoutError):
            async with asyncio.timeout(10.0):
                await self._client.close()

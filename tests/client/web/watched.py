"""A real service that tells what objects it was asked for, and a camera that others can watch."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import count

import numpy as np
from numpy.typing import NDArray

from client.options.source import Source
from client.streaming.coding import frame_message
from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Composite, Hello, Wishes
from server.client_session import ClientSession
from server.opencl.device import Device
from server.scene.mesh import Mesh
from server.scene.placement import Placement
from server.service.serve import BackgroundServer
from server.service.service import Service
from tests.client.web.page import wait_until
from tests.service.wire import Wire

SIZE = (600, 800)
TOUCHED = (112.0, 69.0)
"""Pixel of the table that a finger points at."""


class Watched(ClientSession):
    """A real pipeline that tells what it was asked."""

    asked: list[tuple[str, Placement | None]]

    def place_object(self, object_id: str, mesh: Mesh, placement: Placement) -> tuple[str, ...]:
        notes = super().place_object(object_id, mesh, placement)
        self.asked.append(("place", placement))
        return notes

    def move_object(self, object_id: str, placement: Placement) -> None:
        super().move_object(object_id, placement)
        self.asked.append(("move", placement))

    def remove_object(self, object_id: str) -> None:
        super().remove_object(object_id)
        self.asked.append(("remove", None))


def point_under(camera: CameraModel, frame: RgbdFrame, u: float, v: float) -> NDArray[np.float64]:
    z = frame.depth[round(v), round(u)] * camera.depth_scale_m
    point = np.array([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z, 1.0])
    return (frame.world_from_camera @ point)[:3]


def wait_for(asked: list, count: int) -> tuple[str, Placement | None]:
    wait_until(lambda: len(asked) >= count)
    return asked[-1]


@contextmanager
def watched_server(device: Device) -> Iterator[tuple[BackgroundServer, list]]:
    """And all that its pipelines were asked, as it comes."""
    asked: list[tuple[str, Placement | None]] = []

    def build(*given: object) -> Watched:
        pipeline = Watched(*given)
        pipeline.asked = asked
        return pipeline

    with BackgroundServer(Service(device, pipeline_factory=build)) as server:
        yield server, asked


PERIOD_S = 0.1
"""Between frames: without a GPU a page does not keep up with a server that answers a still view in 15 ms."""


@contextmanager
def standing_camera(url: str, source: Source) -> Iterator[list[Composite]]:
    """The answers to a camera that shows the source's first frame again and again, as they come."""
    answers, ended, wire = list[Composite](), threading.Event(), Wire(url)
    wire.say(Hello(client="test", camera=source.camera, wishes=Wishes(up=source.up, voxel_m=0.01)))

    def capture() -> None:
        for index in count():
            if ended.wait(PERIOD_S):
                return
            wire.say(frame_message(replace(source[0], index=index), source.camera))
            answers.append(wire.hear_until(Composite)[-1])

    thread = threading.Thread(target=capture)
    thread.start()
    try:
        yield answers
    finally:
        ended.set()
        thread.join()
        wire.hang_up()

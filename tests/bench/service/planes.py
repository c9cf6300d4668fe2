"""Clients that each see one plane of a corner (corners.py), over the real socket: alone, and together in one room."""

from __future__ import annotations

import asyncio
from collections.abc import Collection
from pathlib import Path

import numpy as np

from client.streaming.client import Answer, RoomPlace, StreamClient
from protocol.frames import IDENTITY
from protocol.messages import Light
from tests.bench.report.finished import Part
from tests.bench.report.run import Run
from tests.bench.service.process import serving
from tests.scenes import corners
from tests.scenes.corners import END, FLOOR, WALL, corner_frame, degrees_across
from tests.scenes.lights import degrees_between, lobe_and_sky

TOWARDS = (0.5, 0.8, 0.0)
LIGHT = 0.3 * lobe_and_sky(TOWARDS)
FRAMES, QUICK_FRAMES = 12, 8
WIDE = 0.5
"""Of the direction's share in the light: standard deviation of a coefficient of band 1 over that band's length."""


def planes_part(run: Run, out: Path) -> Part:
    """Alone, two together, whose light is not known along their edge, and three."""
    part = Part()
    frames, corner = run.of(QUICK_FRAMES, FRAMES), [*PLANES.values(), END]
    with serving(out / "planes.log", "--token", "none", "--data", "none") as served:
        alone = {name: asyncio.run(lit(served.url, [side], PLANES.values(), frames)) for name, side in PLANES.items()}
        two = asyncio.run(lit(served.url, [FLOOR, WALL], PLANES.values(), frames))
        three = asyncio.run(lit(served.url, corner, corner, frames))
    for name, light in alone.items():
        unknown = not light.valid or width(light) > WIDE
        part.add(f"a client that sees the {name} alone: light is not valid or wide", float(unknown), "", ">= 1")
        part.add(f"a client that sees the {name} alone: direction off by", _off_deg(light), "degrees")
        part.add(f"a client that sees the {name} alone: spread", light.spread_deg or 180.0, "degrees")
    seen_along = degrees_across(two.dominant_direction, TOWARDS)
    part.add("two in one room: direction off by, as seen along the planes' edge", seen_along, "degrees", "<= 5")
    part.add("two in one room: spread", two.spread_deg or 180.0, "degrees")
    part.add("three in one room: direction off by", _off_deg(three), "degrees", "<= 15")
    least = min(light.spread_deg or 180.0 for light in alone.values())
    part.add("three in one room: spread over the least of one alone", (three.spread_deg or 180.0) / least, "", "<= 0.7")
    part.sizes["frames of a plane"] = frames
    return part


PLANES = {"floor": FLOOR, "wall": WALL}


async def lit(url: str, sides: list[int], planes: Collection[int], frames: int) -> Light:
    """The light after so many frames of each side, each by a client of its own; in one room if there are several.

    planes: those of the corner.
    """
    clients = {}
    for side in sides:
        place = RoomPlace("corner", room_from_world=IDENTITY) if len(sides) > 1 else None
        clients[side] = await StreamClient.connect(url)
        await clients[side].hello(corners.CAMERA, corners.WISHES, room=place)
    for index in range(frames * len(sides)):
        side = sides[index % len(sides)]
        await clients[side].send_frame(corner_frame(side, index, LIGHT, planes))
        answer = await anext(aiter(clients[side].answers()))
        if not isinstance(answer, Answer):
            raise RuntimeError(f"frame {index} was not answered: {answer}")
    for client in clients.values():
        await client.close()
    return answer.light


def width(light: Light) -> float:
    """Greatest standard deviation of a coefficient of band 1 over the length of that band; infinite where unknown."""
    deviations = [value for row in light.sh_std[1:4] for value in row]
    if any(value is None for value in deviations):
        return 1e9
    return float(np.max(np.array(deviations, float)) / max(np.linalg.norm(np.array(light.sh)[1:4].mean(axis=1)), 1e-9))


def _off_deg(light: Light) -> float:
    return degrees_between(light.dominant_direction, TOWARDS)

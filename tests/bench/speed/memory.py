"""What is kept at places of the world, in bytes: a walk through a room of 6 x 3 x 6 m."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

from protocol.frames import CameraModel
from protocol.messages import Vector3, Wishes
from server.client_session import ClientSession
from server.opencl.device import Device
from server.scene.mesh import load_mesh
from server.scene.placement import Placement
from tests.bench.report.finished import Part
from tests.bench.speed.frames import Say
from tests.bench.truth.rooms import CAMERA, LIVING_ROOM, walk

VOXEL_M = 0.01
MARGIN_M = 0.05
ON_TABLE_M: Vector3 = (3.0, 2.3, 5.0)
SEEN_AFTER = 0.2
"""Of the walk: by then all that is ever kept has been asked for once."""
MOST_MB = 50
"""At 640x480 with the defaults: 30 of transfer, 3 of discs and claims, 11 of what virtual things take (speed.md), and
lists of a frame's samples."""


def measure_memory(
    device: Device, mesh: Path, frames: int, say: Say, camera: CameraModel = CAMERA, voxel_m: float = VOXEL_M
) -> Part:
    """Rows of a walk with the defaults beside one with `--cache off`: what the one holds more than the other."""
    with_caches = _session(device, mesh, camera, voxel_m, "on")
    without = _session(device, mesh, camera, voxel_m, "off")
    kept_mb = []
    for index, pose in enumerate(walk(frames)):
        if index % 50 == 0:
            say(f"memory: frame {index} of {frames}")
        frame = LIVING_ROOM.frame(index, camera, pose)
        for session in (with_caches, without):
            session.process(replace(frame))
        kept_mb.append((with_caches.device_bytes - without.device_bytes) / 1e6)
    part = Part(sizes={"frames of a walk through a room": frames})
    name = "room of 6x3x6 m"
    part.add(f"{name}: what is kept at places of the world, at the end", kept_mb[-1], "MB", f"<= {MOST_MB}")
    later = kept_mb[int(SEEN_AFTER * frames) :]
    part.add(f"{name}: growth of it, after a fifth of the walk", max(later) - later[0], "MB", "<= 0")
    part.add(f"{name}: all on the device, at the end", with_caches.device_bytes / 1e6, "MB")
    for session in (with_caches, without):
        session.close()
    return part


def _session(
    device: Device, mesh: Path, camera: CameraModel, voxel_m: float, cache: Literal["on", "off"]
) -> ClientSession:
    width, height, length = (side + MARGIN_M for side in LIVING_ROOM.size_m)
    room = (-MARGIN_M, -MARGIN_M, -MARGIN_M, width, height, length)
    session = ClientSession(device, camera, Wishes(volume_m=room, voxel_m=voxel_m, up=(0, -1, 0), cache=cache))
    session.place_object("thing", load_mesh(mesh.read_bytes(), "glb"), Placement(position_m=ON_TABLE_M, scale=0.1))
    return session

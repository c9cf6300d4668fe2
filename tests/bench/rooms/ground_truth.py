"""A traced room as a set of the ground-truth layout (docs/sources.md), with the light at places: probes.json."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from server.shading.composite import srgb_codes
from tests.bench.rooms.furniture import Room, camera_pose

Floats = NDArray[np.float64]

WIDTH, HEIGHT, FOCAL_PX = 320, 240, 260.0
DEPTH_SCALE_M = 0.001
CLIPPED = (0.05, 0.11)
"""Share of the pixels with a clipped channel, from room to room: as a camera exposes a room."""
NOISE_CODES = 1.2
"""Deviation of a camera's noise, of 255."""

Say = Callable[[str], None]
Denoise = Callable[[Floats, Floats, Floats], Floats]
"""As `denoised` of tracing.py."""


class Traced(Protocol):
    """As TracedRoom of tracing.py."""

    def picture(self, world_from_camera: Floats, directions: Callable[[int], Floats], samples: int) -> Floats:
        """[pixels, 3] radiance."""

    def first_met(self, world_from_camera: Floats, directions: Floats) -> tuple[Floats, Floats, Floats]:
        """Distance in metres, albedo and normal."""

    def light_at(self, place: Floats, random: np.random.Generator) -> Floats:
        """[16, 3] harmonics."""


def write_room(
    folder: Path,
    room: Room,
    traced: Traced,
    seed: int,
    frames: int,
    samples: int,
    say: Say,
    *,
    denoise: Denoise,
    turns: bool = False,
) -> None:
    """Trace all pictures and places of `room`, and write them to `folder`."""
    random = np.random.default_rng(seed)
    poses = [camera_pose(room, index / max(frames - 1, 1), turns=turns) for index in range(frames)]
    shape, middles = (HEIGHT, WIDTH), directions(None)
    pictures, depths = [], []
    for index, pose in enumerate(poses):
        say(f"picture {index + 1} of {frames}")
        radiance = traced.picture(pose, lambda count: directions((random, count)), samples)
        distance, albedo, normal = traced.first_met(pose, middles)
        images = [image.reshape(*shape, 3) for image in (radiance, albedo, normal)]
        pictures.append(denoise(*images))
        depths.append((distance * middles[:, 2]).reshape(shape))
    exposure = 1 / np.quantile(np.max(pictures, axis=-1), 1 - random.uniform(*CLIPPED))
    for name in ("color", "depth"):
        (folder / name).mkdir(parents=True)
    for index, (picture, depth) in enumerate(zip(pictures, depths, strict=True)):
        codes = srgb_codes(exposure * picture) + random.normal(0, NOISE_CODES, picture.shape)
        shown = np.clip(np.rint(codes), 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"color/{index:06d}.png"), shown[..., ::-1])
        cv2.imwrite(str(folder / f"depth/{index:06d}.png"), np.rint(depth / DEPTH_SCALE_M).astype(np.uint16))
    probes = []
    for what, place in room.places:
        say(f"light at a place: {what}")
        light = exposure * traced.light_at(place, random)
        probes.append({"position": place.tolist(), "what": what, "sh": light.tolist()})
    _write_texts(folder, poses, probes)


def directions(random: tuple[np.random.Generator, int] | None) -> Floats:
    """Unit, camera axes: of the pixels' middles [pixels, 3], or [pixels, rays, 3] somewhere on each pixel."""
    row, column = (axis.reshape(-1, 1) for axis in np.mgrid[:HEIGHT, :WIDTH])
    shift: Floats = np.zeros((2, 1, 1)) if random is None else random[0].uniform(-0.5, 0.5, (2, row.size, random[1]))
    x, y = (column + shift[0] - (WIDTH - 1) / 2) / FOCAL_PX, (row + shift[1] - (HEIGHT - 1) / 2) / FOCAL_PX
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return rays[:, 0] if random is None else rays


def _write_texts(folder: Path, poses: list[Floats], probes: list[dict[str, object]]) -> None:
    lines = []
    for index, pose in enumerate(poses):
        numbers = [index / 30, *pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        lines.append(" ".join(f"{number:.9g}" for number in numbers))
    (folder / "poses.txt").write_text("\n".join(lines) + "\n")
    middle = {"cx": (WIDTH - 1) / 2, "cy": (HEIGHT - 1) / 2}
    meta = {
        "camera": {"width": WIDTH, "height": HEIGHT, "fx": FOCAL_PX, "fy": FOCAL_PX, **middle},
        "depth_scale_m": DEPTH_SCALE_M,
        "frames": len(poses),
        "depth": "depth",
        "poses": "poses.txt",
        "color": "color",
        "color_encoding": "srgb8",
        "light": "light.json",
        "up": [0, -1, 0],
    }
    (folder / "meta.json").write_text(json.dumps(meta, indent=1))
    (folder / "probes.json").write_text(json.dumps({"probes": probes}, indent=1))
    (folder / "light.json").write_text(json.dumps({"sh": probes[0]["sh"]}, indent=1))

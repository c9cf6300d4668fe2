"""The parts of `probeless bench geometry`: each measures one thing that the geometry half is held to."""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from client.progress import note
from client.sources.frame_source import Source
from server.opencl.device import open_device
from tests.bench.geometry.filters import filters_part
from tests.bench.geometry.hand import hand_part, hand_volume
from tests.bench.geometry.hybrid_normals import add_moving_rows, add_still_rows
from tests.bench.geometry.interleaving import interleaving_spread
from tests.bench.geometry.memory import room_memory
from tests.bench.geometry.noise import NormalView, normal_improvement, plane_normals
from tests.bench.geometry.pictures import draw_hand, draw_surface
from tests.bench.geometry.surface import fused_views, surface_accuracy
from tests.bench.geometry.thin import CHAIR_SOURCE, add_rod_rows, draw_thin
from tests.bench.geometry.tracking import trajectory_rows
from tests.bench.peers.contest import WARM_UP, contest_part, play
from tests.bench.peers.contestant import Scene
from tests.bench.report.finished import Part
from tests.bench.report.run import Run, data_folder, data_source
from tests.bench.truth.hand_frames import HandBefore

OUT = Path("out/bench/geometry")
ATE_GOALS_MM = {
    "mitsuba_track_clean": 0.6,
    "mitsuba_track_noisy": 1.2,
    "rgbd_livingroom1_synth": 20.0,
    "rgbd_7scenes_redkitchen": 30.0,
}
CUBE_M = (0.0, 0.0, 0.0, 2.0, 2.0, 2.0)
VOXEL_M = 2 / 256
CLEAN, NOISY, ROOM, KITCHEN, HAND = (
    "mitsuba_track_clean",
    "mitsuba_track_noisy",
    "mitsuba_room/key_white_direct",
    "rgbd_7scenes_redkitchen",
    "hand_depth_sr305",
)


def speed_part(run: Run) -> Part:
    """Milliseconds of each contestant on the same frames."""
    source = data_source(CLEAN)
    frames = [source[i] for i in range(run.of(WARM_UP + 20, 100))]
    poses = np.array([frame.world_from_camera for frame in frames])
    exact_m = [frame.depth * source.camera.depth_scale_m for frame in frames]
    load = os.getloadavg()[0]
    scores = play(Scene(source.camera, CUBE_M, VOXEL_M, poses[0]), frames, exact_m, run.say)
    part = contest_part(scores, VOXEL_M, poses)
    part.add("load average of the machine before the contest: wall times need it near 0", load, "")
    return part


def filters(run: Run) -> Part:
    """TV-L1 and bilateral filter, on a real picture and a real depth picture."""
    source = data_source(KITCHEN)
    frame = source[0]
    depth_m = np.where(frame.depth == 65535, 0, frame.depth * source.camera.depth_scale_m).astype(np.float32)
    return filters_part(run.device, cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), depth_m, run.of(5, 15))


def surface_part(run: Run) -> Part:
    """How far the volume's surface is from the exact one."""
    clean, noisy = data_source(CLEAN), data_source(NOISY)
    count = run.of(40, 100)
    part = Part(sizes={"frames fused for the surface": count})
    for source, goal in ((clean, "<= 0.15"), (noisy, "<= 0.5")):
        exact = {i: clean[i].depth * clean.camera.depth_scale_m for i in range(9, count, 10)}
        _add_surface(part, run, source, exact, count, goal)
    room = data_source(ROOM)
    true_depth = np.load(data_folder("mitsuba_room") / "truth" / "geometry.npz")["depth_m"]
    _add_surface(part, run, room, dict(enumerate(true_depth)), len(room), "<= 0.15")
    return part


def _add_surface(
    part: Part, run: Run, source: Source, exact: dict[int, NDArray[np.floating]], count: int, goal: str
) -> None:
    frames = ((source[i], exact.get(i)) for i in range(count))
    found = surface_accuracy(fused_views(run.device, source.camera, frames, CUBE_M, VOXEL_M), VOXEL_M)
    name = f"surface against exact depth, {source.name}"
    part.add(f"{name}, {count} frames: median", found.median_voxels, "voxels", goal)
    part.add(f"{name}: 90th percentile", found.p90_voxels, "voxels")
    part.add(f"{name}: bias", found.bias_voxels, "voxels")
    part.add(f"{name}: pixels covered", 100 * found.covered, "%")


def trajectory_part(run: Run) -> Part:
    """The camera followed by the volume alone, from the first pose on."""
    part = Part()
    for name, goal_mm in ATE_GOALS_MM.items():
        source = data_source(name)
        count = min(len(source), run.of(60, len(source)))
        cube = (CUBE_M, VOXEL_M) if name in {CLEAN, NOISY} else None
        trajectory_rows(part, run.device, source, name, count, goal_mm, run.say, cube)
    return part


def noise_part(run: Run) -> Part:
    """What depth filters and the geometry buffer do to normals, and the buffer to thin things, against exact truth."""
    clean, noisy = data_source(CLEAN), data_source(NOISY)
    chosen = range(0, 100, run.of(20, 5))
    scale = clean.camera.depth_scale_m
    views = (NormalView(noisy[i].depth * scale, *plane_normals(clean.camera, clean[i].depth * scale)) for i in chosen)
    found = normal_improvement(run.device, clean.camera, views)
    part = Part(sizes={"frames of normals": len(chosen)})
    for name, error in (("no filter", found.raw), ("bilateral", found.bilateral), ("TV-L1", found.tv_l1)):
        part.add(f"normals of noisy depth, {name}: median error", error.median_deg, "deg")
        part.add(f"normals of noisy depth, {name}: mean error", error.mean_deg, "deg")
    for name, error in (("bilateral", found.bilateral), ("TV-L1", found.tv_l1)):
        part.add(f"normals of noisy depth: better by {name}", found.raw.median_deg - error.median_deg, "deg", ">= 0")
    run.say("normals of the geometry buffer, still")
    add_still_rows(part, run.device, clean, noisy, CUBE_M, VOXEL_M, run.of(40, 100))
    add_moving_rows(part, run.device, run.of(4, 1), run.say)
    add_rod_rows(part, run.device, run.of(5, 20), run.say)
    return part


def hand(run: Run) -> Part:
    """A hand that comes and goes in front of the real room."""
    return hand_part(run.device, data_source(KITCHEN), data_folder(HAND), run.of(20, 40), run.say)


def pictures(run: Run) -> Part:
    """The surface, the hand and thin things, to look at."""
    draw_surface(OUT / "surface.png", run.device, data_source(CLEAN), data_source(NOISY), CUBE_M, VOXEL_M)
    kitchen = data_source(KITCHEN)
    source = HandBefore(kitchen, data_folder(HAND), first=20, worn=True)
    draw_hand(OUT / "hand.png", run.device, source, *hand_volume(kitchen, source))
    draw_thin(OUT / "thin.png", run.device, data_source(CHAIR_SOURCE))
    return Part()


def memory_part(run: Run) -> Part:
    """A room of 6 x 3 x 6 m at 1 cm; in a process of its own, whose memory is nobody else's."""
    count = run.of(120, 240)
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        found = pool.submit(_room_memory, count).result()
    part = Part(sizes={"frames of the room": count})
    part.add("room of 6x3x6 m at 1 cm: growth of the process's memory", found["growth_mb"], "MB", "<= 600")
    part.add("room of 6x3x6 m at 1 cm: all of the process", found["resident_mb"], "MB")
    part.add("room of 6x3x6 m at 1 cm: of it the volume on the device", found["device_mb"], "MB")
    part.add("room of 6x3x6 m at 1 cm: surface, median error", found["median_error_voxels"], "voxels")
    part.add("room of 6x3x6 m at 1 cm: pixels covered", 100 * found["covered"], "%")
    part.add("the same room in a small budget: memory on the device", found["small_device_mb"], "MB")
    part.add("the same room in a small budget: on the host", found["small_host_mb"], "MB")
    part.add("the same room in a small budget: most bricks released", found["small_most_released_bricks"], "bricks")
    part.add("the same room in a small budget: pixels that differ", 100 * found["small_differing_pixels"], "%")
    part.add(
        "the same room in a small budget: greatest difference", found["small_greatest_difference_voxels"], "voxels"
    )
    return part


def interleaving_part(run: Run) -> Part:
    """Three cameras into one volume, their pictures in several orders."""
    pictures = run.of(12, 40)
    part = Part(sizes={"pictures of each of three cameras": pictures})
    for name, value in interleaving_spread(run.device, run.say, pictures).items():
        share = not name.endswith("voxels")
        words = name.removesuffix("_voxels").replace("_", " ")
        part.add(f"three cameras: {words}", 100 * value if share else value, "%" if share else "voxels")
    return part


def _room_memory(frames: int) -> dict[str, float]:
    return room_memory(open_device(None), note, frames)

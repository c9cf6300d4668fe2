"""Visibility rays: ours beside Open3D's RaycastingScene (Embree) on the mesh of the same volume; the same rays."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel
from protocol.messages import Wishes
from server.geometry.geometry import Geometry
from server.meshing.scene_mesh import scene_mesh
from server.opencl.engine import Engine
from server.transfer.radiance_transfer import Directions, direction_sets
from server.transfer.visibility import Visibility, trace_visibility
from server.volume.raycast import Surface
from server.volume.volume import Volume
from tests.bench.geometry.filters import in_turn
from tests.bench.report.finished import Part, UnmeasurableError
from tests.bench.report.run import Run, data_source

ROOM = "mitsuba_track_clean"
CUBE_M = (0.0, 0.0, 0.0, 2.0, 2.0, 2.0)
VOXEL_M = 2 / 256
RAYS = 81
REACHES = {"10 cm": 0.1, "the whole room": 100.0}
STRIDES = {"every pixel": 1, "every 4th pixel": 4}

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Scene:
    """What both trace: a fused room and the surface seen in it."""

    engine: Engine
    camera: CameraModel
    volume: Volume
    surface: Surface
    sets: Directions


def visibility_part(run: Run) -> Part:
    """Rays above the surface, from every pixel or every 4th, as radiance transfer asks for them."""
    try:
        import open3d
    except ImportError as error:
        raise UnmeasurableError(f"Open3D is not installed: {error}") from error
    source = data_source(ROOM)
    frames, trials = run.of(30, 60), run.of(2, 7)
    part = Part(sizes={"frames fused for the rays": frames, "trials of all rays": trials})
    engine = Engine(run.device)
    try:
        geometry = Geometry(engine, source.camera, Wishes(volume_m=CUBE_M, voxel_m=VOXEL_M, poses="given"))
        for i in range(frames):
            seen = geometry.scan(source[i])
        volume = geometry.volume
        assert volume is not None
        mesh = scene_mesh(volume.download_bricks(), VOXEL_M, volume.origin_world, np.eye(3))
        vertices = mesh.vertices - volume.origin_world.astype(np.float32)
        threads = (os.cpu_count() or 1) if run.device.is_gpu else run.device.cl_device.max_compute_units
        embree = open3d.t.geometry.RaycastingScene(nthreads=threads)
        embree.add_triangles(vertices, mesh.triangles.astype(np.uint32))
        scene = Scene(engine, source.camera, volume, seen.model, direction_sets(RAYS, 4))
        part.sizes |= {"triangles": len(mesh.triangles), "threads": threads}
        for place, stride in STRIDES.items():
            for length, ray_length_m in REACHES.items():
                run.say(f"rays of {length} at {place}")
                _add_rows(part, scene, embree, f"rays of {length} at {place}", stride, ray_length_m, trials)
    finally:
        engine.close()
    return part


def _add_rows(
    part: Part, scene: Scene, embree: object, name: str, stride: int, ray_length_m: float, trials: int
) -> None:
    import open3d

    found, above, rays = _rays_of(scene, stride, ray_length_m)
    tensor = open3d.core.Tensor(rays)
    blocked = None

    def run_ours() -> None:
        trace_visibility(scene.engine, scene.camera, scene.volume, scene.surface, stride, scene.sets, ray_length_m)
        scene.engine.queue.finish()

    def run_theirs() -> None:
        nonlocal blocked
        blocked = embree.test_occlusions(tensor, 0.0, ray_length_m)  # type: ignore[attr-defined]

    def run_casts() -> None:
        embree.cast_rays(tensor)  # type: ignore[attr-defined]

    ours, theirs, casts = in_turn((run_ours, run_theirs, run_casts), trials)
    threads, million = part.sizes["threads"], len(rays) / 1e6
    part.add(f"{name}: rays above the surface", million, "million")
    for who, (wall_ms, cpu_ms) in {
        "probeless": ours,
        "Open3D test_occlusions": theirs,
        "Open3D cast_rays": casts,
    }.items():
        part.add(f"{name}: {who}, by wall time", million / wall_ms * 1e3, "Mrays/s")
        if not scene.engine.device.is_gpu:
            part.add(f"{name}: {who}, by processor time", million / cpu_ms * 1e3 * threads, "Mrays/s")
    best_wall, best_cpu = (min(theirs[k], casts[k]) for k in range(2))
    goal = ">= 2" if ray_length_m < 1 and stride == 1 else ""
    part.add(f"{name}: rate of probeless / the faster of Open3D's, wall time", best_wall / ours[0], "", goal)
    if not scene.engine.device.is_gpu:
        part.add(f"{name}: the same, processor time", best_cpu / ours[1], "")
    our_blocked = _bits(found.blocked)[above]
    assert blocked is not None
    part.add(f"{name}: blocked, probeless", 100 * our_blocked.mean(), "%")
    part.add(f"{name}: blocked, Open3D", 100 * blocked.numpy().mean(), "%")
    part.add(f"{name}: the same answer", 100 * (our_blocked == blocked.numpy()).mean(), "%")


def _rays_of(scene: Scene, stride: int, ray_length_m: float) -> tuple[Visibility, NDArray[np.bool_], Floats]:
    """What we find, which directions lie above the surface [rows, cols, rays], and those as rays [n, 6]."""
    found = trace_visibility(scene.engine, scene.camera, scene.volume, scene.surface, stride, scene.sets, ray_length_m)
    above = _bits(found.free) | _bits(found.blocked)
    pixels = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    positions, normals = (
        scene.engine.download(a).view(np.float32).reshape(*a.shape, 4)[pixels][..., None, :3]
        for a in (scene.surface.positions, scene.surface.normals)
    )
    row, col = np.indices(above.shape[:2])
    sets = ((row >> 2 & 1) * 2 + (col >> 2 & 1)) * 16 + (row & 3) * 4 + (col & 3)  # direction_sets.clh
    directions = scene.sets.directions[sets, :, :3]
    origins = np.broadcast_to(positions + np.float32(VOXEL_M) * normals, directions.shape)
    return found, above, np.concatenate([origins[above], directions[above]], -1)


def _bits(words: cl_array.Array) -> NDArray[np.bool_]:
    """[rows, cols, RAYS]"""
    host: NDArray[np.uint32] = words.get()
    return np.unpackbits(host.view(np.uint8), axis=-1, bitorder="little", count=RAYS).view(np.bool_)

"""The rasteriser beside Open3D's RaycastingScene (Embree), one ray a pixel: the same meshes, camera and run.

Ours draws position, normal, base colour and material, from the mesh as it lies on the device; theirs finds the nearest
triangle, its normal and where it is met, in a scene that was built before the clock starts.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.objects.rasterize import Placed, rasterize
from server.objects.virtual_object import VirtualObject
from server.opencl.engine import Engine
from server.scene.materials import MATTE, Material, Texture
from server.scene.mesh import Mesh
from tests.bench.geometry.filters import in_turn
from tests.bench.report.finished import Part
from tests.bench.report.run import Run

CAMERA = CameraModel(width=640, height=480, fx=525.0, fy=525.0, cx=319.5, cy=239.5)
TRIANGLES = (1_000, 20_000, 100_000, 500_000)
OBJECTS = (1, 10, 100, 1000)
DISTANCE_M = 1.2

Floats = NDArray[np.float64]


def rasterize_part(run: Run) -> Part:
    """Milliseconds against triangles and against objects, and Open3D's for the same meshes."""
    part = Part(sizes={"trials of the rasteriser": run.of(5, 15)})
    engine = Engine(run.device)
    try:
        for triangles in TRIANGLES:
            run.say(f"{triangles} triangles")
            _add_mesh(part, engine, triangles, run.of(5, 15))
        for count in OBJECTS:
            run.say(f"{count} objects")
            _add_objects(part, engine, count, run.of(5, 15))
    finally:
        engine.close()
    return part


def bumpy_ball(triangles: int, material: Material = MATTE) -> Mesh:
    """A ball of about 1 m with bumps, of about so many triangles, its texture three times around and twice up."""
    rings = max(int(np.sqrt(triangles / 4)), 3)
    up, around = np.meshgrid(np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, 2 * rings + 1), indexing="ij")
    radius = 0.5 + 0.02 * np.sin(9 * around) * np.sin(7 * up)
    directions = np.stack([np.sin(up) * np.cos(around), np.cos(up), np.sin(up) * np.sin(around)], axis=-1)
    index = np.arange(up.size).reshape(up.shape)
    a, b, c, d = (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:])
    halves = [np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (b, d, c))]
    uv = np.stack([around * 3 / (2 * np.pi), up * 2 / np.pi], axis=-1).reshape(-1, 2)
    return Mesh(
        vertices=(radius[..., None] * directions).reshape(-1, 3).astype(np.float32),
        triangles=np.concatenate(halves).astype(np.int32),
        vertex_colors=np.full((up.size, 3), 0.5, np.float32),
        normals=directions.reshape(-1, 3).astype(np.float32),
        up_axis="y",
        uv=np.hstack([uv, uv]).astype(np.float32),
        materials=(material,),
    )


def _textured(mesh: Mesh) -> Mesh:
    pixels = np.random.default_rng(0).integers(0, 256, (1024, 1024, 3), np.uint8)
    return replace(mesh, materials=(Material(color_texture=Texture(pixels), surface_texture=Texture(pixels)),))


def _at(position_m: tuple[float, float, float], scale: float = 1.0) -> Floats:
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[:3, 3] = position_m
    return matrix


def _drawing(engine: Engine, objects: list[Placed]) -> Callable[[], None]:
    def draw() -> None:
        rasterize(engine, CAMERA, np.eye(4), objects)
        engine.queue.finish()
        engine.profile.begin()

    return draw


def _add_mesh(part: Part, engine: Engine, triangles: int, trials: int) -> None:
    mesh, place = bumpy_ball(triangles), _at((0.0, 0.0, DISTANCE_M))
    things = [VirtualObject.upload(engine, m) for m in (mesh, _textured(mesh))]
    runs = [_drawing(engine, [(thing, place)]) for thing in things]
    name = f"{triangles} triangles"
    try:
        cast, covered = _embree(engine, mesh, place)
        runs.append(cast)
    except ImportError as error:
        part.leave_out(f"{name}: Open3D", str(error))
    # Waits between rounds are none: each run begins as the last has finished.
    times = in_turn(tuple(runs), trials)
    _add_times(part, engine, f"{name}: probeless", times[0])
    _add_times(part, engine, f"{name}: probeless, with two textures", times[1])
    if len(times) > 2:
        _add_times(part, engine, f"{name}: Open3D cast_rays", times[2])
        kind = 0 if engine.device.is_gpu else 1  # wall time of a processor depends on what else it does
        ratio = times[2][kind] / times[0][kind]
        part.add(f"{name}: rate of probeless / Open3D's", ratio, "", ">= 1")
        surface = rasterize(engine, CAMERA, np.eye(4), [(things[0], place)])
        ours = engine.download(surface.object_index) >= 0
        part.add(f"{name}: pixels that only one of them covers", 100 * (ours != covered).mean(), "%", "<= 0.05")
    for thing in things:
        thing.release()


def _embree(engine: Engine, mesh: Mesh, place: Floats) -> tuple[Callable[[], None], NDArray[np.bool_]]:
    """What casts a ray through each pixel's centre, and where one meets the mesh."""
    import open3d

    threads = (os.cpu_count() or 1) if engine.device.is_gpu else engine.device.cl_device.max_compute_units
    scene = open3d.t.geometry.RaycastingScene(nthreads=threads)
    vertices = mesh.vertices + place[:3, 3].astype(np.float32)
    scene.add_triangles(vertices, mesh.triangles.astype(np.uint32))
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    directions = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], axis=-1)
    rays = open3d.core.Tensor(np.concatenate([np.zeros_like(directions), directions], axis=-1).astype(np.float32))
    covered: NDArray[np.bool_] = np.isfinite(scene.cast_rays(rays, nthreads=threads)["t_hit"].numpy())
    return lambda: scene.cast_rays(rays, nthreads=threads), covered


def _add_objects(part: Part, engine: Engine, count: int, trials: int) -> None:
    """Objects of 20 triangles each, all in view, in other places every frame."""
    ball = trimesh.creation.icosahedron()
    mesh = Mesh(
        vertices=ball.vertices.astype(np.float32),
        triangles=ball.faces.astype(np.int32),
        vertex_colors=np.full((12, 3), 0.5, np.float32),
        normals=ball.vertices.astype(np.float32),
        up_axis="y",
    )
    thing, rng = VirtualObject.upload(engine, mesh, cells=16), np.random.default_rng(0)

    def draw() -> None:
        places = rng.uniform((-1.0, -0.7, 2.0), (1.0, 0.7, 3.0), (count, 3))
        _drawing(engine, [(thing, _at((x, y, z), 0.03)) for x, y, z in places])()

    _add_times(part, engine, f"{count} objects of 20 triangles", in_turn((draw,), trials)[0])
    thing.release()


def _add_times(part: Part, engine: Engine, name: str, times: tuple[float, float]) -> None:
    wall_ms, cpu_ms = times
    part.add(f"{name}, wall time", wall_ms, "ms")
    if not engine.device.is_gpu:
        part.add(f"{name}, processor time", cpu_ms, "ms")

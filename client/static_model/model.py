"""`probeless model`: the static pipeline (thesis 4.1), from posed depth pictures to a triangle mesh.

Depth fusion into a point cloud, smoothing of normals, orientation by the viewing direction, triangulation. The last is
ball pivoting (Bernardini et al. 1999) of Open3D instead of the thesis's greedy projection (Marton et al. 2009). Both
connect the points themselves, so the mesh keeps their positions, normals and colours. Screened Poisson reconstruction,
trimmed to the points, had 1.5 to many times the error and was slower.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.errors import OptionError, OutputError, RunError
from client.options.capture import parse_frames
from client.options.source import open_source
from client.sources.frame_source import Source
from client.sources.volume import default_volume, default_voxel
from client.static_model.cloud_normals import SurfacePoints, oriented_outwards, smooth
from client.static_model.point_cloud import CloudFusion
from server.maths.sh import webxr_from_world
from server.meshing.files import mesh_files
from server.meshing.scene_mesh import LEAST_PIECE_VOXELS, SceneMesh, srgb8_from_linear, without_specks
from server.meshing.surface import VoxelMesh

BALL_RADII = (1.0, 1.5, 2.5)
"""Ball radii in cells of the cloud. The first fits where every cell has a point; the others close gaps."""
FORMATS = (".ply", ".glb")


@dataclass(frozen=True)
class StaticModel:
    """The mesh, and statistics of the points."""

    mesh: SceneMesh
    points: int
    flipped: int
    """Number of normals that pointed away from the cameras and were flipped."""
    radius_m: float
    """Radius of normal smoothing."""


def check_output(out: Path) -> None:
    """Check before reading frames. Raises OptionError for an unknown format, RunError without Open3D."""
    if out.suffix.lower() not in FORMATS:
        raise OptionError(f"--out {out}: a model is written as {' or '.join(FORMATS)}")
    _open3d()


def open_posed(spec: str, frames: str | None, cell_m: float | None) -> tuple[Source, range, float]:
    """The source, its selected frames and the cell size, from the options `--frames` and `--voxel`.

    Raises OptionError, SourceError.
    """
    if cell_m is not None and not 0 < cell_m <= 1:
        raise OptionError(f"--voxel {cell_m:g}: expected metres, more than 0 and at most 1")
    source = open_source(spec)
    if not source.has_poses:
        raise OptionError(f"{source.name} has no poses, which a model needs; use a source with poses")
    chosen = parse_frames(frames, len(source))
    return source, chosen, cell_m or default_voxel(default_volume(source, chosen))


def model_of_source(
    source: Source, frames: range, cell_m: float, track: Callable[[Iterable[int], int], Iterable[int]]
) -> StaticModel:
    """The model of `frames` with at most one point per cell of size `cell_m`; `track` shows progress over frames.

    Raises UserError.
    """
    fusion = CloudFusion(source.camera, cell_m)
    first_pose = None
    for position in track(frames, len(frames)):
        frame = source[position]
        fusion.add(frame)
        first_pose = frame.world_from_camera if first_pose is None else first_pose
    assert first_pose is not None  # CloudFusion.add refuses frames without a pose
    return model_of_fusion(fusion, cell_m, upright(source.up, first_pose))


def model_of_fusion(fusion: CloudFusion, cell_m: float, gltf_from_world: NDArray[np.float64]) -> StaticModel:
    """Compute normals, orientation and triangles of a fused cloud. Raises RunError if there is no surface."""
    surface, flipped = oriented_outwards(smooth(fusion.cloud()))
    triangles = triangulate(surface, cell_m)
    if not len(triangles):
        raise RunError("the points give no triangles: give more --frames or a larger --voxel")
    colored = np.ones(len(surface.normals), np.bool_)
    cells = VoxelMesh(surface.cloud.points / cell_m, triangles, surface.normals, surface.cloud.colors, colored)
    try:
        mesh = without_specks(cells, LEAST_PIECE_VOXELS)
    except ValueError as error:
        raise RunError("all surface is in specks: give more --frames or a larger --voxel") from error
    return StaticModel(
        SceneMesh(
            vertices=(mesh.vertices * cell_m).astype(np.float32),
            triangles=mesh.triangles.astype(np.int32),
            normals=mesh.normals.astype(np.float32),
            colors=srgb8_from_linear(mesh.colors),
            gltf_from_world=gltf_from_world,
        ),
        points=len(surface.normals),
        flipped=int(flipped.sum()),
        radius_m=surface.radius_m,
    )


def triangulate(surface: SurfacePoints, cell_m: float) -> NDArray[np.int64]:
    """[t, 3] triangles of the points, counter-clockwise seen from the side of the normals."""
    open3d = _open3d()
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(surface.cloud.points))
    cloud.normals = open3d.utility.Vector3dVector(surface.normals)
    radii = open3d.utility.DoubleVector([factor * cell_m for factor in BALL_RADII])
    mesh = open3d.geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(cloud, radii)
    return np.asarray(mesh.triangles, np.int64)


def upright(up: tuple[float, float, float] | None, world_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation [3, 3] gltf_from_world; up is that of the source, else of the first camera."""
    direction = np.array(up if up is not None else -world_from_camera[:3, 1], np.float64)
    return webxr_from_world(direction / np.linalg.norm(direction), world_from_camera[:3, 2])


def write_model(mesh: SceneMesh, out: Path) -> None:
    """Write the mesh in the format of the suffix. Raises OutputError."""
    data = mesh_files(mesh)["ply" if out.suffix.lower() == ".ply" else "glb"]
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_bytes(data)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); name another file with --out") from error


def _open3d() -> Any:
    try:
        return importlib.import_module("open3d")
    except ImportError as error:
        raise RunError(
            "probeless model needs Open3D, which is not installed: .venv/bin/pip install 'open3d>=0.19'"
        ) from error

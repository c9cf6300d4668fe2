"""The scanned scene as one coloured mesh in the world, from the volume's bricks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from server.meshing.surface import MeshingError, VoxelMesh, extract_surface
from server.volume.volume import BRICK, Bricks

LEAST_PIECE_VOXELS = BRICK
"""A connected component smaller than this along x, y and z is treated as noise."""
UNKNOWN_COLOR = 0.5
"""Linear colour of components without any colour."""


@dataclass(frozen=True)
class SceneMesh:
    """Triangles with smooth normals and colours; world metres."""

    vertices: NDArray[np.float32]
    """[v, 3] world."""
    triangles: NDArray[np.int32]
    """[t, 3] counter-clockwise seen from free space."""
    normals: NDArray[np.float32]
    """[v, 3] unit, world, towards free space; (0, 0, 0) if undefined."""
    colors: NDArray[np.uint8]
    """[v, 3] sRGB."""
    gltf_from_world: NDArray[np.float64]
    """[3, 3] rotation to glTF's axes: +y up, the first camera's view as close to -z as possible."""


def scene_mesh(
    bricks: Bricks,
    voxel_m: float,
    origin_world: NDArray[np.float64],
    gltf_from_world: NDArray[np.float64],
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> SceneMesh:
    """The surface of all bricks without small components. Raises MeshingError if nothing is left.

    A voxel cell has surface only if its eight voxels were observed. Components smaller than LEAST_PIECE_VOXELS along
    every axis are removed. Vertices without a colour take their neighbours' mean. `progress` is called with the number
    of parts done and in total.
    """
    mesh = with_all_colors(without_specks(extract_surface(bricks, progress), LEAST_PIECE_VOXELS))
    return SceneMesh(
        vertices=(mesh.vertices * voxel_m + origin_world).astype(np.float32),
        triangles=mesh.triangles.astype(np.int32),
        normals=mesh.normals.astype(np.float32),
        colors=srgb8_from_linear(mesh.colors),
        gltf_from_world=gltf_from_world,
    )


def without_specks(mesh: VoxelMesh, least_voxels: float) -> VoxelMesh:
    """Components of at least this length along one axis. Raises MeshingError if there is none."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(mesh.vertices)
    ends = mesh.triangles[:, [0, 1, 1, 2]].reshape(-1, 2)
    links = coo_array((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(count, count))
    pieces, label = connected_components(links, directed=False)
    order = np.argsort(label, kind="stable")
    starts = np.searchsorted(label[order], np.arange(pieces))
    sorted_vertices = mesh.vertices[order]
    extent = np.maximum.reduceat(sorted_vertices, starts) - np.minimum.reduceat(sorted_vertices, starts)
    kept: NDArray[np.bool_] = (extent.max(axis=1) >= least_voxels)[label]
    if not kept.any():
        raise MeshingError("there is no surface to mesh: every piece is smaller than a brick of voxels")
    number = np.cumsum(kept) - 1
    return VoxelMesh(
        vertices=mesh.vertices[kept],
        triangles=number[mesh.triangles[kept[mesh.triangles[:, 0]]]],
        normals=mesh.normals[kept],
        colors=mesh.colors[kept],
        colored=mesh.colored[kept],
    )


def with_all_colors(mesh: VoxelMesh) -> VoxelMesh:
    """Fill missing vertex colours with the mean of coloured neighbours, ring by ring."""
    ends = mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    to, of = np.concatenate([ends, ends[:, ::-1]]).T
    colors, colored = mesh.colors.copy(), mesh.colored.copy()
    while not colored.all():
        links = colored[of] & ~colored[to]
        if not links.any():
            break
        counts = np.bincount(to[links], minlength=len(colors))
        ring = counts > 0
        for channel in range(3):
            sums = np.bincount(to[links], colors[of[links], channel], len(colors))
            colors[ring, channel] = sums[ring] / counts[ring]
        colored |= ring
        to, of = to[~colored[to]], of[~colored[to]]
    colors[~colored] = UNKNOWN_COLOR
    return replace(mesh, colors=colors, colored=np.ones_like(colored))


def srgb8_from_linear(linear: NDArray[np.float64]) -> NDArray[np.uint8]:
    """8-bit sRGB (IEC 61966-2-1) of linear values, clipped to [0, 1]."""
    clipped = np.clip(linear, 0, 1)
    encoded = np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)
    srgb: NDArray[np.uint8] = (encoded * 255).round().astype(np.uint8)
    return srgb

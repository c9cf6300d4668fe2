"""Textured files as people have them, from the command line's reader to the virtual geometry buffer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from client.objects.object_file import pack_mesh
from protocol.frames import CameraModel
from server.objects.rasterize import rasterize
from server.objects.virtual_object import VirtualObject
from server.opencl.engine import Engine
from server.scene.coarse_colors import colors_at
from server.scene.colors import linear_from_srgb
from server.scene.materials import Beyond, Material, Texture
from server.scene.mesh import load_mesh
from tests.scenes.meshes import mesh_of, pose
from tests.scenes.textured import FACE_COLORS, ROUGHNESS, write_glb, write_obj

CAMERA = CameraModel(width=120, height=120, fx=150.0, fy=150.0, cx=59.5, cy=59.5)
WRITERS = {"glb": write_glb, "obj": write_obj}
LINEAR = linear_from_srgb(FACE_COLORS / 255.0)


def view_of(side: int) -> NDArray[np.float64]:
    """Camera 2 m in front of a side of the cube, the side's own up (see textured.cube) being up in the picture."""
    axis, sign = side // 2, 1 - 2 * (side % 2)
    up, out = np.eye(3)[1 if axis != 1 else 2], sign * np.eye(3)[axis]
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([np.cross(up, out), -up, -out])
    matrix[:3, 3] = -matrix[:3, :3] @ (np.array([0, 0.5, 0]) + 2.5 * out)
    return matrix


@pytest.mark.parametrize("kind", WRITERS)
def test_every_side_shows_its_tile_the_right_way_up(engine: Engine, kind: str, tmp_path: Path) -> None:
    format_, data = pack_mesh(WRITERS[kind](tmp_path))
    mesh = load_mesh(data, format_)
    assert mesh.notes == ()
    thing = VirtualObject.upload(engine, mesh, cells=8)
    for side in range(6):
        surface = rasterize(engine, CAMERA, view_of(side), [(thing, pose((0, 0, 0)))])
        assert surface.material is not None
        color, material = (
            engine.download(a).view(np.float32).reshape(120, 120, 4) for a in (surface.base_color, surface.material)
        )
        rows, columns = np.nonzero(color[..., 3])
        top, left, size = rows.min(), columns.min(), rows.max() - rows.min() + 1
        assert 70 < size < 80
        tile = color[top : top + size, left : left + size, :3]
        np.testing.assert_allclose(tile[size // 2, size // 2], LINEAR[side], atol=1e-6)
        np.testing.assert_allclose(tile[-size // 4, -size // 4], LINEAR[side], atol=1e-6)
        mark = 6 * size // 32
        np.testing.assert_allclose(tile[mark, mark], 0, atol=1e-6)
        np.testing.assert_allclose(tile[mark, -mark], LINEAR[side], atol=1e-6)
        np.testing.assert_allclose(material[rows, columns], np.tile((ROUGHNESS, 0, 0, 1), (len(rows), 1)), atol=1e-6)


def test_coarse_colors_are_those_of_the_tiles(tmp_path: Path) -> None:
    """At the middle of each side, halved by vertex colours; the mark in a corner is seen too."""
    format_, data = pack_mesh(write_glb(tmp_path))
    mesh = load_mesh(data, format_)
    mesh = replace(mesh, vertex_colors=np.full_like(mesh.vertex_colors, 0.5))
    middles = np.repeat([[0.5, 0.0, 0.5], [0.5, 0.5, 0.0]], 6, axis=0)  # of the diagonal that two triangles share
    side = np.argmax(np.stack([mesh.normals, -mesh.normals], axis=2).reshape(-1, 6)[mesh.triangles[:, 0]], axis=1)
    found = colors_at(mesh, np.arange(12), middles)
    np.testing.assert_allclose(found, 0.5 * LINEAR[side], atol=1e-6)
    corner = colors_at(mesh, np.arange(12), np.tile([0.8, 0.1, 0.1], (12, 1)))
    assert (corner.max(axis=1) < 0.5 * found.max(axis=1)).all()


@pytest.mark.parametrize("beyond", Beyond)
def test_coarse_colors_beyond_the_edges(beyond: Beyond) -> None:
    image = np.zeros((4, 4, 3), np.uint8)
    image[:, :, 0] = (0, 60, 120, 240)
    mesh = mesh_of(np.eye(3), [0, 1, 2], np.ones((3, 3)))
    for u, expected in ((1.3, {0: 60, 1: 240, 2: 120}), (-0.1, {0: 240, 1: 0, 2: 0}), (0.6, {0: 120, 1: 120, 2: 120})):
        uv = np.tile(np.array([u, 0.5, 0, 0], np.float32), (3, 1))
        textured = replace(mesh, uv=uv, materials=(Material(color_texture=Texture(image, (beyond, beyond))),))
        found = colors_at(textured, np.array([0]), np.array([[0.2, 0.3, 0.5]]))
        np.testing.assert_allclose(found[0, 0], linear_from_srgb(np.array(expected[int(beyond)] / 255)), atol=1e-6)

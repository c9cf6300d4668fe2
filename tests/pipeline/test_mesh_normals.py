"""Normals of meshes: those of the file, and those made where it has none."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from server.scene.mesh import load_mesh
from tests.scenes.gltf_files import Gltf


def test_creases_are_kept_sharp() -> None:
    mesh = load_mesh(trimesh.creation.box().export(file_type="stl"), "stl")
    assert len(mesh.vertices) == 24
    assert {tuple(n) for n in np.abs(mesh.normals).round(6).tolist()} == {(1, 0, 0), (0, 1, 0), (0, 0, 1)}


def test_round_and_sharp_in_one_mesh() -> None:
    """A cylinder's side is smooth, its rims are sharp."""
    cylinder = trimesh.creation.cylinder(1.0, 2.0, sections=36)
    mesh = load_mesh(cylinder.export(file_type="ply"), "ply")
    is_cap = np.abs(mesh.normals[:, 2]) > 0.999
    np.testing.assert_allclose(mesh.normals[~is_cap][:, 2], 0, atol=1e-6)
    outward = mesh.vertices[~is_cap] * (1, 1, 0)
    np.testing.assert_allclose(mesh.normals[~is_cap], outward, atol=1e-6)  # seen: 6e-8


def test_normals_of_the_file_are_kept() -> None:
    file = Gltf()
    file.quad(NORMAL=np.tile(np.array([0, 3, 4], np.float32), (4, 1)))
    np.testing.assert_allclose(load_mesh(file.glb(), "glb").normals, np.tile((0, 0.6, 0.8), (4, 1)), atol=1e-6)


@pytest.mark.parametrize("bad", [[0.0, 0.0, 0.0], [np.nan, 0.0, 1.0]])
def test_bad_normals_of_the_file_are_replaced(bad: list[float]) -> None:
    normals = np.tile(np.array([0, 3, 4], np.float32), (4, 1))
    normals[2] = bad
    file = Gltf()
    file.quad(NORMAL=normals)
    np.testing.assert_allclose(load_mesh(file.glb(), "glb").normals, np.tile((0, 0, 1), (4, 1)), atol=1e-6)


def test_long_fan_is_smoothed() -> None:
    """Every triangle shares one vertex with all others: pairs of them would not fit the memory."""
    angle = np.linspace(0, 2 * np.pi, 100_001)[:-1]
    rim = np.stack([np.cos(angle), np.sin(angle), np.full_like(angle, 0.1)], axis=1)
    index = np.arange(len(rim))
    triangles = np.stack([np.zeros_like(index), index + 1, np.roll(index, -1) + 1], axis=1)
    fan = trimesh.Trimesh(np.vstack([[0, 0, 0], rim]), triangles, process=False)
    mesh = load_mesh(fan.export(file_type="ply"), "ply")
    assert len(mesh.vertices) == 100_001
    # Exact but for rounding.
    np.testing.assert_allclose(mesh.normals[(mesh.vertices == 0).all(axis=1)], [[0, 0, 1]], atol=1e-9)

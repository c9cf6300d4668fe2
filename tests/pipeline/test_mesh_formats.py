"""What comes out of each format: places, axes, the scene graph; public meshes."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from server.scene.mesh import load_mesh
from tests.data import data_folder
from tests.scenes.gltf_files import Gltf, assert_well_formed, shown_texture
from tests.scenes.meshes import public_mesh


@pytest.mark.parametrize(("format", "up"), [("ply", "z"), ("stl", "z"), ("obj", "y"), ("glb", "y")])
def test_formats_agree(format: str, up: str) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    data = ball.export(file_type=format)
    mesh = load_mesh(data.encode() if isinstance(data, str) else data, format)
    assert_well_formed(mesh)
    assert mesh.up_axis == up
    assert len(mesh.triangles) == len(ball.faces)
    assert len(mesh.vertices) == len(ball.vertices)
    a, b, c = (mesh.vertices[mesh.triangles[:, k]].astype(np.float64) for k in range(3))
    volume = (a * np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(ball.volume, rel=1e-5)  # the triangles still face outwards
    angle = np.degrees(np.arccos(np.clip((mesh.normals * mesh.vertices).sum(axis=1), -1, 1)))
    assert angle.max() < 0.6  # seen: 0.30


def test_gltf_with_embedded_buffer() -> None:
    file = Gltf()
    file.quad()
    assert_well_formed(load_mesh(file.gltf(), "gltf"))
    np.testing.assert_array_equal(load_mesh(file.gltf(), "gltf").vertices, load_mesh(file.glb(), "glb").vertices)


def test_scene_graph_is_applied() -> None:
    file = Gltf()
    file.quad()
    turn = {"rotation": [0, 0, np.sin(np.pi / 4), np.cos(np.pi / 4)], "translation": [10, 0, 0]}  # x to y
    file.nodes({"children": [1, 2], "scale": [2, 2, 2]}, {"mesh": 0} | turn, {"mesh": 0, "translation": [0, 0, 5]})
    mesh = load_mesh(file.glb(), "glb")
    assert_well_formed(mesh)
    places = {tuple(np.round(v, 4)) for v in mesh.vertices.tolist()}
    turned = {(20.0 - 2 * y, 2.0 * x, 0.0) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))}
    assert places == turned | {(2.0 * x, 2.0 * y, 10.0) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))}


def test_mirrored_node_keeps_its_outside() -> None:
    file = Gltf()
    file.quad(NORMAL=np.tile(np.array([0, 0.6, 0.8], np.float32), (4, 1)))
    file.nodes({"mesh": 0, "scale": [-1, 1, 0.5]})
    mesh = load_mesh(file.glb(), "glb")
    a, b, c = mesh.vertices[mesh.triangles[0]]
    assert np.cross(b - a, c - a)[2] > 0
    expected = np.array([0, 0.6, 1.6])  # inverse transpose
    np.testing.assert_allclose(mesh.normals, np.tile(expected / np.linalg.norm(expected), (4, 1)), atol=1e-6)


@pytest.mark.data
def test_every_public_mesh() -> None:
    found = [p for p in sorted(data_folder("mesh").rglob("*")) if p.suffix in {".glb", ".obj", ".ply"}]
    assert len(found) > 30
    for path in found:
        mesh = load_mesh(path.read_bytes(), path.suffix[1:])
        assert_well_formed(mesh)
        assert len(mesh.triangles) > 30, path.name


@pytest.mark.data
def test_duck_is_yellow_with_an_orange_beak() -> None:
    duck = public_mesh("Duck.glb")
    low, high = duck.bounds
    assert (high - low)[1] == pytest.approx(1.54, abs=0.001)  # seen: 0.0004
    body = np.median(shown_texture(duck).image.reshape(-1, 3), axis=0)
    np.testing.assert_allclose(body, (255, 216, 0), atol=1)
    assert duck.uv is not None
    assert duck.uv[:, :2].min() > 0
    assert duck.uv[:, :2].max() < 1

"""Synthetic scenes written in the ground-truth layout, read back through the reader of that layout."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from client.errors import SourceError
from client.options.light_file import read_light
from client.options.source import open_source
from client.synthetic.export import guest_ply, write_ground_truth
from client.synthetic.scenes.guests import GUESTS
from client.synthetic.source import SyntheticSource, open_synthetic
from server.scene.mesh import load_mesh

FRAMES = (0, 30, 45)


@pytest.fixture(scope="module")
def source() -> SyntheticSource:
    return open_synthetic("synthetic:stage?size=64x48&texture=brick&with=ball&light=3")


@pytest.fixture(scope="module")
def folder(source: SyntheticSource, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("stage")
    write_ground_truth(source, path, FRAMES)
    return path


def linear(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1] / 65535


def test_reads_back_as_a_source_without_the_guest(folder: Path, source: SyntheticSource) -> None:
    read, bare = open_source(str(folder)), open_synthetic("synthetic:stage?size=64x48&texture=brick&light=3")
    assert (len(read), read.up, read.has_poses) == (3, (0.0, 1.0, 0.0), True)
    assert (read.camera.fx, read.camera.cx) == (source.camera.fx, source.camera.cx)
    for number, index in enumerate(FRAMES):
        frame = read[number]
        np.testing.assert_array_equal(frame.depth, bare[index].depth)
        np.testing.assert_allclose(frame.color / 65535, bare.truth(index).radiance, atol=0.51 / 65535)
        np.testing.assert_allclose(frame.world_from_camera, bare.pose(index), atol=1e-9)
        assert frame.timestamp_s == pytest.approx(index / 30)


def test_light_and_composites_are_the_truth(folder: Path, source: SyntheticSource) -> None:
    np.testing.assert_array_equal(np.array(read_light(folder / "light.json")), source.truth(0).sh)
    for number, index in enumerate(FRAMES):
        composite = linear(folder / "with_objects" / f"{number:06d}.png")
        np.testing.assert_allclose(composite, source.truth(index).radiance, atol=0.51 / 65535)
    assert np.abs(composite - linear(folder / "color" / "000002.png")).max() > 0.05


def test_truth_in_numbers(folder: Path, source: SyntheticSource) -> None:
    truth = np.load(folder / "truth" / "geometry.npz")
    exact = source.truth(FRAMES[1])
    np.testing.assert_array_equal(truth["depth_with_virtual_m"][1], exact.depth_m)
    np.testing.assert_array_equal(truth["virtual_mask"][1], exact.guest)
    np.testing.assert_array_equal(truth["depth_m"][1][~exact.guest], exact.depth_m[~exact.guest])
    np.testing.assert_allclose(truth["normal_in_world"][1][~exact.guest], exact.normals[~exact.guest], atol=1e-3)
    np.testing.assert_allclose(truth["virtual_albedo"][1][exact.guest], exact.albedo[exact.guest], rtol=1e-3)
    described = json.loads((folder / "truth" / "scene.json").read_text())
    assert described["synthetic"]["look"] == "brick"
    assert (folder / "truth" / "room.ply").stat().st_size > 100_000


def test_the_guests_mesh_is_the_guest(folder: Path) -> None:
    (ball,) = GUESTS["ball"]
    (path,) = json.loads((folder / "meta.json").read_text())["objects"]
    mesh = load_mesh((folder / path).read_bytes(), "ply")
    assert not mesh.notes
    offset = mesh.vertices - ball.solid.center
    np.testing.assert_allclose(np.linalg.norm(offset, axis=1), ball.solid.radius, rtol=1e-5)
    np.testing.assert_allclose(mesh.normals, offset / ball.solid.radius, atol=1e-4)
    np.testing.assert_allclose(mesh.vertex_colors, np.tile(ball.albedo, (len(mesh.vertices), 1)), atol=1e-6)


def test_meshes_of_guests_are_closed() -> None:
    for guest in GUESTS["both"]:
        mesh = load_mesh(guest_ply(guest), "ply")
        _, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
        faces = place.reshape(-1)[mesh.triangles]
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        there = {(int(a), int(b)) for a, b in edges}
        assert len(there) == len(edges)  # each edge once in each direction
        assert all((b, a) in there for a, b in there)


def test_a_scene_without_guests(tmp_path: Path) -> None:
    write_ground_truth(open_synthetic("synthetic:stage?size=32x24"), tmp_path, range(2))
    meta = json.loads((tmp_path / "meta.json").read_text())
    assert "objects" not in meta
    assert not (tmp_path / "with_objects").exists()
    assert len(open_source(str(tmp_path))) == 2


@pytest.mark.parametrize("spec", ["lamp", "light", "stage?exposure=walk"])
def test_other_light_is_refused(spec: str, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"light\.json"):
        write_ground_truth(open_synthetic(f"synthetic:{spec}"), tmp_path, range(1))

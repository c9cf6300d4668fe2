"""Materials that are cut out: what is left of a mesh has the outline that its texture's alpha draws."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from server.scene import cutout
from server.scene.materials import Texture
from server.scene.mesh import Mesh, MeshError, load_mesh
from tests.scenes.gltf_files import QUAD, Gltf, Json, assert_well_formed, color_uv

SIDE, RADIUS = 64, 0.3
UNIT_UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
"""Of QUAD's corners, so that the texture fills it upright."""


def disc(soft_texels: float = 2.0) -> np.ndarray:
    """[SIDE, SIDE, 4] opaque within RADIUS of the middle, of half opacity on the circle itself."""
    y, x = (np.mgrid[:SIDE, :SIDE] + 0.5) / SIDE - 0.5
    alpha = np.clip(0.5 + (RADIUS - np.hypot(x, y)) * SIDE / soft_texels, 0, 1)
    picture = np.full((SIDE, SIDE, 4), 200, np.uint8)
    picture[..., 3] = np.rint(255 * alpha)
    return picture


def card(mode: str, uv: np.ndarray = UNIT_UV, factor: float = 1.0, picture: Any = None, **entry: Any) -> Gltf:
    """A square of one metre with a disc on it."""
    file = Gltf()
    material: Json = file.texture(disc() if picture is None else picture)
    file.quad(material | {"baseColorFactor": [1, 1, 1, factor]}, TEXCOORD_0=uv.astype(np.float32))
    file.header["materials"][0] |= {"alphaMode": mode} | entry
    return file


def area(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.triangles[:, k]].astype(float) for k in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def test_the_outline_is_bilinear_between_texels() -> None:
    """A bilinear function of the texels' centres is met exactly within them."""
    y, x = np.mgrid[:5, :7]
    alpha = (3 * x * y + 20 * y + 9 * x).astype(np.uint8)
    outline = cutout.Outline.of(Texture(np.zeros((5, 7, 3), np.uint8), alpha=alpha), 1.0, 0.25)
    u, v = np.random.default_rng(0).uniform([[0], [0]], [[6], [4]], (2, 50))
    expected = (3 * u * v + 20 * v + 9 * u) / 255 - 0.25
    found = outline.at((np.stack([u, v], axis=1) + 0.5) / [7, 5])
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_card_becomes_its_disc() -> None:
    mesh = load_mesh(card("MASK").glb(), "glb")
    assert_well_formed(mesh)
    assert mesh.notes == ()
    assert area(mesh) == pytest.approx(np.pi * RADIUS**2, rel=0.005)
    away = np.linalg.norm(mesh.vertices[:, :2] - 0.5, axis=1)
    assert away.max() < RADIUS + 0.3 / SIDE
    assert 50 < len(mesh.triangles) < 3000
    for (x, y, _), uv in color_uv(mesh).items():
        np.testing.assert_allclose(uv, (x, 1 - y), atol=1e-5)
    np.testing.assert_allclose(mesh.normals, np.tile((0, 0, 1), (len(mesh.normals), 1)), atol=1e-6)


@pytest.mark.parametrize(("cutoff", "factor"), [(0.25, 1.0), (0.75, 1.0), (0.3, 0.5)])
def test_cutoff_and_factor_move_the_outline(cutoff: float, factor: float) -> None:
    """Opacity falls by 1 over eight texels across the circle."""
    mesh = load_mesh(card("MASK", factor=factor, picture=disc(8.0), alphaCutoff=cutoff).glb(), "glb")
    radius = RADIUS + (0.5 - cutoff / factor) * 8 / SIDE
    assert area(mesh) == pytest.approx(np.pi * radius**2, rel=0.01)


@pytest.mark.parametrize(("wrap", "discs"), [(10497, 9), (33648, 9), (33071, 1)])
def test_textures_that_go_on(wrap: int, discs: int) -> None:
    """Three periods along each axis; clamped, the edge's transparency goes on."""
    file = card("MASK", 3 * UNIT_UV - 1)
    file.header["samplers"] = [{"wrapS": wrap, "wrapT": wrap}]
    file.header["textures"][0]["sampler"] = 0
    mesh = load_mesh(file.glb(), "glb")
    assert area(mesh) == pytest.approx(discs * np.pi * (RADIUS / 3) ** 2, rel=0.002)  # seen: 0.0007


@pytest.mark.parametrize("side", [(0, 0), (1, 0), (0, 1)])
def test_mirrored_textures_are_mirrored(side: tuple[int, int]) -> None:
    """Half of the picture is opaque: of two periods that mirror each other the opaque halves meet."""
    picture = np.full((SIDE, SIDE, 4), 255, np.uint8)
    picture[:, SIDE // 2 :, 3] = 0
    file = card("MASK", UNIT_UV + side, picture=picture)
    file.header["samplers"] = [{"wrapS": 33648, "wrapT": 33648}]
    file.header["textures"][0]["sampler"] = 0
    mesh = load_mesh(file.glb(), "glb")
    assert area(mesh) == pytest.approx(0.5)
    assert mesh.vertices[:, 0].mean() > 0.5 if side[0] else mesh.vertices[:, 0].mean() < 0.5


def test_opaque_materials_are_not_cut() -> None:
    assert area(load_mesh(card("OPAQUE").glb(), "glb")) == pytest.approx(1.0)


def test_blended_materials_are_cut_where_they_say_so_with_a_note() -> None:
    mesh = load_mesh(card("BLEND").glb(), "glb")
    assert area(mesh) == pytest.approx(np.pi * RADIUS**2, rel=0.01)
    assert mesh.notes == ("1 materials are transparent in places; what is less than half opaque is left out",)
    glass = load_mesh(card("BLEND", factor=0.3, picture=disc()[..., :3]).glb(), "glb")
    assert area(glass) == pytest.approx(1.0)
    assert glass.notes == ("1 materials are transparent; they are shown opaque",)


@pytest.mark.parametrize(("factor", "is_left"), [(0.4, False), (0.6, True)])
def test_one_opacity_for_all(factor: float, is_left: bool) -> None:
    file = card("MASK", factor=factor, picture=disc()[..., :3])
    if is_left:
        assert area(load_mesh(file.glb(), "glb")) == pytest.approx(1.0)
    else:
        with pytest.raises(MeshError, match="less opaque than its materials' cutoff"):
            load_mesh(file.glb(), "glb")


def test_no_more_triangles_than_there_is_room_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """The outline is then coarser."""
    monkeypatch.setattr(cutout, "MOST_TRIANGLES", 100)
    mesh = load_mesh(card("MASK").glb(), "glb")
    assert 4 < len(mesh.triangles) < 250
    assert area(mesh) == pytest.approx(np.pi * RADIUS**2, rel=0.15)


def test_solid_triangles_stay_as_they_are() -> None:
    """Those that the outline does not cross, seams included."""
    picture = np.full((SIDE, SIDE, 4), 255, np.uint8)
    picture[0, 0, 3] = 0  # read by nothing
    mesh = load_mesh(card("MASK", 0.5 * UNIT_UV + 0.25, picture=picture).glb(), "glb")
    np.testing.assert_array_equal(np.sort(mesh.vertices, axis=0), np.sort(QUAD, axis=0))
    assert len(mesh.triangles) == 2

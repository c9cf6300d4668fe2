"""Objects of a scene: shared meshes, what is refused, and that refusing changes nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from server.objects import scene_objects
from server.objects.scene_objects import CELLS, FEWER_CELLS, SceneObjects, check_room, mesh_digest
from server.opencl.engine import Engine
from server.scene.limits import MeshError
from server.scene.materials import Beyond, Material, Texture
from server.scene.mesh import Mesh
from server.scene.placement import Placement
from tests.scenes.meshes import shape_of

UP = np.array([0.0, 1.0, 0.0])
HERE = Placement((0.0, 0.0, 1.0))


def box(size: float = 0.2) -> Mesh:
    return shape_of(trimesh.creation.box((size, size, size)))


def test_equal_meshes_are_on_the_device_once(engine: Engine) -> None:
    """Until the last of them goes."""
    scene = SceneObjects(engine, UP)
    for k in range(3):
        scene.place(f"box {k}", box(), Placement((float(k), 0.0, 1.0)))
    scene.place("other", box(0.3), HERE)
    things = [thing for thing, _ in scene.placed(np.eye(4))]
    assert things[0] is things[1] is things[2]
    assert things[3] is not things[0]
    assert [matrix[0, 3] for _, matrix in scene.placed(np.eye(4))] == [0.0, 1.0, 2.0, 0.0]
    scene.remove("box 0")
    scene.place("box 1", box(0.3), HERE)
    kept = [thing for thing, _ in scene.placed(np.eye(4))]
    assert kept == [things[0], things[3], things[3]]
    engine.download(kept[0].vertices)  # still there
    scene.remove("box 2")
    scene.place("box 2", box(), HERE)
    assert scene.placed(np.eye(4))[-1][0] is not things[0]
    scene.clear()
    assert scene.placed(np.eye(4)) == []


def test_a_mesh_in_its_own_place_stays(engine: Engine) -> None:
    scene = SceneObjects(engine, UP)
    scene.place("box", box(), HERE)
    (before,) = scene.placed(np.eye(4))
    scene.place("box", box(), HERE)
    assert scene.placed(np.eye(4))[0][0] is before[0]


def test_what_is_refused_changes_nothing(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = SceneObjects(engine, UP)
    scene.place("box", box(), HERE)
    before = scene.placed(np.eye(4))
    monkeypatch.setattr(scene_objects, "MAX_SCENE_TRIANGLES", 23)
    with pytest.raises(MeshError, match="24 triangles, more than 23"):
        scene.place("second", box(), HERE)
    scene.place("box", box(), HERE)  # in its own place there is room
    monkeypatch.setattr(scene_objects, "MAX_SCENE_TRIANGLES", 100)
    monkeypatch.setattr(scene_objects, "MAX_OBJECTS", 1)
    with pytest.raises(MeshError, match="1 objects"):
        scene.place("second", box(), HERE)
    monkeypatch.undo()
    for placement in (Placement((0, 0, 1), scale=1e9), Placement((1e9, 0, 1))):
        with pytest.raises(ValueError, match=r"m (long|away)"):
            scene.place("box", box(0.3), placement)
        with pytest.raises(ValueError, match=r"m (long|away)"):
            scene.move("box", placement)
    after = scene.placed(np.eye(4))
    assert after[0][0] is before[0][0]
    np.testing.assert_array_equal(after[0][1], before[0][1])


def test_many_meshes_get_coarser_grids(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_objects, "FINE_GRIDS", 2)
    scene = SceneObjects(engine, UP)
    for k in range(4):
        scene.place(str(k), box(0.1 * (k + 1)), HERE)
    sides = [max(thing.grid.dims) for thing, _ in scene.placed(np.eye(4))]
    assert sides == [CELLS, CELLS, FEWER_CELLS, FEWER_CELLS]


def test_room_for_exactly_so_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_objects, "MAX_SCENE_TRIANGLES", 24)
    check_room([box()], box())
    with pytest.raises(MeshError):
        check_room([box(), box()], box())


def test_room_for_so_many_texture_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    texture = Texture(np.zeros((4, 6, 3), np.uint8))
    textured = replace(box(), materials=(Material(color_texture=texture, surface_texture=texture), Material()))
    monkeypatch.setattr(scene_objects, "MAX_SCENE_TEXTURE_PIXELS", 48)
    check_room([textured], textured)
    check_room([textured, textured], box())
    with pytest.raises(MeshError, match="of textures, more than 0: remove objects or give them smaller pictures"):
        check_room([textured, textured], textured)


def test_digest_tells_apart_what_looks_different() -> None:
    image = np.zeros((4, 4, 3), np.uint8)
    plain = box()
    textures = [Texture(image), Texture(image + 1), Texture(image, (Beyond.CLAMP, Beyond.REPEAT))]
    materials = [
        *(Material(color_texture=t) for t in textures),
        Material(surface_texture=textures[0]),
        Material(roughness=0.5),
        Material(metalness=0.5),
    ]
    meshes = [plain, *(replace(plain, materials=(m,)) for m in materials)]
    meshes += [replace(plain, vertices=plain.vertices + 1), replace(plain, uv=np.ones((24, 4), np.float32))]
    assert len({mesh_digest(mesh) for mesh in meshes}) == len(meshes)
    again = replace(plain, materials=(Material(color_texture=Texture(image.copy())),))
    assert mesh_digest(again) == mesh_digest(meshes[1])
    assert mesh_digest(box()) == mesh_digest(plain)

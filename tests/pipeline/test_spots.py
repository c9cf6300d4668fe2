"""Objects on spots that the server finds: pixels, rays, floors, tables, and `auto`; in an exact room, rendered rooms
and a real kitchen."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import cv2
import numpy as np
import pytest
import trimesh
from msgspec import structs
from scipy.spatial.transform import Rotation

from client.options.capture import prepare
from client.options.capture_options import CaptureOptions
from protocol.messages import Spot, SpotKind
from server.client_session import ClientSession
from server.maths.rigid import inverse_rigid
from server.opencl.device import Device
from server.room.client_objects import EAGER, MOST_SEARCHES
from server.room.room import Room
from server.scene.mesh import Mesh, load_mesh
from server.scene.placement import Placement, SpotPlacement, requested_placement
from tests.data import data_folder
from tests.scenes.analytic import Floats, Shape, box, look, look_at, sphere
from tests.scenes.kept_rooms import client_of
from tests.scenes.meshes import shape_of
from tests.scenes.rooms import CAMERA, ROOM, VOXEL_M, frame_at, wishes

UP = np.array([0.0, -1.0, 0.0])
FLOOR_M, TABLE_M = -1.0, -0.4
"""Heights, along `UP`."""
TABLE = box((-1.4, 0.4, 1.0), (-0.2, 0.45, 1.9))
FURNISHED: list[Shape] = [ROOM[0], TABLE]
VIEW = look_at((-0.8, -0.6, -0.3), (-0.8, 0.5, 1.3))
AWAY = look_at((0.4, -0.5, 0.5), (1.5, -0.5, 2.4))
"""Shows walls alone."""


def cube(side_m: float = 0.1) -> Mesh:
    return shape_of(trimesh.creation.box((side_m, side_m, side_m)))


def on(kind: SpotKind, scale: float | None = 1.0, **more: object) -> SpotPlacement:
    return SpotPlacement(Spot(on=kind, **more), scale)  # type: ignore[arg-type]


@pytest.fixture
def session(device: Device) -> Iterator[ClientSession]:
    opened = ClientSession(device, CAMERA, wishes("given", up=(0.0, -1.0, 0.0)))
    yield opened
    opened.close()


def see(
    session: ClientSession, index: int = 0, view: Floats = VIEW, scene: list[Shape] | None = None
) -> tuple[str, ...]:
    """Process a frame; what is told of objects."""
    frame = frame_at(view, index, scene=FURNISHED if scene is None else scene, given=view)
    return tuple(note for note in session.process(frame).notes if "object" in note)


def standing(session: ClientSession) -> dict[str, Floats]:
    """The middle of each placed object's floor, in the room."""
    places = {}
    for kept in session._room.objects.kept():
        low, high = kept.mesh.bounds
        axis = "xyz".index(kept.mesh.up_axis)
        middle = (low + high) / 2
        middle[axis] = low[axis]
        assert not isinstance(kept.place, Placement)
        places[kept.object_id] = kept.place[:3, :3] @ middle + kept.place[:3, 3]
    return places


def corners_in_picture(session: ClientSession, name: str, world_from_camera: Floats) -> bool:
    """Whether all of an object's box is in the picture."""
    kept = {kept.object_id: kept for kept in session._room.objects.kept()}[name]
    corners = trimesh.bounds.corners(np.array(kept.mesh.bounds))
    seen = inverse_rigid(world_from_camera) @ kept.place @ np.column_stack([corners, np.ones(8)]).T
    camera = session._camera
    u, v = camera.fx * seen[0] / seen[2] + camera.cx, camera.fy * seen[1] / seen[2] + camera.cy
    return bool(((u > 0) & (u < camera.width - 1) & (v > 0) & (v < camera.height - 1) & (seen[2] > 0)).all())


def test_a_pixel_is_the_surface_seen_there(session: ClientSession) -> None:
    truth = look(FURNISHED, CAMERA, VIEW)
    pixels = [(80.0, 60.0), (40.0, 90.0), (120.0, 20.0), (10.0, 10.0)]
    for number, pixel in enumerate(pixels):
        session.place_object(f"{number}", cube(), on("pixel", pixel=pixel))
    notes = see(session)
    assert len(notes) == len(pixels)
    for (u, v), place in zip(pixels, standing(session).values(), strict=True):
        np.testing.assert_allclose(place, truth.points[round(v), round(u)], atol=1e-3)  # depth is in millimetres


def test_between_pixels_the_place_is_on_the_exact_ray(session: ClientSession) -> None:
    session.place_object("cube", cube(), on("pixel", pixel=(80.4, 60.3)))
    see(session)
    seen = inverse_rigid(VIEW) @ [*standing(session)["cube"], 1.0]
    assert CAMERA.fx * seen[0] / seen[2] + CAMERA.cx == pytest.approx(80.4)
    assert CAMERA.fy * seen[1] / seen[2] + CAMERA.cy == pytest.approx(60.3)


def test_a_pixel_of_a_later_frame_waits_for_it(session: ClientSession) -> None:
    session.place_object("cube", cube(), on("pixel", pixel=(80.0, 60.0), frame=2))
    moved = look_at((-0.7, -0.6, -0.3), (-0.7, 0.5, 1.3))
    for index, view in enumerate((VIEW, VIEW, moved)):
        assert not standing(session)
        notes = see(session, index, view)
    assert "in pixel 80,60" in notes[0]
    # Seen: 1e-5.
    np.testing.assert_allclose(standing(session)["cube"], look(FURNISHED, CAMERA, moved).points[60, 80], atol=1e-4)


def test_pixels_that_cannot_be(session: ClientSession) -> None:
    with pytest.raises(ValueError, match="pixel 160,3 is beyond the picture of 160x120"):
        session.place_object("cube", cube(), on("pixel", pixel=(160.0, 3.0)))
    session.place_object("late", cube(), on("pixel", pixel=(80.0, 60.0), frame=1))
    session.place_object("hole", cube(), on("pixel", pixel=(5.0, 5.0)))
    only_table = [TABLE]
    (told,) = see(session, 2, scene=only_table)[1:]
    assert told == "object 'hole' is not placed: pixel 5,5 of frame 2 shows no surface: choose another"
    session.place_object("late", cube(), on("pixel", pixel=(80.0, 60.0), frame=1))
    assert "frame 1 was not processed before frame 3" in see(session, 3)[0]
    assert not standing(session)
    with pytest.raises(KeyError):
        session.remove_object("late")


def test_a_ray_meets_the_scan(session: ClientSession) -> None:
    """Within the error of the fused surface: a fifth of a voxel."""
    see(session)
    session.place_object("cube", cube(), on("ray", origin_m=(-0.8, -0.6, 0.2), direction=(0.0, 2.0, 2.2)))
    session.place_object("none", cube(), on("ray", origin_m=(-0.8, -0.6, 0.2), direction=(0.0, 0.0, -1.0)))
    notes = see(session, 1)
    np.testing.assert_allclose(standing(session)["cube"], (-0.8, 0.4, 1.3), atol=0.05 * VOXEL_M)  # seen: 0.004
    assert notes[1] == (
        "object 'none' is not placed: its ray meets no scanned surface: choose another, or scan there first"
    )


@pytest.mark.parametrize(("kind", "height_m"), [("table", TABLE_M), ("floor", FLOOR_M), ("auto", TABLE_M)])
def test_horizontal_surfaces(session: ClientSession, kind: SpotKind, height_m: float) -> None:
    session.place_object("cube", cube(), on(kind, None if kind == "auto" else 1.0))
    (told,) = see(session)
    place = standing(session)["cube"]
    assert place @ UP == pytest.approx(height_m, abs=0.005)
    assert f"{place[0]:.3f},{place[1]:.3f},{place[2]:.3f}" in told
    assert corners_in_picture(session, "cube", VIEW)
    if height_m == TABLE_M:  # the whole cube stands on it
        assert -1.4 < place[0] - 0.07 < place[0] + 0.07 < -0.2
        assert 1.0 < place[2] - 0.07 < place[2] + 0.07 < 1.9
        assert "table" in told
        assert "0.60 m over the floor" in told


def test_an_object_keeps_clear_of_what_stands_there(session: ClientSession) -> None:
    vase = (-0.8, 0.3, 1.4)  # where the cube would stand
    session.place_object("cube", cube(), on("table"))
    see(session, scene=[*FURNISHED, sphere(vase, 0.12)])
    assert np.linalg.norm(standing(session)["cube"][[0, 2]] - np.array(vase)[[0, 2]]) > 0.12 + 0.05


def test_objects_keep_clear_of_each_other(session: ClientSession) -> None:
    for number in range(4):
        session.place_object(f"{number}", cube(), on("table"))
    see(session)
    session.place_object("0", cube(), on("table"))  # again: it is not in its own way
    see(session, 1)
    places = [place[[0, 2]] for place in standing(session).values()]
    apart = [np.linalg.norm(a - b) for a, b in combinations(places, 2)]
    assert len(places) == 4
    assert min(apart) > 0.1 * np.sqrt(2)
    assert all(place @ UP == pytest.approx(TABLE_M, abs=0.005) for place in standing(session).values())


@pytest.mark.parametrize("width_m", [0.015, 0.2])
def test_an_object_is_not_put_behind_something(session: ClientSession, width_m: float) -> None:
    """A pillar stands before the middle of the table. Behind the thin one the table is seen without a gap."""
    pillar = box((-0.8 - width_m / 2, -1.0, 0.5), (-0.8 + width_m / 2, 1.0, 0.6))
    session.place_object("cube", cube(), on("table"))
    see(session, scene=[*FURNISHED, pillar])
    (kept,) = session._room.objects.kept()
    corners = trimesh.bounds.corners(np.array(kept.mesh.bounds))
    rays = (kept.place @ np.column_stack([corners, np.ones(8)]).T).T[:, :3] - VIEW[:3, 3]
    distances, _ = pillar(VIEW[:3, 3], rays)
    assert np.isinf(distances).all()


def test_where_all_places_are_hidden_it_is_told(session: ClientSession) -> None:
    """A board close to the camera hides the upper part of the picture, so the top of a vase wherever it stands."""
    board = box((-2.0, -1.0, 0.3), (2.0, -0.264, 0.35))
    vase = shape_of(trimesh.creation.box((0.1, 0.1, 0.3)))
    session.place_object("cube", cube(0.05), on("table"))
    session.place_object("vase", vase, on("table"))
    low, high = see(session, scene=[*FURNISHED, board])
    assert "not all of it is in view" not in low
    assert "not all of it is in view" in high


def test_one_that_does_not_fit_is_placed_and_told(session: ClientSession) -> None:
    session.place_object("large", cube(), on("table", 20.0))
    (told,) = see(session)
    assert "its floor of 2.83 m does not fit" in told
    assert standing(session)["large"] @ UP == pytest.approx(TABLE_M, abs=0.005)


def test_a_spot_that_is_not_in_view_waits_and_is_told_once(session: ClientSession) -> None:
    session.place_object("cube", cube(), on("table"))
    session.place_object("other", cube(), on("auto", None))
    walls = [ROOM[0]]
    assert see(session, 0, AWAY, walls) == (
        "object 'cube' waits: no table is in view yet, nor other horizontal surface off the floor",
        "object 'other' waits: no horizontal surface is in view yet",
    )
    for index in range(1, EAGER + 2):
        assert see(session, index, AWAY, walls) == ()
    session.remove_object("other")
    told = [see(session, index) for index in range(EAGER + 2, EAGER + 12)]
    assert set(standing(session)) == {"cube"}
    assert len([notes for notes in told if notes]) == 1


def test_many_searches_take_several_frames(session: ClientSession) -> None:
    for number in range(MOST_SEARCHES + 3):
        session.place_object(f"{number}", cube(0.02), on("table"))
    session.place_object("pixel", cube(0.02), on("pixel", pixel=(10.0, 10.0)))
    see(session)
    assert len(standing(session)) == MOST_SEARCHES + 1
    assert "pixel" in standing(session)
    see(session, 1)
    assert len(standing(session)) == MOST_SEARCHES + 4


def test_a_waiting_object_is_moved_and_removed(session: ClientSession) -> None:
    session.place_object("moved", cube(), on("table"))
    session.place_object("gone", cube(), on("table"))
    session.move_object("moved", Placement(position_m=(0.0, 0.9, 1.0)))
    session.remove_object("gone")
    see(session)
    see(session, 1)
    assert set(standing(session)) == {"moved"}
    np.testing.assert_allclose(standing(session)["moved"], (0.0, 0.9, 1.0), atol=1e-9)


@pytest.mark.parametrize("spot", [on("table"), on("pixel", pixel=(80.0, 100.0))], ids=["table", "pixel"])
def test_a_still_view_that_is_reused_shows_spots_too(device: Device, spot: SpotPlacement) -> None:
    """Under a given light a view rests soon."""
    session = ClientSession(device, CAMERA, wishes("given", up=(0.0, -1.0, 0.0), light=((1.0, 1.0, 1.0),)))
    for _ in range(60):
        result = session.process(frame_at(VIEW, 0, scene=FURNISHED, given=VIEW))
        if result.is_reused:
            break
    assert result.is_reused
    session.place_object("cube", cube(), spot)
    result = session.process(frame_at(VIEW, 0, scene=FURNISHED, given=VIEW))
    assert set(standing(session)) == {"cube"}
    assert result.color is not None
    assert (result.color != frame_at(VIEW, 0, scene=FURNISHED).color).any()
    session.close()


def test_auto_takes_the_own_size_where_it_fits_and_else_one_that_does(session: ClientSession) -> None:
    """A cube of 0.2 m fits on the table, one of 2.5 m nowhere, one of 300 is in millimetres (its file has no units)."""
    expected = {
        0.2: "0.20 m high (scale 1: its own size)",
        2.5: "at its own 2.50 m it does not fit there)",
        300.0: "0.30 m high (scale 0.001: its own size; its numbers are taken as mm)",
    }
    for side, words in expected.items():
        session.place_object("cube", cube(side), on("auto", None))
        (told,) = see(session)
        assert words in told
        (kept,) = session._room.objects.kept()
        assert 0.1 < side * np.linalg.norm(kept.place[:3, 0]) < 0.9
        assert corners_in_picture(session, "cube", VIEW)
        assert standing(session)["cube"] @ UP == pytest.approx(TABLE_M, abs=0.001)  # seen: 5e-5


def test_a_height_takes_the_place_of_the_scale(session: ClientSession) -> None:
    mesh = shape_of(trimesh.creation.box((0.5, 0.25, 4.0)))
    session.place_object("auto", mesh, requested_placement(mesh, None, Spot(on="auto"), height_m=0.3))
    session.place_object("at", mesh, requested_placement(mesh, (0.0, 0.9, 1.0), None, 7.0, height_m=0.2))
    see(session)
    sizes = {kept.object_id: np.linalg.norm(kept.place[:3, 2]) * 4 for kept in session._room.objects.kept()}
    assert sizes == pytest.approx({"auto": 0.3, "at": 0.2})
    flat = shape_of(trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]))
    with pytest.raises(ValueError, match="the model is flat"):
        requested_placement(flat, None, Spot(on="auto"), height_m=0.3)


def test_what_is_outside_of_the_volume_or_larger_is_told_once(session: ClientSession) -> None:
    session.place_object("far", cube(), Placement(position_m=(0.0, 0.0, 60.0)))
    session.place_object("large", cube(), Placement(position_m=(0.0, 0.9, 1.0), scale=70.0))
    session.place_object("fine", cube(), Placement(position_m=(0.0, 0.9, 1.0)))
    notes = see(session)
    assert len(notes) == 2
    assert "'far' is at 0.00,-0.05,60.00, outside of the scanned volume of 4.4 x 2.2 x 3.2 m" in notes[0]
    assert "'large' is 7.0 m long, larger than the scanned volume" in notes[1]
    assert see(session, 1) == ()


def test_in_a_shared_room_spots_are_of_the_clients_own_world(device: Device) -> None:
    asked = wishes("given", up=(0.0, -1.0, 0.0))
    room = Room(device, asked, "study")
    place = np.eye(4)
    place[:3, :3] = Rotation.from_rotvec([0.0, 0.4, 0.0]).as_matrix()
    place[:3, 3] = 0.5, 0.0, -0.25
    client = client_of(device, room, asked)
    see(client)
    other = client_of(device, room, asked, room_from_world=tuple(place.ravel()))
    own_view = inverse_rigid(place) @ VIEW
    other.place_object("pixel", cube(), on("pixel", pixel=(80.0, 60.0)))
    origin = place[:3, :3].T @ (np.array([-0.8, -0.6, 0.2]) - place[:3, 3])
    direction = place[:3, :3].T @ np.array([0.0, 2.0, 2.2])
    other.place_object("ray", cube(), on("ray", origin_m=tuple(origin), direction=tuple(direction)))
    assert room.objects.inventory().pending == ("pixel", "ray")
    notes = other.process(frame_at(VIEW, 0, scene=FURNISHED, given=own_view)).notes
    assert room.objects.inventory().pending == ()
    places = standing(client)
    truth = look(FURNISHED, CAMERA, VIEW).points[60, 80]
    # Its place in the room is fitted to the scan; seen: 0.0004.
    np.testing.assert_allclose(places["pixel"], truth, atol=0.002)
    np.testing.assert_allclose(places["ray"], (-0.8, 0.4, 1.3), atol=0.002)  # seen: 0.0004
    told = [note for note in notes if "'pixel' stands at" in note]
    x, y, z = place[:3, :3].T @ (truth - place[:3, 3])
    assert [float(word) for word in told[0].split(" at ")[1].split(" ")[0].split(",")] == pytest.approx(
        (x, y, z), abs=0.01
    )
    for each in (client, other):
        each.close()
    room.close()


KITCHEN_PIXELS = [(420, 280), (300, 340), (60, 170), (150, 400), (520, 60)]
"""Table, table's edge, front of a cupboard, carpet, books on the worktop."""


def test_five_pixels_of_the_kitchen(device: Device) -> None:
    folder = data_folder("rgbd_7scenes_redkitchen")
    capture = prepare(CaptureOptions(source=str(folder)))
    session = ClientSession(device, capture.source.camera, capture.wishes)
    mesh = cube()
    for number, (u, v) in enumerate(KITCHEN_PIXELS):
        session.place_object(f"{number}", mesh, on("pixel", pixel=(float(u), float(v)), frame=1))
    for index in range(2):
        session.process(capture.source[index])
    depth_m = cv2.imread(str(folder / "data/frame-000001.depth.png"), cv2.IMREAD_UNCHANGED) / 1000
    pose = capture.source[1].world_from_camera
    for (u, v), place in zip(KITCHEN_PIXELS, standing(session).values(), strict=True):
        z = depth_m[v, u]
        point = pose @ [(u - 320) / 585 * z, (v - 240) / 585 * z, z, 1.0]
        assert np.linalg.norm(place - point[:3]) < 1e-4  # seen: 1e-7
    session.close()


def test_a_duck_anywhere_in_the_kitchen(device: Device) -> None:
    """No coordinates are known: it stands on the table, all of it in view, at a size for a table, with a shadow."""
    capture = prepare(CaptureOptions(source=str(data_folder("rgbd_7scenes_redkitchen"))))
    duck = load_mesh((data_folder("mesh") / "Duck.glb").read_bytes(), "glb")
    session = ClientSession(device, capture.source.camera, capture.wishes)
    session.place_object("duck", duck, on("auto", None))
    frame = capture.source[0]
    result = session.process(frame)
    (told,) = [note for note in result.notes if "'duck' stands at" in note]
    assert "on a table" in told
    (kept,) = session._room.objects.kept()
    height_m = float(np.linalg.norm(kept.place[:3, 1]) * (duck.bounds[1] - duck.bounds[0])[1])
    assert 0.1 < height_m < 0.4
    assert corners_in_picture(session, "duck", frame.world_from_camera)
    # The table's plane, through the raw depth of a part of it that is free in the picture.
    v, u = np.mgrid[275:305, 400:470]
    z = frame.depth[275:305, 400:470] / 1000
    points = np.stack([(u - 320) / 585 * z, (v - 240) / 585 * z, z], axis=-1).reshape(-1, 3)
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    seen = (inverse_rigid(frame.world_from_camera) @ [*standing(session)["duck"], 1.0])[:3]
    assert abs((seen - middle) @ normal) < 0.003  # 0.2 m beside the part, whose tilt is known to a degree or two
    # Darker around it than in the camera's picture, and unchanged far away.
    change = result.color.astype(int) - frame.color
    foot = (585 * seen[:2] / seen[2] + (320, 240)).round().astype(int)
    below = change[foot[1] + 10 : foot[1] + 40, foot[0] - 60 : foot[0] + 60].mean()
    assert below < -10  # seen: -20
    assert np.abs(change[-40:]).mean() < 0.5  # seen: 0.22
    session.close()


@pytest.mark.parametrize(
    ("name", "table_m"), [("r1_ceiling", 0.74), ("r2_spots", 0.74), ("r3_two", 0.74), ("r4_window", 0.74)]
)
def test_tables_of_rendered_rooms(device: Device, name: str, table_m: float) -> None:
    """Floors are at height 0; the tables' tops at those of the objects that stand on them. Up is withheld."""
    capture = prepare(CaptureOptions(source=str(data_folder("rooms") / name)))
    session = ClientSession(device, capture.source.camera, structs.replace(capture.wishes, up=None))
    for kind in ("table", "floor", "auto"):
        session.place_object(kind, cube(), on(kind, None if kind == "auto" else 1.0))
    frame = capture.source[0]
    session.process(frame)
    heights = {kind: place @ UP for kind, place in standing(session).items()}
    assert heights == pytest.approx({"table": table_m, "floor": 0.0, "auto": table_m}, abs=0.005)
    for kind in heights:
        assert corners_in_picture(session, kind, frame.world_from_camera)
    session.close()

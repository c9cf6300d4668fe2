"""Strangers' files read in processes of their own: the same results, and deaths that only their sender hears of."""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import trimesh

from protocol.codec import ProtocolError
from protocol.colors import ColorReader
from protocol.frames import CameraModel
from protocol.images import decode_color, encode_color
from protocol.messages import Acknowledged, Composite, Dropped, PlaceObject
from server.children.nursery import ChildDied
from server.children.process_pool import ProcessPool
from server.objects.scene_objects import mesh_digest
from server.parsing.mesh_bytes import mesh_from_bytes, mesh_to_bytes
from server.parsing.parsers import MESH_JOB, PICTURE_JOB, Parsers
from server.scene.limits import MeshError
from server.scene.materials import Beyond, Material, Texture
from server.scene.mesh import Mesh, load_mesh
from tests.data import ROOT
from tests.scenes.gltf_files import assert_well_formed
from tests.scenes.textured import write_glb
from tests.service.fakes import CAMERA, PATIENCE_S, fake_mesh, frame_message, rgbd_frame
from tests.service.http import rows
from tests.service.jobs import triangle
from tests.service.wire import Wire

STUBBORN_MESHES = replace(MESH_JOB, job="tests.service.jobs:read_mesh")
STUBBORN_PICTURES = replace(PICTURE_JOB, job="tests.service.jobs:read_picture")
IMPATIENT = replace(STUBBORN_MESHES, timeout_s=2.0)


@pytest.fixture(scope="module")
def parsers() -> Iterator[Parsers]:
    """The real ones."""
    parsers = Parsers()
    yield parsers
    parsers.stop()


@pytest.fixture(scope="module")
def stubborn() -> Iterator[Parsers]:
    """Whose children do as the file says."""
    parsers = Parsers(STUBBORN_MESHES, STUBBORN_PICTURES)
    yield parsers
    parsers.stop()


@pytest.fixture(scope="module")
def impatient() -> Iterator[Parsers]:
    """Who wait a moment only."""
    parsers = Parsers(IMPATIENT)
    yield parsers
    parsers.stop()


def files(folder: Path) -> dict[str, bytes]:
    """A file of every format."""
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    box.visual.vertex_colors = np.random.default_rng(0).integers(0, 256, (8, 4), np.uint8)
    made = {kind: box.export(file_type=kind) for kind in ("obj", "ply", "stl")}
    encoded = {kind: data.encode() if isinstance(data, str) else data for kind, data in made.items()}
    return {**encoded, "glb": write_glb(folder).read_bytes()}


@pytest.mark.parametrize("kind", ["obj", "ply", "stl", "glb"])
def test_a_mesh_is_what_it_would_be_if_read_here(parsers: Parsers, tmp_path: Path, kind: str) -> None:
    data = files(tmp_path)[kind]
    here, there = load_mesh(data, kind), parsers.load_mesh(data, kind)
    assert_well_formed(there)
    assert mesh_digest(there) == mesh_digest(here)
    assert (there.notes, there.up_axis, len(there.materials)) == (here.notes, here.up_axis, len(here.materials))
    for name in ("vertices", "triangles", "vertex_colors", "normals", "uv", "triangle_materials"):
        np.testing.assert_array_equal(getattr(there, name), getattr(here, name))
        assert getattr(there, name).flags.writeable


@pytest.mark.parametrize(
    ("data", "kind"), [(b"", "glb"), (b"junk", "glb"), (b"ply\nend_header\n", "ply"), (b"", "blend")]
)
def test_errors_are_what_they_would_be_here(parsers: Parsers, data: bytes, kind: str) -> None:
    with pytest.raises(MeshError) as here:
        load_mesh(data, kind)
    with pytest.raises(MeshError) as there:
        parsers.load_mesh(data, kind)
    assert str(there.value) == str(here.value)


def textured() -> Mesh:
    """Two materials that share a texture, and every field another than its default."""
    random = np.random.default_rng(0)
    image, alpha = random.integers(0, 256, (3, 5, 3), np.uint8), random.integers(0, 256, (3, 5), np.uint8)
    shared = Texture(image, (Beyond.CLAMP, Beyond.MIRROR), alpha)
    both = Material(0.25, 0.5, color_texture=shared, surface_texture=Texture(image + 1), cutoff=0.5, opacity=0.75)
    return replace(
        triangle(),
        uv=random.random((3, 4), np.float32),
        triangle_materials=np.array([1], np.int32),
        materials=(both, Material(color_texture=shared)),
        notes=("one", "two"),
        up_axis="z",
    )


def test_bytes_keep_everything_and_what_is_shared() -> None:
    mesh, back = textured(), mesh_from_bytes(mesh_to_bytes(textured()))
    assert mesh_digest(back) == mesh_digest(mesh)
    first, second = back.materials
    assert first.color_texture is second.color_texture
    np.testing.assert_array_equal(first.color_texture.alpha, mesh.materials[0].color_texture.alpha)
    assert (first.cutoff, first.opacity, back.notes, back.up_axis) == (0.5, 0.75, ("one", "two"), "z")
    assert mesh_from_bytes(mesh_to_bytes(triangle())).uv is None


LIES = {
    "triangles that do not exist": {"triangles": np.array([[0, 1, 3]], np.int32)},
    "negative triangles": {"triangles": np.array([[0, 1, -1]], np.int32)},
    "no triangles": {"triangles": np.zeros((0, 3), np.int32)},
    "infinite vertices": {"vertices": np.full((3, 3), np.inf, np.float32)},
    "vertices that are no numbers": {"vertices": np.full((3, 3), np.nan, np.float32)},
    "far vertices": {"vertices": np.full((3, 3), 1e9, np.float32)},
    "long normals": {"normals": np.full((3, 3), 7, np.float32)},
    "too few normals": {"normals": np.zeros((2, 3), np.float32)},
    "too few colours": {"vertex_colors": np.zeros((2, 3), np.float32)},
    "half a vertex": {"vertices": np.zeros((3, 2), np.float32)},
    "materials that do not exist": {"triangle_materials": np.array([7], np.int32)},
    "no materials": {"materials": ()},
    "coordinates that are no numbers": {"uv": np.full((3, 4), np.nan, np.float32)},
}


@pytest.mark.parametrize("lie", LIES)
def test_what_a_child_says_is_not_believed(lie: str) -> None:
    with pytest.raises(MeshError, match="the mesh reader's answer is not a valid mesh"):
        mesh_from_bytes(mesh_to_bytes(replace(textured(), **LIES[lie])))


def test_a_childs_textures_are_not_believed() -> None:
    fields = msgspec.msgpack.decode(mesh_to_bytes(textured()))
    for wrong in ((5, 4), (0, 3), (-5, -3), (15, 2), (5000, 1)):
        fields[9][0][:2] = wrong
        with pytest.raises(MeshError, match="is not a valid mesh"):
            mesh_from_bytes(msgspec.msgpack.encode(fields))


def test_random_damage_gives_a_mesh_or_an_error() -> None:
    random, data, whole = np.random.default_rng(0), mesh_to_bytes(textured()), 0
    for _ in range(3000):
        damaged = bytearray(data[: random.integers(1, len(data) + 1)] if random.random() < 0.2 else data)
        for _ in range(random.integers(1, 4)):
            damaged[random.integers(len(damaged))] = random.integers(256)
        try:
            mesh = mesh_from_bytes(damaged)
        except MeshError:
            continue
        whole += 1
        assert np.isfinite(mesh.vertices).all()
        assert mesh.triangles.max() < len(mesh.vertices)
    assert 100 < whole < 2900


def told(parsers: Parsers, data: bytes) -> str:
    """The one line about a file that goes wrong."""
    with pytest.raises(MeshError) as error:
        parsers.load_mesh(data, "ply")
    assert "\n" not in str(error.value)
    return str(error.value)


def is_served(parsers: Parsers) -> bool:
    """Whether the next mesh is read."""
    return len(parsers.load_mesh(b"tiny", "ply").vertices) == 3


def test_a_mesh_that_hangs_its_reader_is_told_and_the_next_has_a_new_one(impatient: Parsers) -> None:
    deaths: list[str] = []
    impatient.on_death = deaths.append
    assert is_served(impatient)
    (before,) = impatient.meshes.pids
    assert "was stopped: it took more than 2 s" in told(impatient, b"hang")
    assert impatient.meshes.pids == []
    assert is_served(impatient)
    assert impatient.meshes.pids != [before]
    assert deaths == ["mesh"]


def test_a_mesh_that_needs_too_much_memory_is_told(stubborn: Parsers) -> None:
    assert told(stubborn, b"eat") == "reading it takes too much memory: make it smaller"
    assert is_served(stubborn)


def test_a_real_file_that_needs_too_much_memory_is_told() -> None:
    vertices = np.random.default_rng(0).random((300_000, 3), np.float32)
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(vertices) // 3}\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    faces = np.zeros(len(vertices) // 3, np.dtype([("n", "u1"), ("v", "<i4", 3)]))
    faces["n"], faces["v"] = 3, np.arange(len(faces) * 3).reshape(-1, 3)
    data = header + vertices.tobytes() + faces.tobytes()
    children = ProcessPool(MESH_JOB, 1)
    assert len(mesh_from_bytes(children.ask(b"ply\n" + data)).triangles) > 90_000
    (pid,) = children.pids
    status = Path(f"/proc/{pid}/status").read_text().splitlines()
    children.stop()
    loaded_mib = int(next(line for line in status if line.startswith("VmSize")).split()[1]) >> 10
    tight = Parsers(replace(MESH_JOB, memory_mib=max(64, loaded_mib - 200)))
    try:
        with pytest.raises(MeshError, match=r"memory|Memory|allocate|died"):
            tight.load_mesh(data, "ply")
    finally:
        tight.stop()


def test_a_mesh_that_crashes_its_reader_is_told(stubborn: Parsers) -> None:
    expected = "the reader of the ply file died on it (signal 11): simplify the mesh or repair it"
    assert told(stubborn, b"crash") == expected
    assert is_served(stubborn)


def test_a_reader_killed_in_the_middle_is_told_and_replaced(stubborn: Parsers) -> None:
    assert is_served(stubborn)
    (pid,) = stubborn.meshes.pids
    killer = threading.Timer(0.1, os.kill, (pid, signal.SIGKILL))
    killer.start()
    assert "died on it (signal 9)" in told(stubborn, b"hang")
    killer.join()
    assert is_served(stubborn)


def test_a_reader_killed_while_idle_costs_nobody_a_mesh(stubborn: Parsers) -> None:
    assert is_served(stubborn)
    (pid,) = stubborn.meshes.pids
    os.kill(pid, signal.SIGKILL)
    while stubborn.meshes.pids:  # until it is reaped
        time.sleep(0.01)
    assert is_served(stubborn)


def test_readers_come_also_where_what_forks_them_was_killed(stubborn: Parsers) -> None:
    assert is_served(stubborn)
    for pid in (stubborn.meshes._nursery._process.pid, *stubborn.meshes.pids):
        os.kill(pid, signal.SIGKILL)
    while stubborn.meshes.pids:
        time.sleep(0.01)
    assert is_served(stubborn)


def test_a_reader_that_is_replaced_leaves_nothing_behind(stubborn: Parsers) -> None:
    assert is_served(stubborn)
    (pid,) = stubborn.meshes.pids
    open_files = len(os.listdir("/proc/self/fd"))
    for _ in range(5):
        told(stubborn, b"crash")
        assert is_served(stubborn)
    assert not Path(f"/proc/{pid}").exists()
    nursery = stubborn.meshes._nursery._process.pid
    assert Path(f"/proc/{nursery}/task/{nursery}/children").read_text().split() == [str(stubborn.meshes.pids[0])]
    assert len(os.listdir("/proc/self/fd")) == open_files
    assert len(os.listdir(f"/proc/{nursery}/fd")) == 4  # its socket, output twice, and this list's own


def test_a_reader_that_lies_is_not_believed(stubborn: Parsers) -> None:
    assert "is not a valid mesh" in told(stubborn, b"lie")
    talkative = Parsers(replace(STUBBORN_MESHES, max_answer_bytes=100_000))
    assert "its answer was too large" in told(talkative, b"talk")
    talkative.stop()


def test_a_reader_has_limits_and_no_secrets(stubborn: Parsers, monkeypatch: pytest.MonkeyPatch) -> None:
    assert told(stubborn, b"limits") == f"{4096 << 20} 0 0 0"
    monkeypatch.setenv("PROBELESS_TOKEN", "secret")
    monkeypatch.setenv("OPENBLAS_CORETYPE", "Haswell")
    fresh = Parsers(STUBBORN_MESHES)
    environment = told(fresh, b"environment")
    fresh.stop()
    assert "PROBELESS_TOKEN" not in environment
    assert "PYTHONPATH" in environment
    assert "OPENBLAS_CORETYPE" in environment  # or its arithmetic has other last bits than the server's


def test_one_that_hangs_keeps_no_other_waiting(stubborn: Parsers) -> None:
    hanging = threading.Thread(target=told, args=(stubborn, b"hang"))
    hanging.start()
    while not stubborn.meshes.pids:
        time.sleep(0.01)
    assert is_served(stubborn)
    for pid in stubborn.meshes.pids:
        os.kill(pid, signal.SIGKILL)
    hanging.join(PATIENCE_S)
    assert not hanging.is_alive()
    while stubborn.meshes.pids:
        time.sleep(0.01)
    assert is_served(stubborn)


def test_stopping_ends_those_at_work_too() -> None:
    parsers = Parsers(STUBBORN_MESHES)
    assert is_served(parsers)
    (pid,) = parsers.meshes.pids
    said: list[str] = []
    hanging = threading.Thread(target=lambda: said.append(told(parsers, b"hang")))
    hanging.start()
    parsers.stop()
    hanging.join(PATIENCE_S)
    assert len(said) == 1
    assert not Path(f"/proc/{pid}").exists()
    assert "the server ends" in told(parsers, b"tiny")


ORPHAN = """
import sys, time
from server.parsing.parsers import Parsers
parsers = Parsers()
parsers.load_mesh(b"v 0 0 0\\nv 1 0 0\\nv 0 1 0\\nf 1 2 3\\n", "obj")
print(parsers.meshes.pids[0], flush=True)
time.sleep(60)
"""


def test_a_killed_servers_children_end() -> None:
    server = subprocess.Popen([sys.executable, "-c", ORPHAN], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    with server:
        child = Path(f"/proc/{server.stdout.readline().strip()}/stat")
        assert child.exists()
        server.kill()
    deadline_s = time.monotonic() + PATIENCE_S
    while _lives(child) and time.monotonic() < deadline_s:
        time.sleep(0.01)
    assert not _lives(child)


def _lives(stat: Path) -> bool:
    try:
        return stat.read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def picture(codec: str) -> tuple[object, CameraModel]:
    camera = msgspec.structs.replace(CAMERA, width=96, height=64)
    smooth = np.mgrid[:64, :96].sum(axis=0).astype(np.uint8)
    return encode_color(np.stack([smooth, smooth // 2, 200 - smooth], axis=2), codec), camera


@pytest.mark.parametrize("codec", ["jpeg", "png", "raw"])
def test_a_picture_is_what_it_would_be_if_read_here(parsers: Parsers, codec: str) -> None:
    image, camera = picture(codec)
    there = parsers.color_reader(camera).decode(image)
    np.testing.assert_array_equal(there, decode_color(image, camera))
    assert there.flags.writeable


def test_a_larger_picture_after_a_smaller_leaves_nothing_of_it(parsers: Parsers) -> None:
    for side in (32, 512, 64):
        camera = msgspec.structs.replace(CAMERA, width=side, height=side, fx=side, fy=side)
        rgb = np.full((side, side, 3), side % 256, np.uint8)
        np.testing.assert_array_equal(parsers.color_reader(camera).decode(encode_color(rgb, "png")), rgb)


def test_damaged_pictures_are_refused_as_they_would_be_here(parsers: Parsers) -> None:
    image, camera = picture("jpeg")
    damaged = msgspec.structs.replace(image, data=image.data[:200] + image.data[-2:])
    wrong = msgspec.structs.replace(image, width=95)
    for bad in (wrong, damaged):
        outcomes = []
        for reader in (ColorReader(camera), parsers.color_reader(camera)):
            try:
                outcomes.append(reader.decode(bad).tobytes())
            except ProtocolError as error:
                outcomes.append(str(error))
        assert outcomes[0] == outcomes[1]


def test_a_mesh_that_kills_its_reader_over_the_socket(start_server: Callable) -> None:
    server = start_server(mesh_loader=None, parsers=Parsers(IMPATIENT))
    wire = Wire(server.url)
    wire.greet()
    for request, data in enumerate((b"crash", b"hang", b"tiny")):
        wire.say(PlaceObject(request=request, object="thing", format="ply", data=data), frame_message(request))
        answer = wire.hear()
        assert isinstance(answer, Acknowledged)
        assert answer.request == request
        expected = ("died on it (signal 11)", "took more than 2 s", None)[request]
        assert (answer.error is None) if expected is None else (expected in answer.error)
        assert wire.hear_until(Composite)[-1].frame == request
    assert rows(server)["probeless_parser_deaths_total", "mesh"] == 2
    wire.hang_up()


def test_a_picture_that_kills_its_reader_over_the_socket(start_server: Callable) -> None:
    server = start_server(mesh_loader=fake_mesh, parsers=Parsers(picture_spec=STUBBORN_PICTURES))
    wire = Wire(server.url)
    wire.greet()
    deadly = encode_color(np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8), "png")
    deadly = msgspec.structs.replace(deadly, data=_with_zeros(deadly.data))
    good = encode_color(rgbd_frame(1).color, "jpeg")
    wire.say(msgspec.structs.replace(frame_message(0), color=deadly))
    answer = wire.hear()
    assert isinstance(answer, Dropped)
    assert answer.reason == "color.data: the picture's reader died on it (signal 11)"
    wire.say(msgspec.structs.replace(frame_message(1), color=good))
    assert wire.hear_until(Composite)[-1].frame == 1
    found = rows(server)
    assert found["probeless_parser_deaths_total", "picture"] == 1
    assert found["probeless_frames_dropped_total", "unreadable"] == 1
    wire.hang_up()


def _with_zeros(png: bytes) -> bytes:
    """The same picture with a run of zeros in a chunk that nobody reads."""
    kind, data = b"sBIT", bytes(128)
    chunk = struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return png[:33] + chunk + png[33:]


def test_a_child_that_cannot_be_started_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with pytest.raises(ChildDied, match="could not be started"):
        ProcessPool(MESH_JOB, 1).ask(b"")

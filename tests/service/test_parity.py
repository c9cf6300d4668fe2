"""The real pipeline behind the socket gives, losslessly, the bits it gives in this process."""

import io
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from client.commands.stream import stream
from client.objects.object_file import ObjectFile, pack_mesh
from client.options.light_places import PanoramaOut
from client.results.description import describe
from client.results.frame_output import FrameOutput, captured_of
from client.results.output_folder import OutputWriter
from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Spot, Wishes
from server.client_session import ClientSession
from server.meshing.files import mesh_files
from server.opencl.device import Device
from server.scene.mesh import load_mesh
from server.scene.placement import requested_placement
from server.service.serve import BackgroundServer
from server.service.service import Service

FRAMES = 3
CAMERA = CameraModel(width=96, height=72, fx=80.0, fy=80.0, cx=47.5, cy=35.5)
PLACE = (0.2, 0.1, 1.0)
WISHES = Wishes(
    volume_m=(-1.0, -1.0, 0.5, 1.0, 1.0, 2.5), voxel_m=0.04, rays=32, up=(0.0, -1.0, 0.0), light_at=(PLACE,)
)
BOX = "v -1 0 -1\nv 1 0 -1\nv 0 0 1\nv 0 2 0\nf 1 2 4\nf 2 3 4\nf 3 1 4\nf 1 3 2\n"


class CornerSource:
    """A camera that slides along a wall with a step in it; the colour is noise, which no lossy codec keeps."""

    name, camera, fps, has_poses, up = "corner", CAMERA, 30.0, True, (0.0, -1.0, 0.0)

    def __len__(self) -> int:
        return FRAMES

    def __getitem__(self, index: int) -> RgbdFrame:
        v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
        depth = np.where(u < 50, 1600, 1400) + v
        pose = np.eye(4)
        pose[:3, 3] = 0.01 * index, 0.003 * index, -0.002
        color = np.random.default_rng(index).integers(0, 256, (CAMERA.height, CAMERA.width, 3), np.uint8)
        return RgbdFrame(index, index / 30, color, depth.astype(np.uint16), pose)


@dataclass(frozen=True)
class Scene:
    """What both ways are given."""

    source: CornerSource
    item: ObjectFile


def run_in_process(device: Device, scene: Scene, folder: Path) -> None:
    """The frames through the pipeline, without a network."""
    pipeline = ClientSession(device, CAMERA, WISHES)
    format_, data = pack_mesh(scene.item.path)
    mesh, item = load_mesh(data, format_), scene.item
    placement = requested_placement(mesh, item.position_m, item.spot, item.scale, item.height_m, item.yaw_deg)
    pipeline.place_object("object-0", mesh, placement)
    with OutputWriter(folder, describe(scene.source, FRAMES, [scene.item])) as writer:
        for frame in (scene.source[i] for i in range(FRAMES)):
            result = {**vars(pipeline.process(frame))}
            assert result.pop("layer") is None  # not wished for
            result.pop("is_reused")  # of the server alone
            result.pop("placed")  # files have it as a note
            result["captured"] = captured_of(frame, CAMERA)
            writer.write(FrameOutput(frame=frame.index, timestamp_s=frame.timestamp_s, **result))
        writer.write_mesh(mesh_files(pipeline.scene_mesh()))
        (folder / "sky.exr").write_bytes(pipeline.panorama("exr", PLACE)[0])
    pipeline.close()


@pytest.fixture(params=["position", "pixel"])
def scene(tmp_path: Path, request: pytest.FixtureRequest) -> Scene:
    (tmp_path / "box.obj").write_text(BOX)
    if request.param == "position":
        return Scene(CornerSource(), ObjectFile(tmp_path / "box.obj", (0.1, 0.2, 1.2), 0.1, 20.0))
    spot = Spot(on="pixel", pixel=(60.0, 60.0), frame=1)
    return Scene(CornerSource(), ObjectFile(tmp_path / "box.obj", None, 1.0, 20.0, spot, height_m=0.1))


def comparable(folder: Path) -> dict[str, bytes]:
    """Every file that must be the same; times never are, nor is the page that shows them."""
    timed = ("timings.jsonl", "index.html")
    paths = [path for path in folder.rglob("*") if path.is_file() and path.name not in timed]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def test_lossless_stream_gives_the_bits_of_an_in_process_run(device: Device, scene: Scene, tmp_path: Path) -> None:
    run_in_process(device, scene, tmp_path / "run")
    with BackgroundServer(Service(device)) as server:
        said = io.StringIO()
        quiet = Console(file=said)
        panorama = PanoramaOut(tmp_path / "stream" / "sky.exr", "exr", PLACE)
        options = {"lossless": True, "mesh": True, "panorama": panorama, "console": quiet}
        stream(scene.source, server.url, [scene.item], WISHES, tmp_path / "stream", **options)
    run, streamed = comparable(tmp_path / "run"), comparable(tmp_path / "stream")
    assert ("object 'object-0' stands at" in said.getvalue()) == (scene.item.spot is not None)
    assert "never in view" not in said.getvalue()
    assert len([name for name in run if name.endswith(".png")]) == FRAMES
    assert run.keys() == streamed.keys() >= {"mesh.ply", "mesh.glb", "sky.exr"}
    assert [name for name in run if run[name] != streamed[name]] == []
    last = json.loads(streamed["light.jsonl"].splitlines()[-1])
    assert [(at["of"], at["index"]) for at in last["at"]] == [("view", 0), ("place", 0), ("object", 0)]

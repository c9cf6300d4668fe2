"""`probeless run`: process a source in this process, without a network."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import takewhile
from types import TracebackType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from client.commands.stopping import stop_on_interrupt
from client.errors import RunError
from client.objects.in_view import ObjectsInView
from client.objects.object_file import object_id, pack_mesh
from client.objects.placing import place_objects
from client.options.capture import Capture
from client.results.bright_parts import split
from client.results.frame_output import FrameOutput, captured_of
from client.results.gltf_scene import PlacedObject, scene_glb
from client.results.names import ENVIRONMENT_NAME, SCENE_NAME
from client.sources.frame_source import is_live
from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import MeshFormat, PanoramaFormat, Vector3, Wishes
from server.client_session import ClientSession
from server.light.panorama_file import decode_hdr, encode_panorama
from server.meshing.files import mesh_files
from server.opencl.device import open_device
from server.pipeline import FrameResult


class Processor(Protocol):
    """The part of ClientSession that `process_frames` uses."""

    def process(self, frame: RgbdFrame) -> FrameResult: ...


class Run:
    """An open pipeline for a capture; a context manager."""

    def __init__(self, capture: Capture, device_name: str | None, note: Callable[[str], None]) -> None:
        """`note` receives notes on objects and frames, each line once. Raises UserError, DeviceError or MeshError, each
        with one line."""
        self._capture = capture
        self._note = note
        self._told: set[str] = set()
        self._path: list[tuple[float, NDArray[np.float64]]] = []
        self._pipeline = _open_pipeline(device_name, capture.source.camera, capture.wishes, note)
        try:
            place_objects(self._pipeline, capture.objects, note)
        except BaseException:
            self._pipeline.close()
            raise

    def outputs(self) -> Iterator[FrameOutput]:
        """One output per frame, in order; a live source ends with Ctrl-C. Raises UserError."""
        source, objects = self._capture.source, self._capture.objects
        in_view = ObjectsInView(source.camera, objects, [object_id(number) for number in range(len(objects))])
        with stop_on_interrupt(is_live(source)) as stopping:
            positions = takewhile(lambda _: not stopping.is_set(), self._capture.frames)
            for output in process_frames(self._pipeline, (source[i] for i in positions), source.camera):
                self._tell(output.notes)
                in_view.note(output.light, output.world_from_camera)
                if output.tracking != "lost":
                    self._path.append((output.timestamp_s, output.world_from_camera))
                yield output
        self._tell(in_view.problems())

    def _tell(self, lines: Iterable[str]) -> None:
        for line in lines:
            if line not in self._told:
                self._told.add(line)
                self._note(line)

    @property
    def device(self) -> str:
        """Name of the OpenCL device."""
        return self._pipeline.device_name

    def mesh(self, progress: Callable[[int, int], None]) -> dict[MeshFormat, bytes]:
        """Mesh files of the surface fused so far; `progress` receives parts done and total. Raises MeshingError."""
        return mesh_files(self._pipeline.scene_mesh(progress))

    def scene(self, progress: Callable[[int, int], None]) -> dict[str, bytes]:
        """scene.glb and scene.hdr of what was seen so far. Raises MeshingError, ObjectError or RunError."""
        scan = self._pipeline.scene_mesh(progress)
        lights, rest = split(decode_hdr(self.panorama("hdr", None)))
        data = scene_glb(scan, self._placed(), lights, self._path, self._capture.source.camera, ENVIRONMENT_NAME)
        return {SCENE_NAME: data, ENVIRONMENT_NAME: encode_panorama(rest, "hdr")}

    def _placed(self) -> list[PlacedObject]:
        """The objects that stand, named by their files."""
        places, found = self._pipeline.object_places(), []
        for number, item in enumerate(self._capture.objects):
            if (place := places.get(object_id(number))) is not None:
                format_, data = pack_mesh(item.path)
                found.append(PlacedObject(f"{number} {item.path.stem}", item.path, format_, data, place))
        return found

    def panorama(self, format_: PanoramaFormat, position_m: Vector3 | None) -> bytes:
        """The light that arrives at a place as a lat-long file; None: see `--panorama-out`. Raises RunError."""
        try:
            return self._pipeline.panorama(format_, position_m)[0]
        except ValueError as error:
            raise RunError(f"--panorama-out: {error}") from error

    def __enter__(self) -> Run:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pipeline.close()


def process_frames(pipeline: Processor, frames: Iterable[RgbdFrame], camera: CameraModel) -> Iterator[FrameOutput]:
    """The output of each frame of this camera. Raises RunError with the number of a frame that the pipeline refuses."""
    for frame in frames:
        try:
            result = pipeline.process(frame)
        except ValueError as error:
            raise RunError(f"frame {frame.index}: {error}") from error
        assert result.color is not None  # `Wishes.answer` is picture
        yield FrameOutput(
            frame=frame.index,
            timestamp_s=frame.timestamp_s,
            color=result.color,
            light=result.light,
            world_from_camera=result.world_from_camera,
            tracking=result.tracking,
            timings=result.timings,
            plan=result.plan,
            notes=result.notes,
            captured=captured_of(frame, camera),
        )


def _open_pipeline(
    device_name: str | None, camera: CameraModel, wishes: Wishes, note: Callable[[str], None]
) -> ClientSession:
    device = open_device(device_name)
    from client.tuning.tune import note_of_front

    try:
        if wishes.preset == "auto" and (said := note_of_front(device)):
            note(said)
        return ClientSession(device, camera, wishes)
    except ValueError as error:
        raise RunError(str(error)) from error

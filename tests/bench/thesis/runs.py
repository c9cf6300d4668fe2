"""What the thesis's tables and figures are made from: presets turn by turn on the same frames, one virtual thing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from client.sources.volume import default_volume, default_voxel
from client.synthetic.export import guest_ply
from client.synthetic.source import SyntheticSource, open_synthetic
from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import TIMING_ROWS, Wishes
from server.client_session import ClientSession
from server.opencl.device import Device
from server.pipeline import FrameResult
from server.scene.mesh import Mesh, load_mesh
from server.scene.placement import Placement
from server.scene.vase import vase_glb
from tests.bench.report.finished import ROOT
from tests.bench.report.processor import ProcessorTime
from tests.bench.thesis.numbers import ROWS

OUT = ROOT / "out" / "bench" / "accuracy"
PICTURES = "pictures"
"""Folder of what figures are made from, in OUT."""
WARM_UP = 2
"""Frames whose times do not count: kernels are compiled, memory is taken."""

Codes = NDArray[np.uint8]
Thing = tuple[Mesh, Placement]
Times = dict[str, list[float]]
"""Milliseconds of each frame by the names of thesis_numbers.ROWS, and `cpu`: of processor time, over the cores."""


@dataclass(frozen=True)
class Answer:
    """What a preset made of one frame."""

    result: FrameResult
    cpu_ms: float
    """Processor time over the device's cores: what the frame takes at the least where nothing else runs."""


def turn_by_turn(
    device: Device,
    camera: CameraModel,
    frames: Iterable[RgbdFrame],
    wishes: Mapping[str, Wishes],
    things: Sequence[Thing] = (),
) -> Iterator[tuple[RgbdFrame, dict[str, Answer]]]:
    """Each frame to every pipeline before the next one is, so that what else the machine does meets all alike."""
    pipelines: dict[str, ClientSession] = {}
    try:
        for name, asked in wishes.items():
            pipelines[name] = ClientSession(device, camera, asked)
            for number, (mesh, placement) in enumerate(things):
                pipelines[name].place_object(f"thing-{number}", mesh, placement)
        order = list(pipelines)
        for frame in frames:
            yield frame, {name: _answer(device, pipelines[name], frame) for name in order}
            order = order[1:] + order[:1]
    finally:
        for pipeline in pipelines.values():
            pipeline.close()


def _answer(device: Device, pipeline: ClientSession, frame: RgbdFrame) -> Answer:
    spent = ProcessorTime()
    result = pipeline.process(frame)
    return Answer(result, spent.ms() / cores_of(device))


def cores_of(device: Device) -> int:
    """Of a processor that runs kernels; 1 for a GPU, whose host part is serial."""
    return 1 if device.is_gpu else int(device.cl_device.max_compute_units)


def no_times() -> Times:
    """Nothing timed yet."""
    return {name: [] for name in (*list(ROWS)[1:], "cpu")}


def note_times(times: Times, answer: Answer) -> None:
    """Add a frame's."""
    for name in (*TIMING_ROWS, "total"):
        times[name].append(getattr(answer.result.timings, name))
    times["cpu"].append(answer.cpu_ms)


def medians(times: Times) -> dict[str, float]:
    """Of the frames after the warm-up, and `fps`."""
    found = {name: median(values[WARM_UP:] or values) for name, values in times.items()}
    return {"fps": 1e3 / found["total"], **found}


@cache
def vase() -> Mesh:
    """The virtual thing: 15 000 triangles, curved, with a rim and an inside."""
    return load_mesh(vase_glb(), "glb")


def guests_of(source: SyntheticSource) -> list[Thing]:
    """The guests of a stage set as virtual things, where they stand in the true picture."""
    return [(load_mesh(guest_ply(guest), "ply"), Placement(position_m=None)) for guest in source.guests]


def scene(spec: str, *, is_still: bool = False) -> SyntheticSource:
    """A synthetic scene; `is_still`: the camera stays where it starts."""
    source = open_synthetic(spec)
    if is_still:
        path = source.scene.camera_path
        source.scene = replace(source.scene, camera_path=lambda _time_s: path(0.0))
    return source


def usual_wishes(source: SyntheticSource, **others: Any) -> Wishes:
    """Those of a scene whose light comes straight: the volume fits it, albedos are estimated."""
    volume_m = default_volume(source, range(len(source)))
    usual: dict[str, Any] = {"albedo": "estimated", "indirect": "none", "voxel_m": default_voxel(volume_m)}
    return Wishes(volume_m=volume_m, up=source.up, **(usual | others))


def save_picture(name: str, codes: NDArray[np.uint8]) -> str:
    """Keep RGB or grey codes as PNG; returns where, relative to OUT. Raises OSError."""
    path = Path(PICTURES) / f"{name.replace(' ', '_')}.png"
    (OUT / path).parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(OUT / path), codes[..., ::-1] if codes.ndim == 3 else codes):
        raise OSError(f"{OUT / path} cannot be written")
    return path.as_posix()


def load_picture(folder: Path, name: str) -> Codes:
    """What `save_picture` kept, RGB or grey, in `folder`, or in OUT if that is another. Raises OSError."""
    path = folder / name if (folder / name).is_file() else OUT / name
    read = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if read is None:
        raise OSError(f"{path} cannot be read")
    return np.ascontiguousarray(read[..., ::-1] if read.ndim == 3 else read)

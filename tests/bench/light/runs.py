"""The pipeline on a source from beginning to end, as a black box."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from client.objects.object_file import ObjectFile
from client.objects.placing import place_objects
from client.sources.frame_source import Source
from client.sources.volume import default_volume, default_voxel
from protocol.frames import RgbdFrame
from protocol.messages import Preset, Wishes
from server.client_session import ClientSession
from server.opencl.device import Device
from server.pipeline import FrameResult
from server.quality.settings import read_wishes
from tests.scenes.plain_light import PLAIN_LIGHT

PRESETS = ("rm", "reg4", "reg8", "art1", "art4", "art8", "gr15", "gr15fast")
REFERENCE: Preset = "rm"


@dataclass(frozen=True)
class Exposed:
    """A linear16 source whose pictures are taken with a shorter exposure; see client.sources.frame_source.Source."""

    source: Source
    factor: float

    def __getitem__(self, index: int) -> RgbdFrame:
        frame = self.source[index]
        return replace(frame, color=np.rint(frame.color * self.factor).astype(frame.color.dtype))

    def __len__(self) -> int:
        return len(self.source)


def wishes_for(source: Source, frames: range) -> Wishes:
    """As `probeless run`, but of one albedo, without indirect light."""
    volume_m = default_volume(source, frames)
    return Wishes(preset=REFERENCE, volume_m=volume_m, voxel_m=default_voxel(volume_m), up=source.up, **PLAIN_LIGHT)


def at_preset(wishes: Wishes, preset: str) -> Wishes:
    """`wishes` at another preset."""
    return msgspec.structs.replace(wishes, preset=preset)


def refusal(wishes: Wishes) -> str:
    """Why this server cannot fulfil `wishes`; empty where it can."""
    try:
        read_wishes(wishes)
    except ValueError as error:
        return str(error)
    return ""


def results_of(
    device: Device, source: Source, frames: Iterable[RgbdFrame], wishes: Wishes, objects: Iterable[Path] = ()
) -> list[FrameResult]:
    """Every frame's result; `objects` are in world coordinates. Raises ValueError for wishes it cannot fulfil."""
    pipeline = ClientSession(device, source.camera, wishes)
    place_objects(pipeline, tuple(ObjectFile(path, None) for path in objects), lambda _text: None)
    found = [pipeline.process(frame) for frame in frames]
    pipeline.close()
    return found


def light_in(result: FrameResult) -> NDArray[np.float64]:
    """[bands^2, 3] of a result."""
    return np.array(result.light.sh_all or result.light.sh, np.float64)

"""A session of a synthetic source, frame by frame, with composites or with layers as its answer."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from client.gallery.source import GallerySource
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.opencl.device import Device
from server.pipeline import FrameResult
from server.scene.mesh import load_mesh
from server.scene.placement import Placement


def played(
    device: Device, source: GallerySource, wishes: Wishes, frames: int, watched: Sequence[int] = ()
) -> list[FrameResult]:
    """Results of the first frames; the objects stay at their first positions. watched: frames with a watcher."""
    pipeline = ClientSession(device, source.camera, wishes)
    try:
        for number, item in enumerate(source.scene.objects):
            mesh = load_mesh(item.glb(), "glb")
            pipeline.place_object(f"object-{number}", mesh, Placement(position_m=item.position(0)))
        return [pipeline.process(source[index], watched=index in watched) for index in range(frames)]
    finally:
        pipeline.close()


def answered(wishes: Wishes, answer: str) -> Wishes:
    return msgspec.structs.replace(wishes, answer=answer)

"""Runs a gallery scene through the pipeline, with its objects placed and moved."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

from msgspec import structs

from client.gallery.source import GallerySource
from client.sources.volume import default_volume
from protocol.messages import Wishes
from server.client_session import ClientSession
from server.opencl.device import Device
from server.pipeline import FrameResult
from server.scene.mesh import load_mesh
from server.scene.placement import Placement

VOXEL_M = 0.02


def wishes_of(source: GallerySource, **changes: Any) -> Wishes:
    """Wishes of a session that shows this scene, with `changes` to single fields."""
    wishes = Wishes(
        volume_m=default_volume(source, range(len(source))),
        voxel_m=VOXEL_M,
        up=source.up,
        light=source.light,
        lamps="off",
        poses=source.scene.poses,
        tone_mapping=source.scene.tone_mapping,
    )
    return structs.replace(wishes, **changes)


def play(device: Device, source: GallerySource, wishes: Wishes) -> Generator[tuple[ClientSession, FrameResult]]:
    """The session and the result of every frame; the session is closed after the last."""
    pipeline = ClientSession(device, source.camera, wishes)
    try:
        for number, item in enumerate(source.scene.objects):
            mesh = load_mesh(item.glb(), "glb")
            pipeline.place_object(f"object-{number}", mesh, Placement(position_m=item.position(0)))
        for index in range(len(source)):
            for number, item in enumerate(source.scene.objects):
                if index and item.position(index) != item.position(index - 1):
                    pipeline.move_object(f"object-{number}", Placement(position_m=item.position(index)))
            yield pipeline, pipeline.process(source[index])
    finally:
        pipeline.close()

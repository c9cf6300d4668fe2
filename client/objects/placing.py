"""Placing of the objects of `--object` in a pipeline of this process."""

from __future__ import annotations

from collections.abc import Callable

from client.errors import RunError
from client.objects.object_file import ObjectFile, object_id, pack_mesh
from server.client_session import ClientSession
from server.scene.mesh import load_mesh
from server.scene.placement import requested_placement


def place_objects(pipeline: ClientSession, objects: tuple[ObjectFile, ...], note: Callable[[str], None]) -> None:
    """Place all objects, named by `object_id`. Raises ObjectError, MeshError or RunError."""
    for number, item in enumerate(objects):
        format_, data = pack_mesh(item.path)
        mesh = load_mesh(data, format_)
        try:
            placement = requested_placement(mesh, item.position_m, item.spot, item.scale, item.height_m, item.yaw_deg)
            notes = pipeline.place_object(object_id(number), mesh, placement)
        except ValueError as error:
            raise RunError(f"{item.path}: {error}") from error
        for text in notes:
            note(f"{item.path.name}: {text}")

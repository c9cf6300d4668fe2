"""Placing of the objects of `--object` in a pipeline of this process."""

from __future__ import annotations

from collections.abc import Callable

from client.errors import RunError
from client.objects.object_file import ObjectFile, pack_mesh
from server.client_session import ClientSession
from server.scene.mesh import load_mesh
from server.scene.placement import Placement


def place_objects(pipeline: ClientSession, objects: tuple[ObjectFile, ...], note: Callable[[str], None]) -> None:
    """Place all objects, named by `object_id`. Raises ObjectError, MeshError or RunError."""
    for number, item in enumerate(objects):
        format_, data = pack_mesh(item.path)
        placement = Placement(position_m=item.position_m, scale=item.scale, yaw_deg=item.yaw_deg)
        try:
            notes = pipeline.place_object(object_id(number), load_mesh(data, format_), placement)
        except ValueError as error:
            raise RunError(f"{item.path}: {error}") from error
        for text in notes:
            note(f"{item.path.name}: {text}")


def object_id(number: int) -> str:
    """Name of the n-th `--object` in the session; the same in `run` and `stream`."""
    return f"object-{number}"

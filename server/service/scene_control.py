"""Does what a client asks for its scene, its objects and its quality, and says how that went."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from protocol.codec import one_line
from protocol.messages import Acknowledged, MoveObject, PlaceObject, Quality, RemoveObject
from server.scene.mesh import Mesh
from server.scene.placement import Placement, requested_placement
from server.service.mailbox import ObjectRequest

if TYPE_CHECKING:
    from server.client_session import ClientSession

SceneControl = ObjectRequest | Quality


def apply_control(
    pipeline: ClientSession, message: SceneControl, load_mesh: Callable[[bytes, str], Mesh]
) -> Acknowledged:
    """Apply a control message. An error is reported in the acknowledgement."""
    try:
        notes = _apply(pipeline, message, load_mesh)
    except ValueError as error:  # MeshError is one
        return Acknowledged(request=message.request, error=one_line(str(error)))
    return Acknowledged(request=message.request, notes=tuple(one_line(note) for note in notes))


def _apply(pipeline: ClientSession, message: SceneControl, load_mesh: Callable[[bytes, str], Mesh]) -> tuple[str, ...]:
    match message:
        case PlaceObject():
            mesh = load_mesh(message.data, message.format)
            place, size = (message.position_m, message.spot), (message.scale, message.height_m)
            return pipeline.place_object(
                message.object, mesh, requested_placement(mesh, *place, *size, message.yaw_deg)
            )
        case MoveObject():
            with _object_known(message.object):
                pipeline.move_object(message.object, Placement(message.position_m, message.scale, message.yaw_deg))
        case RemoveObject():
            with _object_known(message.object):
                pipeline.remove_object(message.object)
        case Quality():
            pipeline.set_quality(message.preset, message.budget_ms, message.max_light_error_deg)
    return ()


@contextlib.contextmanager
def _object_known(name: str) -> Iterator[None]:
    try:
        yield
    except KeyError as error:
        raise ValueError(f"there is no object {name!r} in this session: place it first") from error

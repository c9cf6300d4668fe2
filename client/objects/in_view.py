"""Tells which objects of `--object` were placed nowhere, or where no camera looked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from client.objects.object_file import ObjectFile
from protocol.frames import CameraModel
from protocol.messages import Light
from server.maths.rigid import inverse_rigid

TOLD_OBJECTS = 64
"""A light has entries of so many objects at most (protocol/README.md)."""


class ObjectsInView:
    """Follows the objects over the frames of one client, by the middles of their boxes."""

    def __init__(self, camera: CameraModel, objects: Sequence[ObjectFile], names: Sequence[str]) -> None:
        """`names`: of the objects in the session."""
        self._camera = camera
        self._files = dict(zip(names, objects, strict=True))
        self._places: dict[str, NDArray[np.float64]] = {}
        self._seen: set[str] = set()
        self._is_complete = False
        """Whether the last light told of all objects."""

    def note(self, light: Light, world_from_camera: NDArray[np.float64]) -> None:
        """Note one frame by its answer, of which `light.at` has the objects' places. world_from_camera: [4, 4]."""
        self._is_complete = sum(lit.of == "object" for lit in light.at) < TOLD_OBJECTS
        camera_from_world = inverse_rigid(world_from_camera)
        for lit in light.at:
            if lit.object in self._files:
                self._places[lit.object] = np.array(lit.position)
                x, y, z = camera_from_world[:3, :3] @ lit.position + camera_from_world[:3, 3]
                if z > 0 and self._is_in_picture(x / z, y / z):
                    self._seen.add(lit.object)

    def problems(self) -> list[str]:
        """One line for each object that was not placed, or never in view."""
        lines = []
        for name, item in self._files.items():
            place = self._places.get(name)
            if place is None and self._is_complete:
                lines.append(f"{item.path.name} was not placed: no frame shows its spot; give another")
            elif place is not None and name not in self._seen:
                where = ",".join(f"{value:.2f}" for value in place)
                lines.append(
                    f"{item.path.name} was never in view: its middle is at {where}; place it where a camera looks, "
                    "for example with @auto or @pixel:U,V"
                )
        return lines

    def _is_in_picture(self, x: float, y: float) -> bool:
        """x, y: on the plane one metre in front of the camera."""
        camera = self._camera
        u, v = camera.fx * x + camera.cx, camera.fy * y + camera.cy
        return -0.5 <= u < camera.width - 0.5 and -0.5 <= v < camera.height - 0.5

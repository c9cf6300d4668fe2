"""What is said of objects that were placed nowhere, or where no camera looked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from msgspec import structs

from client.objects.in_view import TOLD_OBJECTS, ObjectsInView
from client.objects.object_file import ObjectFile
from protocol.frames import CameraModel
from protocol.messages import ArrivingLight, Light
from tests.client.lights import light_of
from tests.protocol.samples import SERVER
from tests.scenes.analytic import look_at

CAMERA = CameraModel(width=64, height=48, fx=50.0, fy=50.0, cx=31.5, cy=23.5)
DUCK, SOFA = ObjectFile(Path("duck.glb"), None), ObjectFile(Path("sofa.glb"), None)


def light_with(**places: tuple[float, float, float]) -> Light:
    """A light that arrives at objects, by name."""
    sample = SERVER["light_at_places"]
    assert isinstance(sample, Light)
    at: ArrivingLight = sample.at[0]
    told = tuple(
        structs.replace(at, of="object", index=index, object=name, position=place)
        for index, (name, place) in enumerate(places.items())
    )
    return structs.replace(light_of(0), at=told)


def test_an_object_that_a_later_frame_shows_is_fine() -> None:
    seen = ObjectsInView(CAMERA, [DUCK], ["object-0"])
    light = light_with(**{"object-0": (0.0, 0.0, 2.0)})
    seen.note(light, look_at((0, 0, 0), (0, 0, -1)))
    assert "duck.glb was never in view: its middle is at 0.00,0.00,2.00" in seen.problems()[0]
    seen.note(light, look_at((0, 0, 0), (0, 0, 1)))
    seen.note(light, look_at((0, 0, 0), (0, 0, -1)))
    assert seen.problems() == []


def test_the_picture_ends_at_its_edge() -> None:
    for x_m, lines in ((0.63, 0), (0.65, 1)):  # u = 31.5 + 50 x at 1 m; the picture ends at 63.5
        seen = ObjectsInView(CAMERA, [DUCK], ["object-0"])
        seen.note(light_with(**{"object-0": (x_m, 0.0, 1.0)}), np.eye(4))
        assert len(seen.problems()) == lines


def test_one_that_was_not_placed_is_told() -> None:
    seen = ObjectsInView(CAMERA, [DUCK, SOFA], ["object-0", "object-1"])
    assert seen.problems() == []  # no frame has come
    seen.note(light_with(**{"object-0": (0.0, 0.0, 1.0), "another client's": (0.0, 0.0, -1.0)}), np.eye(4))
    assert seen.problems() == ["sofa.glb was not placed: no frame shows its spot; give another"]


def test_beyond_the_objects_that_a_light_tells_nothing_is_said() -> None:
    seen = ObjectsInView(CAMERA, [DUCK], ["mine"])
    seen.note(light_with(**{f"{number}": (0.0, 0.0, 1.0) for number in range(TOLD_OBJECTS)}), np.eye(4))
    assert seen.problems() == []

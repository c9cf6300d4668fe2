"""Layers and lights without pictures, through the whole spine: what is in them, and that the light is the same."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from client.gallery.play import wishes_of
from client.gallery.source import GallerySource
from protocol.codec import encode
from server.client_session import ClientSession
from server.effects.table import effect_names
from server.opencl.device import Device
from server.pipeline import FrameResult
from server.shading.layer import NEUTRAL, NOTHING
from tests.scenes.played_layers import answered, played

ENDS = {"composite", "compose_layer"}


def lights(results: list[FrameResult]) -> list[bytes]:
    return [encode(result.light) for result in results]


@pytest.mark.parametrize("name", ["shadow-falls-in", "still", "hand"])
def test_lights_are_the_same_however_frames_are_answered(device: Device, name: str) -> None:
    """Byte for byte, found from the pictures; of a view that rests, and of one that is watched now and then, too."""
    source = GallerySource(name, width=80)
    wishes, frames = wishes_of(source, light=None), min(len(source), 12)
    of_pictures = played(device, source, wishes, frames)
    of_layers = played(device, source, answered(wishes, "layer"), frames, watched=(2, 3, 9))
    of_lights = played(device, source, answered(wishes, "light"), frames)
    of_watched = played(device, source, answered(wishes, "light"), frames, watched=(1, 2, 9, 10))
    assert lights(of_pictures) == lights(of_layers) == lights(of_lights) == lights(of_watched)
    assert len(set(lights(of_pictures))) > frames // 3


def test_a_light_is_found_without_drawing(device: Device) -> None:
    source = GallerySource("sharp-sun", width=80)
    # What a frame leaves to the next depends on its answer: its caches, and what surfaces send in the mean.
    wishes = msgspec.structs.replace(wishes_of(source), cache="off")
    first, _, watched = played(device, source, answered(wishes, "light"), 3, watched=(1, 2))
    assert first.color is None
    assert first.layer is None
    assert first.plan.run == ()
    reasons = {left.effect: left.reason for left in first.plan.left_out}
    assert {*effect_names("picture")} <= reasons.keys()
    assert "draws by itself" in reasons["composite"]
    assert first.timings.launches < 0.75 * watched.timings.launches
    assert watched.color is not None
    assert watched.layer is None
    assert watched.plan.run[-1] == "composite"
    drawn = played(device, source, wishes, 3)[2].color
    np.testing.assert_array_equal(watched.color, drawn)


def test_a_layer_is_made_by_the_same_effects_as_a_picture(device: Device) -> None:
    source = GallerySource("glossy", width=80)
    pictures = played(device, source, wishes_of(source), 2)
    layers = played(device, source, answered(wishes_of(source), "layer"), 2, watched=(1,))
    for picture, layer in zip(pictures, layers, strict=True):
        assert set(picture.plan.run) - ENDS == set(layer.plan.run) - ENDS
        assert picture.plan.left_out == layer.plan.left_out
        assert picture.layer is None
        assert layer.layer is not None
    assert layers[0].color is None
    assert layers[0].plan.run[-1] == "compose_layer"
    assert layers[1].plan.run[-2:] == ("compose_layer", "composite")
    np.testing.assert_array_equal(layers[1].color, pictures[1].color)


def test_of_nothing_virtual_there_is_a_layer_of_nothing(device: Device) -> None:
    source = GallerySource("nothing", width=80)
    (result,) = played(device, source, answered(wishes_of(source), "layer"), 1)
    assert result.layer is NOTHING
    assert result.plan.run == ("compose_layer",)


def test_a_lost_camera_has_a_layer_of_nothing(device: Device) -> None:
    source = GallerySource("shadow-falls-in", width=80)
    wishes = msgspec.structs.replace(answered(wishes_of(source), "layer"), poses="track")
    pipeline = ClientSession(device, source.camera, wishes)
    first = pipeline.process(source[0])
    blind = replace(source[1], depth=np.zeros_like(source[1].depth), color=np.zeros_like(source[1].color))
    lost, watched = (pipeline.process(replace(blind, index=i), watched=i == 2) for i in (1, 2))
    pipeline.close()
    assert first.tracking != "lost"
    assert lost.tracking == watched.tracking == "lost"
    assert lost.layer == watched.layer == NOTHING
    assert lost.color is None
    np.testing.assert_array_equal(watched.color, blind.color)
    assert {left.effect for left in lost.plan.left_out} == {*effect_names("layer")}


def test_a_view_that_rests_keeps_its_layer(device: Device) -> None:
    """Held effects are put together again: to the same codes, as nothing differs from frame to frame."""
    source = GallerySource("still", width=80)
    results = played(device, source, answered(wishes_of(source), "layer"), 14, watched=(13,))
    assert results[-1].plan.run == ("compose_layer", "composite")
    assert results[-2].plan.run == ("compose_layer",)
    assert any(left.effect == "rasterize" and "changed" in left.reason for left in results[-2].plan.left_out)
    pictures = played(device, source, wishes_of(source), 14)
    np.testing.assert_array_equal(results[-1].color, pictures[-1].color)
    held, turns_before = results[-1].layer, results[-5].layer
    for part, other in ((held.virtual, turns_before.virtual), (held.ratio, turns_before.ratio)):
        assert (part.x, part.y) == (other.x, other.y)
        np.testing.assert_array_equal(part.color, other.color)
        np.testing.assert_array_equal(part.depth, other.depth)


def test_parts_have_a_depth_wherever_they_say_something(device: Device) -> None:
    source = GallerySource("sharp-sun")
    (result,) = played(device, source, answered(wishes_of(source), "layer"), 1)
    virtual, ratio = result.layer.virtual, result.layer.ratio
    np.testing.assert_array_equal(virtual.depth > 0, virtual.color[..., 3] > 0)
    assert (ratio.depth[(ratio.color != NEUTRAL).any(-1)] > 0).all()
    assert ratio.color.min() < 90  # the sun's shadow

"""`probeless bench plan`: its scenes run what they call for, its bounds hold, and it sees it where they do not."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from msgspec import structs

from client.gallery.objects import GalleryObject
from client.gallery.play import play, wishes_of
from client.gallery.scenes import CHANGE_FRAME, GALLERY
from client.gallery.source import GallerySource
from protocol.frames import RgbdFrame
from protocol.messages import LeftOut, Plan
from server.client_session import ClientSession
from server.culling import facts_finder
from server.culling.influence_bound import NOWHERE
from server.culling.rules import ELSEWHERE, faint_pixel_share, faint_sample_share
from server.effects import renderer
from server.effects.resources import FaintShadows
from server.effects.table import EFFECTS, FAINT_SHADOWS
from server.opencl.device import Device
from server.reuse.temporal_reuse import NOISY
from server.scene.mesh import load_mesh
from server.scene.placement import Placement
from server.transfer.kept_bounds import kept_left_out
from tests.bench.plan.suite import (
    Played,
    changed_share,
    greatest,
    holds,
    is_as_known,
    is_at_rest,
    kept_bounds_hold,
    stated_bound,
)

QUICK = (
    "elsewhere",
    "shadow-falls-in",
    "far-away",
    "long-shadow",
    "floating",
    "soft-sky",
    "dark-floor",
    "black-room",
    "soot",
    "comes-in",
    "still",
    "still-and-empty",
)


class Cut(GallerySource):
    """Some frames of a scene."""

    def __init__(self, name: str, *parts: range) -> None:
        super().__init__(name)
        self.indices = [index for part in parts for index in part]

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, index: int) -> RgbdFrame:
        return super().__getitem__(self.indices[index])


def differences(
    device: Device, name: str, frames: int = 14, source: GallerySource | None = None
) -> list[tuple[float, int, bool]]:
    """Of each frame: what is stated, what is found, and whether the plan is the known one."""
    source = source or GallerySource(name)
    wishes = wishes_of(
        source, cache="off"
    )  # what caches change is measured apart (tests/pipeline/test_transfer_cache.py)
    planned, full = (play(device, source, structs.replace(wishes, plan=plan)) for plan in ("needed", "everything"))
    found = []
    for index, (_, a), (_, b) in zip(range(frames), planned, full, strict=False):
        most = greatest(a.plan, np.abs(a.color.astype(int) - b.color))
        found.append((stated_bound(a.plan, b.plan), most, is_as_known(source, index, a.plan)))
    planned.close()
    full.close()
    return found


@pytest.mark.parametrize("name", QUICK)
def test_scenes_run_what_they_call_for_and_no_more_is_seen(device: Device, name: str) -> None:
    for bound, most, is_known in differences(device, name):
        assert is_known
        assert bound <= 1.0
        assert holds(bound, most)


def test_a_noisy_view_rests_until_something_happens(device: Device) -> None:
    """Everything is left out until a hand is there, and in that very frame nothing."""
    before, hand = range(20), range(CHANGE_FRAME + 2, CHANGE_FRAME + 4)
    source = Cut("hand-enters-while-still", before, hand)
    rests = []
    for _, result in play(device, source, wishes_of(source)):
        rests.append(is_at_rest(result.plan))
    assert not any(rests[:NOISY])
    assert rests[NOISY:] == [True] * 4 + [False] * 2


def test_what_noise_changes_is_bounded(device: Device) -> None:
    """While it settles, and at rest."""
    for bound, most, is_known in differences(device, "still-noisy", frames=NOISY + 6):
        assert is_known
        assert holds(bound, most)


def test_what_is_placed_and_moved_before_a_resting_view_is_drawn(device: Device) -> None:
    """As it would be with everything simulated; a byte may differ by the rounding of sums."""
    source, pipelines = GallerySource("still-and-empty"), []
    ball = load_mesh(GalleryObject(0.2, (0.0, 0.0, 0.0)).glb(), "glb")
    for plan in ("needed", "everything"):
        pipeline = ClientSession(device, source.camera, wishes_of(source, plan=plan))
        results = []
        for index in range(28):
            if index == 10:
                pipeline.place_object("ball", ball, Placement(position_m=(0.0, 0.0, 0.0)))
            if index in (23, 24):
                pipeline.move_object("ball", Placement(position_m=(0.04 * (index - 22), 0.0, 0.1)))
            if index == 26:
                pipeline.remove_object("ball")
            results.append(pipeline.process(source[index]))
        pipelines.append(results)
        pipeline.close()
    run = [len(result.plan.run) for result in pipelines[0]]
    assert all(count > 1 for count in run[10:22])
    assert run[22] == run[25 + 1] == 1
    assert all(count > 1 for count in run[23:26])
    for needed, everything in zip(*pipelines, strict=True):
        assert np.abs(needed.color.astype(int) - everything.color).max() <= 1
    moves = [not is_at_rest(result.plan) for result in pipelines[0]]
    assert [i for i, was in enumerate(moves) if was] == [*range(8), *range(10, 18), 26, 27]


def test_a_bound_that_is_wrong_is_seen(device: Device) -> None:
    """Where shadows are taken to reach nothing, they are missing."""
    with patch.object(facts_finder, "bound_influence", lambda *_: NOWHERE):
        found = differences(device, "soft-sky", frames=1)
    assert not holds(*found[0][:2])
    assert not found[0][2]


def test_parts_of_the_picture_that_are_too_small_are_seen(device: Device) -> None:
    """Where shadows ten times as strong as is said are left out, it shows beside a shadow."""
    too_much = FaintShadows(10 * faint_pixel_share(), 10 * faint_sample_share())
    table = replace(EFFECTS, approximations=(replace(FAINT_SHADOWS, coarse=too_much),))
    with patch.object(renderer, "EFFECTS", table):
        found = differences(device, "soft-sky", frames=1)
    assert found[0][0] == ELSEWHERE
    assert not holds(*found[0][:2])


def test_the_plan_says_how_much_of_the_picture_changes() -> None:
    plans = [
        Plan(run=(), left_out=(LeftOut(effect="a", reason=reason, error_bound=0.5),))
        for reason in ("virtual things change 12 % of the picture, and hardly the rest", "the light is soft")
    ]
    assert [changed_share(plan) for plan in plans] == [0.12, 0.0]
    far = GallerySource("far-away")
    known = tuple(far.scene.expected_effects(0))
    assert is_as_known(far, 0, Plan(run=known, left_out=plans[0].left_out))
    much = structs.replace(
        plans[0].left_out[0], reason="virtual things change 50 % of the picture, and hardly the rest"
    )
    assert not is_as_known(far, 0, Plan(run=known, left_out=(much,)))


def test_bounds_are_those_of_what_the_other_ran() -> None:
    one = LeftOut(effect="a", reason="far", error_bound=0.25)
    same = LeftOut(effect="b", reason="far", error_bound=0.25)
    other = LeftOut(effect="c", reason="dark", error_bound=0.5)
    asked = LeftOut(effect="d", reason="asked for", error_bound=255.0)
    plan = Plan(run=(), left_out=(one, same, other, asked))
    assert stated_bound(plan, Plan(run=("a", "b", "c"), left_out=(asked,))) == 0.75
    assert stated_bound(plan, plan) == 0.0


def test_bounds_of_what_is_kept_leave_out_a_thousandth_of_the_pixels() -> None:
    """Frames without anything kept do not count, nor do those whose bounds are not known."""
    grey = np.full((20, 100, 3), 90, np.uint8)

    def frame(codes: int, pixels: int, *bounds: float | None) -> Played:
        color = grey.copy()
        color.reshape(-1, 3)[:pixels, 1] += np.uint8(codes)
        left_out = tuple(kept_left_out(f"kept_{i}", "kept", bound) for i, bound in enumerate(bounds))
        asked = LeftOut(effect="bounce", reason="asked for", error_bound=255.0)
        return Played(color, Plan(run=(), left_out=(*left_out, asked)), 1.0, 1.0)

    cached = [
        frame(9, 2000),
        frame(9, 2000, 4.0, None),
        frame(9, 1, 4.0, 1.0),
        frame(9, 3, 4.0, 1.0),
        frame(5, 2000, 4.0, 1.0),
        frame(6, 2000, 4.0, 1.0),
        frame(1, 3, 0.0),
    ]
    assert kept_bounds_hold(cached, [frame(0, 0)] * len(cached)) == [None, True, False, True, False, False]


def test_rounding_may_add_less_than_one() -> None:
    assert holds(0.0, 0)
    assert not holds(0.0, 1)
    assert holds(0.3, 1)
    assert not holds(0.9, 2)


def test_sources_of_the_gallery_are_what_they_say() -> None:
    for name in GALLERY:
        source = GallerySource(name)
        frame = source[-1]
        assert frame.index == len(source) - 1
        assert (frame.depth > 0).mean() > 0.3, name
        assert frame.color.any() == bool(source.scene.sh.any()), name

"""`probeless bench plan`: its scenes run what they call for, its bounds hold, and it sees it where they do not."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest

from client.laptop.gallery.play import play, wishes_of
from client.laptop.gallery.scenes import GALLERY
from client.laptop.gallery.source import GallerySource
from protocol.messages import LeftOut, Plan
from server import facts_finder
from server.opencl.device import Device
from server.stages.reach import NOWHERE
from tests.bench.plan import holds, is_as_known, stated_bound

QUICK = (
    "elsewhere",
    "shadow-falls-in",
    "floating",
    "soft-sky",
    "dark-floor",
    "black-room",
    "soot",
    "comes-in",
    "still-and-empty",
)


def differences(device: Device, name: str, frames: int = 12) -> list[tuple[float, int, bool]]:
    """Of each frame: what is stated, what is found, and whether the plan is the known one."""
    source = GallerySource(name)
    planned, full = (play(device, source, wishes_of(source, plan=plan)) for plan in ("needed", "everything"))
    found = []
    for index, (_, a), (_, b) in zip(range(frames), planned, full, strict=False):
        most = int(np.abs(a.color.astype(int) - b.color).max())
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


def test_a_bound_that_is_wrong_is_seen(device: Device) -> None:
    """Where shadows are taken to reach nothing, they are missing."""
    with patch.object(facts_finder, "measure_reach", lambda *_: NOWHERE):
        found = differences(device, "soft-sky", frames=1)
    assert not holds(*found[0][:2])
    assert not found[0][2]


def test_bounds_are_those_of_what_the_other_ran() -> None:
    one = LeftOut(effect="a", reason="far", error_bound=0.25)
    same = LeftOut(effect="b", reason="far", error_bound=0.25)
    other = LeftOut(effect="c", reason="dark", error_bound=0.5)
    asked = LeftOut(effect="d", reason="asked for", error_bound=255.0)
    plan = Plan(run=(), left_out=(one, same, other, asked))
    assert stated_bound(plan, Plan(run=("a", "b", "c"), left_out=(asked,))) == 0.75
    assert stated_bound(plan, plan) == 0.0


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

"""How far off what is kept may be: measured where it is found anew."""

from __future__ import annotations

import numpy as np
import pytest

from client.gallery.play import play, wishes_of
from client.gallery.source import GallerySource
from protocol.messages import Preset
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.pipeline import FrameResult
from server.shading.kept_changes import HARDLY, LEAST_CODES, STEPS, KeptChanges, bound_of
from server.shading.kept_shadows import LONGEST
from server.transfer.kept_bounds import MEASURED, NOT_YET, KeptBounds
from server.transfer.transfer_cache import CHECKS, ORDERS, PARTS
from tests.scenes.analytic import Floats


def changes(**counts: int) -> Floats:
    """[1, STEPS] counts by step, as s0=..."""
    found = np.zeros((1, STEPS), np.int64)
    for step, count in counts.items():
        found[0, int(step[1:])] = count
    return found


def codes(step: int) -> float:
    return min(LEAST_CODES * 2.0 ** (step / 2), 255.0)


@pytest.mark.parametrize(
    ("shown", "found", "bound"),
    [
        (0.0, changes(), 0.0),  # nothing is shown of it
        (0.5, changes(), None),  # nothing was found anew
        (0.5 * HARDLY, changes(), LEAST_CODES),  # too little is shown to matter
        (1.0, changes(s0=1000), LEAST_CODES),
        (1.0, changes(s0=999, s6=1), codes(0)),
        (1.0, changes(s0=998, s6=2), codes(6)),
        (0.5, changes(s0=998, s6=2), codes(0)),  # a thousandth of the picture
        (1.0, changes(s0=900, s4=98, s9=2), codes(9)),
        (0.5, changes(s0=900, s4=98, s9=2), codes(4)),
        (1.0, changes(s20=1), 255.0),
    ],
)
def test_a_bound_leaves_out_a_thousandth_of_the_picture(shown: float, found: Floats, bound: float | None) -> None:
    assert bound_of(np.array([shown]), found) == bound


def test_kinds_count_by_what_they_show() -> None:
    steady, noisy = changes(s0=1000), changes(s0=9, s8=1)
    assert bound_of(np.array([0.99, 0.009]), np.concatenate([steady, noisy])) == codes(0)
    assert bound_of(np.array([0.98, 0.02]), np.concatenate([steady, noisy])) == codes(8)
    assert bound_of(np.array([0.98, 0.02]), np.concatenate([steady, changes()])) is None


class A:
    """A kind of samples."""


class B:
    """Another."""


def test_the_last_frames_count_in_which_something_was_found(engine: Engine) -> None:
    """What is shown is that of the last frame."""
    kept = KeptChanges()
    assert kept.bounds() == KeptBounds(0.0, 0.0)

    def frame(
        *, known: int = 500, lent: int = 0, step: int | None = 0, of: type = A, are_all_known: bool = False
    ) -> None:
        engine.profile.begin()
        kept.begin_frame()
        counts = kept.counts(engine)
        assert not counts.get().any()
        values = np.zeros((2, 1 + STEPS), np.int32)
        values[:, 0] = known, lent
        if step is not None:
            values[:, 1 + step] = 100
        counts.set(values)
        kept.take(engine, of, counts, 1 / 1000, are_all_known=are_all_known)

    frame(step=None)
    assert kept.bounds() == KeptBounds(None, 0.0)
    frame(step=None, known=0, lent=10, are_all_known=True)
    assert kept.bounds() == KeptBounds(None, None)
    frame(step=5, lent=10)
    assert kept.bounds() == KeptBounds(codes(5), codes(5))
    for _ in range(LONGEST - 1):
        frame(step=3)
        frame(step=None)
    assert kept.bounds() == KeptBounds(codes(5), 0.0)
    frame(step=3)
    assert kept.bounds() == KeptBounds(codes(3), 0.0)
    frame(step=0, of=B)
    assert kept.bounds() == KeptBounds(codes(0), 0.0)  # A is not shown
    frame(step=3, known=0)
    assert kept.bounds() == KeptBounds(0.0, 0.0)


FRAMES = 60
AGAIN = CHECKS * PARTS + ORDERS
"""The first frame of whose transfer a bound is known: that of the first frames was looked at again."""


def kept_bounds(result: FrameResult) -> dict[str, float | None]:
    """By the name of what is kept."""
    kept = [left for left in result.plan.left_out if left.effect.endswith("_of_known_places")]
    assert all(left.reason.endswith(NOT_YET if left.error_bound is None else MEASURED) for left in kept)
    return {left.effect: left.error_bound for left in kept}


@pytest.mark.parametrize(
    ("name", "preset"), [("closed-room", "reg4"), ("red-wall", "gr15fast"), ("soot", "reg4"), ("sharp-sun", "reg4")]
)
def test_pictures_are_off_by_no_more_than_the_plan_says(device: Device, name: str, preset: Preset) -> None:
    """All but a thousandth of the pixels of a moving camera, against pictures with nothing kept. Seen: 1 to 7 codes,
    bounds of 6 to 64."""
    source = GallerySource(name, 160, FRAMES)
    on, off = (
        [result for _, result in play(device, source, wishes_of(source, cache=cache, preset=preset))]
        for cache in ("on", "off")
    )
    bounds = [kept_bounds(result) for result in on]
    names = {"shadows_of_known_places", "transfer_of_known_places"}
    assert all(set(each) == names for each in bounds)
    assert not any(map(kept_bounds, off))
    assert set(bounds[0].values()) == {None}
    assert [each["transfer_of_known_places"] is None for each in bounds] == [i < AGAIN for i in range(FRAMES)]
    assert sum(each["shadows_of_known_places"] is None for each in bounds) <= 4
    for cached, exact, each in zip(on, off, bounds, strict=True):
        assert cached.color is not None
        assert exact.color is not None
        if None not in each.values():
            apart = np.abs(cached.color.astype(int) - exact.color).max(axis=-1)
            assert np.quantile(apart, 1 - HARDLY, method="higher") < sum(each.values()) + 1  # type: ignore[arg-type]

"""Which frames are kept and what they weigh: turning away forgets nothing, standing still keeps little."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from server.light.cell_transfer import PoolGrid, Pools
from server.light.frame_window import KEPT, RECENT, SLOTS, FrameWindow
from server.light.light_model import Frame
from server.maths.light_change import Shot

POOLS = 600
ALBEDOS = np.random.default_rng(0).uniform(0.2, 0.8, (40, POOLS))


def view(part: int, towards: Sequence[float] = (0.3, 1.0, 0.2), noise: float = 0.0) -> Frame:
    """A frame of one of many textured corners of a building, each 10 m from the next."""
    rng = np.random.default_rng(part)
    face, at = rng.integers(0, 3, POOLS), rng.uniform(0, 2, (POOLS, 3))
    at[np.arange(POOLS), face] = 0.0
    normals = np.eye(3)[face]
    light = np.array(towards) / np.linalg.norm(towards)
    seen = ALBEDOS[part] * (0.3 + np.maximum(normals @ light, 0)) * np.exp(noise * rng.normal(size=POOLS))
    pools = Pools(
        grid=PoolGrid(2, 20, 30),
        seen=seen[:, None] * np.ones(3),
        sent=np.zeros((POOLS, 3)),
        unseen=np.zeros(POOLS),
        weights=np.ones(POOLS),
        positions=at + np.array([10.0 * part, 0, 3]),
        normals=normals,
        open=np.ones(POOLS),
        beyond=np.zeros(3),
    )
    return Frame(pools, np.zeros((POOLS, 2), np.float32))


class Run:
    """A window fed with frames."""

    def __init__(self) -> None:
        self.window = FrameWindow()
        self.slots: dict[int, Frame] = {}

    def add(self, frame: Frame) -> int:
        """How many frames ago the youngest contradicted one was."""
        slot = self.window.free_slot()
        assert slot not in self.window.frames
        self.window.add(slot, frame, Shot(np.eye(4)))
        return self.window.weigh(slot).frames_ago

    def kept(self, frames: Sequence[Frame]) -> list[bool]:
        held = [id(frame) for frame in self.window.frames.values()]
        return [id(frame) in held for frame in frames]


def test_a_camera_that_stands_still_keeps_the_last_frames_and_one() -> None:
    run, frames = Run(), [view(0) for _ in range(30)]
    assert all(run.add(frame) == 0 for frame in frames)
    assert run.kept(frames) == [True] + [False] * (30 - RECENT - 1) + [True] * RECENT


def test_what_the_camera_turned_away_from_is_kept() -> None:
    """Three corners, ten frames each: of the first two one frame is left, with all its weight."""
    run, frames = Run(), [view(number // 10) for number in range(30)]
    assert all(run.add(frame) == 0 for frame in frames)
    kept = run.kept(frames)
    assert [sum(kept[corner : corner + 10]) for corner in (0, 10, 20)] == [1, 1, RECENT + 1]
    assert all(frame.keep == 1.0 for frame in run.window.frames.values())


def test_of_too_many_views_those_stay_that_show_most() -> None:
    run, frames = Run(), [view(number) for number in range(KEPT + RECENT + 8)]
    for frame in frames:
        run.add(frame)
    assert len(run.window.frames) == KEPT + RECENT == SLOTS - 1
    assert run.kept(frames)[-RECENT:] == [True] * RECENT


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_a_new_light_leaves_older_frames_no_weight(noise: float) -> None:
    """Those that show the same surface, and those before them that show other surface; within three frames."""
    run, elsewhere = Run(), view(1, noise=noise)
    run.add(elsewhere)
    before = [view(0, noise=noise) for _ in range(4)]
    assert [run.add(frame) for frame in before] == [0, 0, 0, 0]
    new = (1.0, 0.2, 0.3)
    after = [view(0, new, noise) for _ in range(3)]
    assert [run.add(frame) for frame in after] in ([1, 0, 0], [1, 2, 3], [1, 2, 0])
    assert max((frame.keep for frame in [*before, elsewhere] if run.kept([frame])[0]), default=0.0) < 0.05
    assert all(frame.keep == 1.0 for frame in after)


def test_a_light_that_creeps_takes_weight_from_old_frames_first() -> None:
    run, frames = Run(), []
    for step in range(20):
        angle = np.deg2rad(0.4 * step)
        frames.append(view(0, (np.cos(angle), 0.6, np.sin(angle))))
        run.add(frames[-1])
    weights = np.array([frame.keep if kept else 0.0 for frame, kept in zip(frames, run.kept(frames), strict=True)])
    assert weights[-1] == 1.0
    assert weights[-2] == 1.0
    assert (np.diff(weights[-RECENT:]) >= 0).all()
    assert weights[:10].sum() < 0.1


def test_a_frame_of_surface_never_seen_tells_nothing_of_the_light() -> None:
    run = Run()
    run.add(view(0))
    slot = run.window.free_slot()
    run.window.add(slot, view(1, (1.0, 0.2, 0.3)), Shot(np.eye(4)))
    told = run.window.weigh(slot)
    assert not told.is_told
    assert told.frames_ago == 0

"""Long sums, many updates: what rounding may add up to."""

from __future__ import annotations

import numpy as np

from server.light import light_estimation
from server.light.light_estimation import LightEstimator, unpack_tiles
from server.maths.bayes import NormalEquations, solve_plain
from server.maths.memory import remembered
from server.maths.registration import motion_of_twist
from server.maths.rigid import repaired_pose
from tests.hard_cases.cases.seen import FLOAT, LIGHT, SEEN, around, sums
from tests.hard_cases.catalogue import Family, Found, Trial

SUMS = Family("sums")


@SUMS.case(
    "10 million samples in one sum",
    66 * FLOAT,
    "relative",
    "64 products of three float32 in a row round at most 66 times 2^-24; tiles are added in float64.",
    checkable=False,
)
def ten_million(trial: Trial) -> Found:
    """Equal values are the worst: every rounding of a running sum goes the same way."""
    rows, cols = 1000, trial.of(1000, 10_000)
    space = trial.engine.workspace
    transfer = space.upload("transfer", np.full((rows, cols, 4), 0.1, np.float32))
    observed = np.full((rows, cols, 4), 0.3, np.float32)
    observed[..., 3] = 1
    packed = light_estimation._accumulate(
        trial.engine, transfer, space.upload("observed", observed.view(np.dtype((np.void, 16)))[..., 0])
    )
    total = unpack_tiles(packed, 4).total()
    a, b = float(np.float32(0.1)), float(np.float32(0.3))
    exact = rows * cols * np.array([a * a, a * b, b * b])
    found = np.array([total.matrix[1, 2], total.vector[2, 1], total.energy[1]])
    return Found(np.append(found / exact, total.count / (rows * cols)), 1.0)


@SUMS.case(
    "one estimate applied 100 000 times",
    1e-9,
    "relative",
    "each frame takes as much as it brings: float64 errors of 1e-15, condition 1000, decay with a memory of 10 frames.",
)
def applied(trial: Trial) -> Found:
    """The running evidence of a steady light stays what one frame says."""
    frame = sums(trial.engine, around()).total()
    known = frame.scaled(0.0) + frame
    for _ in range(trial.of(1500, 100_000)):
        known = remembered(known, frame, 0.9) + frame
    seen = NormalEquations(known.matrix[SEEN, SEEN], known.vector[SEEN], known.energy, known.count)
    first = NormalEquations(frame.matrix[SEEN, SEEN], frame.vector[SEEN], frame.energy, frame.count)
    found, truth = (solve_plain(e, np.ones(9)).mean for e in (seen, first))
    return Found(np.append(found / np.abs(truth).max(), known.count / (10 * frame.count)),
                 np.append(truth / np.abs(truth).max(), 1.0))  # fmt: skip


@SUMS.case(
    "a light updated with one frame, over and over",
    1e-3,
    "of the largest coefficient",
    "evidence of a steady light goes to ten frames' and stays: the answer after many frames is that after thirty.",
    apart=2e-3,
    known=True,
)
def updated(trial: Trial) -> Found:
    estimator, frame = LightEstimator(4), sums(trial.engine, around(), noise=0.01)
    for k in range(trial.of(200, 10_000)):
        estimate = estimator.update(frame)
        if k == 30:
            early = estimate.sh
    scale = np.abs(LIGHT).max()
    return Found(estimate.sh / scale, early / scale, known=estimate.valid)


@SUMS.case(
    "a pose composed 100 000 times",
    1e-11,
    "absolute",
    "products of rotations are brought back to the nearest one: 3e-16 each; the angle itself errs by 1e5 times that.",
)
def composed(trial: Trial) -> Found:
    count = trial.of(2000, 100_000)
    twist = 2 * np.pi / count * np.array([0.36, 0.48, 0.8, 0, 0, 0])
    step, pose = motion_of_twist(twist), np.eye(4)
    for _ in range(count):
        pose = repaired_pose(step @ pose)
    orthonormal = pose[:3, :3] @ pose[:3, :3].T
    return Found(np.stack([pose[:3, :3], orthonormal]), np.eye(3))

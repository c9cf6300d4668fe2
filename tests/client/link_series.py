"""What `client.streaming.adaptive` decides over simulated links; the port of the page must decide the same."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from client.streaming.adaptive import Adaptive, AnsweredFrame

SERIES, STEPS = 24, 400
LOST_SHARE = 0.004
"""Of the steps before which the connection is lost."""


def write_link_series(path: Path) -> int:
    """Write random series of measurements with the decisions that followed, as JSON; how many decisions."""
    random = np.random.default_rng(7)
    series = [_series(random, number) for number in range(SERIES)]
    path.write_text(json.dumps(series))
    return sum(len(each["steps"]) for each in series)


def _series(random: np.random.Generator, number: int) -> dict[str, Any]:
    """Links of 0.1 to 20 MB/s that change their rate now and then, frames and answers of any size."""
    wanted_s = 1 / float(random.choice([5, 15, 30]))
    delay_s = math.inf if number % 3 == 0 else float(random.uniform(0, 0.1))
    adaptive = Adaptive(wanted_s, delay_s)
    now_s, steps = 0.0, []
    bytes_per_s = computed_s = 0.0
    for step in range(STEPS):
        if step % 60 == 0:
            bytes_per_s = 10 ** float(random.uniform(5, 7.3))
            computed_s = float(random.choice([0.01, 0.05, 0.2, 1.0]))
        if random.random() < LOST_SHARE:
            adaptive.note_reconnection()
            steps.append({"kind": "lost", "rung": adaptive.rung})
        frame = _measured(random, adaptive, now_s, bytes_per_s, computed_s)
        adaptive.note(frame)
        coding = adaptive.coding
        told = {"rung": adaptive.rung, "quality": coding.quality, "divisor": coding.divisor, "busy_s": adaptive.busy_s}
        steps.append({"kind": "answered", **asdict(frame), **told})
        steps += [_asked(random, adaptive, frame) for _ in range(3)]
        now_s = frame.answered_s - float(random.uniform(0, 0.5)) * (frame.answered_s - frame.sent_s)
    return {"wanted_interval_s": wanted_s, "delay_s": None if delay_s == math.inf else delay_s, "steps": steps}


def _measured(
    random: np.random.Generator, adaptive: Adaptive, now_s: float, bytes_per_s: float, computed_s: float
) -> AnsweredFrame:
    up = int(random.uniform(0.8, 1.2) * (40_000 + 80_000 / (1 + adaptive.rung)))
    down = int(random.uniform(5_000, 60_000))
    took_s = computed_s * float(random.uniform(0.8, 1.3))
    waited_s = float(random.choice([0.0, 0.0, 0.1]))
    answered_s = now_s + 0.04 + waited_s + took_s + (up + down) / bytes_per_s + float(random.exponential(0.004))
    return AnsweredFrame(now_s, answered_s, took_s, up, down, waited_s if random.random() < 0.5 else None)


def _asked(random: np.random.Generator, adaptive: Adaptive, frame: AnsweredFrame) -> dict[str, Any]:
    """At any moment, and beside the one at which the answer changes."""
    sent_s = frame.answered_s - float(random.uniform(0, 0.2))
    unanswered = int(random.choice([0, 1, 1, 1, 2, 2, 3]))
    asked_s = (
        sent_s + adaptive.busy_s * float(random.choice([0.5, 0.999, 1.001, 1.5])) + float(random.choice([0, 0.01]))
    )
    return {
        "kind": "asked",
        "now_s": asked_s,
        "last_sent_s": sent_s,
        "unanswered": unanswered,
        "may_send": adaptive.may_send(asked_s, sent_s, unanswered),
    }

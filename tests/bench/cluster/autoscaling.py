"""A day's load against the autoscaler's settings, as a table and one picture.

    python -m tests.bench.cluster.autoscaling [--picture FILE]

Seconds on one core; nothing here is measured, all of it is `tests.bench.cluster.simulation`. Needs matplotlib.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import quantiles

import numpy as np

from server.cluster.capacity import Policy
from tests.bench.cluster.simulation import TICK_S, Day, Fleet, Load, simulate
from tests.bench.report.plotting import COLORS, panels, save

LOAD, FLEET, CHOSEN = Load(), Fleet(), Policy(spare=4, most=256)
SPARES = (0, 1, 2, 4, 8, 16)
SHRINK_MIN = (1, 10, 30)
DAYS = 5
PICTURE = Path(__file__).resolve().parents[3] / "docs" / "pictures" / "autoscaling.png"


@dataclass(frozen=True)
class Outcome:
    """Of one setting, over several days."""

    spare: int
    shrink_min: int
    refused_percent: float
    node_hours: float
    used_percent: float
    late_s: float
    """What one room in a hundred waits longer than."""


def main() -> int:
    """Play, print, draw."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--picture", type=Path, default=PICTURE)
    picture = options.parse_args().picture
    found = list(outcomes())
    print("spare  down after   refused   node-hours   used   1 in 100 waits longer than")
    for one in found:
        print(
            f"{one.spare:5d}  {one.shrink_min:6d} min  {one.refused_percent:6.2f} %  {one.node_hours:11.1f}"
            f"  {one.used_percent:3.0f} %  {one.late_s:6.0f} s"
        )
    draw(simulate(CHOSEN, LOAD, FLEET), found, picture)
    print(f"drawn in {picture}")
    return 0


def outcomes() -> Iterator[Outcome]:
    """Each setting over the same days."""
    for shrink_min in SHRINK_MIN:
        for spare in SPARES:
            policy = Policy(
                spare=spare, spare_share=CHOSEN.spare_share if spare else 0.0, shrink_after_s=60 * shrink_min, most=256
            )
            days = [simulate(policy, Load(seed=seed), FLEET) for seed in range(1, DAYS + 1)]
            waits = [wait for day in days for wait in day.waited_s]
            yield Outcome(
                spare,
                shrink_min,
                100 * sum(day.refused for day in days) / sum(day.rooms for day in days),
                sum(day.node_hours for day in days) / DAYS,
                100 * float(np.mean([day.used_share for day in days])),
                quantiles(waits, n=100)[-1],
            )


def draw(day: Day, found: list[Outcome], picture: Path) -> None:
    """The day under the chosen setting; and what each setting costs and refuses."""
    figure, axes = panels(1, 2, 13.0, 4.6)
    left, right = axes.ravel()
    hours = np.arange(len(day.open_rooms)) * TICK_S / 3600
    left.fill_between(hours, day.open_rooms, color=COLORS[0], alpha=0.35, linewidth=0, label="rooms open")
    left.step(hours, day.places, color=COLORS[1], linewidth=1.2, label="places on nodes that run")
    left.plot(hours, day.wanted, color=COLORS[2], linewidth=1.0, label="places asked for")
    left.set(xlim=(0, 24), xticks=range(0, 25, 4), xlabel="hour", ylabel="rooms", ylim=(0, None))
    left.set_title(
        f"one day: {CHOSEN.spare} places or {CHOSEN.spare_share:.0%} spare, "
        f"down after {CHOSEN.shrink_after_s / 60:.0f} min"
    )
    left.legend(loc="upper left")
    for color, shrink_min in zip(COLORS, SHRINK_MIN, strict=False):
        some = [one for one in found if one.shrink_min == shrink_min]
        x, y = [one.node_hours for one in some], [one.refused_percent for one in some]
        right.plot(x, y, "o-", color=color, label=f"down after {shrink_min} min")
        for one in some:
            right.annotate(
                str(one.spare), (one.node_hours, one.refused_percent), (4, 5), textcoords="offset points", color=color
            )
    right.set(xlabel="node-hours a day", ylabel="rooms refused, %", ylim=(-0.01, 40))
    right.set_yscale("symlog", linthresh=0.1)
    right.set_yticks([0, 0.1, 1, 10], ["0", "0.1", "1", "10"])
    right.set_title("spare places (numbers): cost against refusals")
    right.legend(loc="upper right")
    save(figure, picture)


if __name__ == "__main__":
    raise SystemExit(main())

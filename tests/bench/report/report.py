"""What a benchmark suite prints: rows of figures, each held against its goal, and what this machine cannot measure."""

from __future__ import annotations

import subprocess
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Row:
    """One figure."""

    name: str
    value: float
    unit: str
    goal: str
    """The figure that it is held against, as `>= 4` or `<= 10`; empty where there is none."""

    @property
    def holds(self) -> bool | None:
        """Whether the value meets the goal; None without one."""
        if not self.goal:
            return None
        relation, bound = self.goal.split()
        return self.value >= float(bound) if relation == ">=" else self.value <= float(bound)


@dataclass(frozen=True)
class Unmeasured:
    """A figure that this machine cannot measure."""

    name: str
    reason: str


@dataclass
class Report:
    """All of a suite."""

    device: str
    rows: list[Row] = field(default_factory=list)
    unmeasured: list[Unmeasured] = field(default_factory=list)
    sizes: dict[str, int] = field(default_factory=dict)
    """How many frames, trials or messages each part used."""

    def as_dict(self) -> dict[str, Any]:
        """One object, as the command line's contract has it."""
        rows = [{**asdict(row), "goal": row.goal or None, "holds": row.holds} for row in self.rows]
        unmeasured = [asdict(item) for item in self.unmeasured]
        today = datetime.now(UTC).date().isoformat()
        head = {"device": self.device, "commit": commit(), "date": today}
        return {**head, "rows": rows, "unmeasured": unmeasured, "sizes": self.sizes}


def commit() -> str:
    """Short hash of the checked-out commit, with + where files differ from it; "unknown" outside a checkout."""
    folder = Path(__file__).parent
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty=+", "--exclude=*"],
            cwd=folder,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return described.stdout.strip()

"""Lines of a report: what was checked, whether it holds, and where the wire page has the rule."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Line:
    """One rule that was checked."""

    rule: str
    section: str
    """Heading of protocol/README.md under which it is."""
    failure: str | None
    """What was seen instead; None: the rule holds."""

    def __str__(self) -> str:
        """`pass` or `FAIL`, the rule, its place, and what was seen."""
        seen = "" if self.failure is None else f": {self.failure}"
        return f"{'pass' if self.failure is None else 'FAIL'}  {self.rule} [README.md, {self.section}]{seen}"


class Broken(Exception):
    """The other side did not do what the rule says; the message is what it did."""

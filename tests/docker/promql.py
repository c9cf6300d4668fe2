"""What an expression of Prometheus's query language names: metrics, and the labels that each is asked for."""

from __future__ import annotations

import re
from dataclasses import dataclass

GROUPING = re.compile(r"\b(?:by|without)\s*\(([^)]*)\)")
RANGE = re.compile(r"\[[^\]]*\]")
SELECTOR = re.compile(r"([a-zA-Z_:][\w:]*)(?:\{([^}]*)\}|(?!\s*\(|[\w:]))")
"""A name with matchers, or one that no parenthesis follows, as it does a function."""
MATCHER = re.compile(r'\s*(\w+)\s*(=~|!~|!=|=)\s*"([^"]*)"\s*(?:,|$)')
OPERATORS = ("and", "or", "unless")


@dataclass(frozen=True)
class Named:
    """One metric in an expression."""

    metric: str
    labels: dict[str, tuple[str, ...]]
    """Values that each label is compared with, without the dashboard's variables."""


def named(expression: str) -> tuple[list[Named], set[str]]:
    """The metrics of an expression, and the labels that it groups by. Raises ValueError for a wrong matcher."""
    groups = {label.strip() for labels in GROUPING.findall(expression) for label in labels.split(",")}
    rest = RANGE.sub("", GROUPING.sub("", expression))
    found = [Named(name, _labels(matchers)) for name, matchers in SELECTOR.findall(rest) if name not in OPERATORS]
    return found, groups


def _labels(text: str) -> dict[str, tuple[str, ...]]:
    labels: dict[str, tuple[str, ...]] = {}
    while text.strip():
        match = MATCHER.match(text)
        if match is None:
            raise ValueError(f"not a matcher: {text}")
        name, kind, value = match.groups()
        values = value.split("|") if kind in ("=~", "!~") else [value]
        labels[name] = tuple(value for value in values if not value.startswith("$"))
        text = text[match.end() :]
    return labels

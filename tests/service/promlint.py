"""The rules of Prometheus's linter (`promtool check metrics`) that names of ours could break."""

from __future__ import annotations

import re

from prometheus_client.parser import text_string_to_metric_families

UNITS = ("milliseconds", "microseconds", "nanoseconds", "minutes", "hours", "days", "kilobytes", "megabytes", "percent")
ABBREVIATIONS = ("s", "ms", "us", "ns", "sec", "b", "kb", "mb", "gb", "kib", "mib", "gib", "pct")
TYPES = ("gauge", "counter", "histogram", "summary")


def problems(text: str) -> list[str]:
    """What is wrong with a scrape, one line each; empty where nothing is."""
    # The parser adds a missing _total, so that this rule needs the line itself.
    counters = re.findall(r"^# TYPE (\S+) counter$", text, re.MULTILINE)
    found = [f"{name}: a counter ends in _total" for name in counters if not name.endswith("_total")]
    for family in text_string_to_metric_families(text):
        # The parser takes the suffix from a counter's name, and gives the type that the TYPE line says.
        name, words = family.name, family.name.split("_")
        found += [f"{name}: no help"] * (not family.documentation.strip())
        found += [f"{name}: no type"] * (family.type in ("unknown", "untyped"))
        found += [f"{name}: type in the name"] * any(word in TYPES for word in words)
        found += [f"{name}: unit is not a base unit"] * any(word in (*UNITS, *ABBREVIATIONS) for word in words)
        found += [f"{name}: not in snake case"] * (re.fullmatch(r"[a-z][a-z0-9_]*", name) is None)
        for sample in {sample.name for sample in family.samples}:
            found += _problems_of_sample(sample, family.type)
    return found


def _problems_of_sample(name: str, kind: str) -> list[str]:
    found = []
    if kind != "counter" and name.endswith("_total"):
        found.append(f"{name}: {kind}, but ends in _total")
    if kind not in ("histogram", "summary") and re.search(r"_(bucket|count|sum)$", name):
        found.append(f"{name}: ends like a histogram's sample")
    if name.endswith("_created"):
        found.append(f"{name}: a series of times of creation")
    return found

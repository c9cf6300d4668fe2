"""The list of slow tests, tests/slow.txt: `make test` leaves them out. `python -m tests.slow LOG` writes it anew.

A line names a test function, with all its parameters, or one set of parameters. The device's name is left out.
LOG is what pytest printed with `--durations=0 -vv`; `make slow-list` makes it.
"""

from __future__ import annotations

import re
import sys
from collections import defaultdict
from collections.abc import Collection, Iterable
from pathlib import Path

from server.opencl.device import list_devices

LIST = Path(__file__).with_name("slow.txt")
QUICK_FUNCTION_S = 0.6
"""The cheapest calls of a function are quick while they take no longer than this together."""
QUICK_FILE_S = 6.0
"""Where all calls in a file are slow by that rule, the cheapest is quick if it takes no longer than this."""
_HEAD = """\
# Tests that `make test` leaves out, with the seconds that each took: written by `make slow-list`.
"""
_DURATION = re.compile(r"\s*([\d.]+)s (?:call|setup|teardown)\s+(tests/\S+\.py::.+?)\s*$")


def read_list() -> list[str]:
    """The names in the list."""
    lines = [line.partition("  # ")[0].strip() for line in LIST.read_text().splitlines()]
    return [line for line in lines if line and not line.startswith("#")]


def function_of(name: str) -> str:
    """Name of a test without its parameters."""
    return name.partition("[")[0]


def file_of(name: str) -> str:
    """The file of a test."""
    return name.partition("::")[0]


def without_device(node_id: str, device: str) -> str:
    """Name of a test without the parameter that is the device, wherever it stands."""
    shorter = node_id.replace(f"[{device}]", "").replace(f"[{device}-", "[")
    return shorter.replace(f"-{device}]", "]").replace(f"-{device}-", "-")


def stale_lines(lines: Iterable[str], collected: Collection[str]) -> list[str]:
    """Lines that name no test. Of a file that gave no test, since an extra is missing, only the file is checked."""
    known = {*collected, *map(function_of, collected)}
    files = {file_of(name) for name in collected}
    return [
        line
        for line in lines
        if (line not in known if file_of(line) in files else not (LIST.parents[1] / file_of(line)).is_file())
    ]


def choose_slow(took_s: dict[str, float]) -> dict[str, float]:
    """The names to list, with their seconds, from the seconds of every test."""
    functions: dict[str, list[str]] = defaultdict(list)
    for name in sorted(took_s, key=lambda name: took_s[name]):
        functions[function_of(name)].append(name)
    quick: set[str] = set()
    for calls in functions.values():
        total_s = 0.0
        for name in calls:
            total_s += took_s[name]
            if total_s <= QUICK_FUNCTION_S:
                quick.add(name)
    for file in {file_of(name) for name in took_s} - {file_of(name) for name in quick}:
        cheapest = min((name for name in took_s if file_of(name) == file), key=lambda name: took_s[name])
        if took_s[cheapest] <= QUICK_FILE_S:
            quick.add(cheapest)
    slow: dict[str, float] = {}
    for function, calls in functions.items():
        if quick.isdisjoint(calls):
            slow[function] = sum(took_s[name] for name in calls)
        else:
            slow |= {name: took_s[name] for name in calls if name not in quick}
    return slow


def read_durations(log: str) -> dict[str, float]:
    """Seconds of every test, its own set-up and tear-down included."""
    devices = [f"{device.platform} / {device.name}" for device in list_devices()]
    took_s: dict[str, float] = defaultdict(float)
    for line in log.splitlines():
        if found := _DURATION.match(line):
            name = found[2]
            for device in devices:
                name = without_device(name, device)
            took_s[name] += float(found[1])
    return took_s


def main() -> int:
    """Write the list."""
    slow = choose_slow(read_durations(Path(sys.argv[1]).read_text()))
    LIST.write_text(_HEAD + "".join(f"{name}  # {slow[name]:.1f} s\n" for name in sorted(slow)))
    return 0


if __name__ == "__main__":
    sys.exit(main())

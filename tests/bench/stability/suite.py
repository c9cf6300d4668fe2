"""`probeless bench stability`: the catalogue of hard cases (tests/hard_cases/cases) in every build of the kernels.

Builds are every OpenCL device here, on PoCL all of its ways to make loops of a work-group that it knows (`loopvec`,
`workitemloops`, `cbs`), each with and without the compiler's optimisations (`-cl-opt-disable`). A case is green in a
build if it is finite, within its bound of the float64 reference, the same bits twice, and says that it does not know
what cannot be known; and over all builds if they agree to its bound. Builds run one after the other, each in a process
and with a cache of its own, in out/bench/stability.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import combinations
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from server.opencl.device import DeviceInfo, list_devices, open_device
from tests.bench.report.finished import ROOT
from tests.bench.report.report import Report, Row, Unmeasured
from tests.hard_cases.cases import CASES
from tests.hard_cases.catalogue import Case, Floats

OUT = ROOT / "out" / "bench" / "stability"
METHODS = ("loopvec", "workitemloops", "cbs")
"""PoCL's ways to turn a work-group into loops; the first is its default, the last is of later versions."""
OPTIMISED = {"": "", ", no optimisation": "-cl-opt-disable"}
_NOT_FINITE = 1e300
"""Stands for an error that is no number: far beyond every bound, and JSON."""
_LIMIT_S = 1800


@dataclass(frozen=True)
class Build:
    """One way to run the kernels."""

    name: str
    device: str
    environment: dict[str, str]


@dataclass
class Results:
    """Of one build, by the cases' identities."""

    outcomes: dict[str, dict[str, Any]] = field(default_factory=dict)
    values: dict[str, Floats] = field(default_factory=dict)


_PROBE = """
import sys
from server.opencl.device import open_device
from server.opencl.engine import Engine
engine = Engine(open_device(sys.argv[1]))
engine.workspace.array("x", (64,), "f4").fill(1)
engine.close()
"""


def knows(device: str, method: str) -> bool:
    """Whether that PoCL has the method: an unknown one is another, and a line on the standard error says so."""
    with TemporaryDirectory() as cache:
        environment = os.environ | {"POCL_WORK_GROUP_METHOD": method, "POCL_CACHE_DIR": cache, "PYOPENCL_NO_CACHE": "1"}
        command = [sys.executable, "-c", _PROBE, device]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    return done.returncode == 0 and "Unknown work group" not in done.stderr


def builds_of(devices: list[DeviceInfo], knows: Callable[[str, str], bool] = knows) -> list[Build]:
    """All builds of the devices that can be used."""
    builds: list[Build] = []
    for info in devices:
        if info.usable is not None:
            continue
        device = f"{info.platform} / {info.name}"
        is_pocl = info.platform == "Portable Computing Language"
        methods = [method for method in METHODS if knows(device, method)] if is_pocl else [""]
        for method in methods:
            for label, options in OPTIMISED.items():
                environment = {"PYOPENCL_BUILD_OPTIONS": options} if options else {}
                if method:
                    environment["POCL_WORK_GROUP_METHOD"] = method
                name = (f"PoCL {method}" if is_pocl else info.name) + label
                if any(build.name == name for build in builds):
                    name = f"{device} {name}"
                builds.append(Build(name, device, environment))
    return builds


def run_build(build: Build, quick: bool) -> Results:
    """The catalogue in that build. A build that fails as a whole has no outcomes but the reason, for every case."""
    folder = OUT / "builds" / "".join(c if c.isalnum() else "_" for c in build.name)
    folder.mkdir(parents=True, exist_ok=True)
    environment = {k: v for k, v in os.environ.items() if k not in ("POCL_WORK_GROUP_METHOD", "PYOPENCL_BUILD_OPTIONS")}
    environment |= {"POCL_CACHE_DIR": str(folder / "cache"), "PYOPENCL_NO_CACHE": "1"} | build.environment
    command = [sys.executable, "-m", "tests.bench.stability.build", str(folder / "result"), "--device", build.device]
    (folder / "result.json").unlink(missing_ok=True)
    try:
        with (folder / "log.txt").open("w") as log:
            subprocess.run(
                command + ["--quick"] * quick,
                cwd=ROOT,
                env=environment,
                stdout=log,
                stderr=log,
                timeout=_LIMIT_S,
                check=True,
            )
        result = json.loads((folder / "result.json").read_text())
        with np.load(folder / "result.npz") as arrays:
            values = {name: arrays[str(k)] for k, name in enumerate(result["names"])}
    except (OSError, subprocess.SubprocessError) as error:
        lines = (folder / "log.txt").read_text().splitlines()[-1:] or [""]
        fault = f"{type(error).__name__} after: {lines[0]}"
        nothing = {"error": None, "known": None, "digest": "", "fault": fault, "seconds": 0.0}
        return Results({case.identity: nothing for case in CASES})
    return Results(result["outcomes"], values)


def apart(case: Case, results: dict[str, Results]) -> float:
    """Greatest distance of two builds; 0 for one build alone, infinite where one has no values."""
    values = [r.values.get(case.identity, np.full(1, np.nan)) for r in results.values()]
    return max((case.between(a, b) for a, b in combinations(values, 2)), default=0.0)


def run_suite(quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Run the catalogue in every build; `say` gets progress."""
    builds = builds_of(list_devices())
    results: dict[str, Results] = {}
    for build in builds:
        say(f"{build.name}: {len(CASES)} cases ...")
        results[build.name] = run_build(build, quick)
        red = [name for name, outcome in results[build.name].outcomes.items() if outcome["fault"]]
        say(f"{build.name}: {len(red)} red" + "".join(f"\n  {name}" for name in red))
    report = report_of(results)
    for method in METHODS:
        if any("PoCL" in b.name for b in builds) and not any(f"PoCL {method}" in b.name for b in builds):
            report.unmeasured.append(Unmeasured(f"PoCL {method}", "no PoCL here knows this way to run a work-group"))
    result = report.as_dict()
    result["builds"] = [build.name for build in builds]
    result["cases"] = [_details(case, results) for case in CASES]
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "result.json").write_text(json.dumps(result, indent=1, allow_nan=False))
    return result


def report_of(results: dict[str, Results]) -> Report:
    """A row for each build and two for all together, then one a case: its greatest error."""
    report = Report(open_device(None).name)
    report.sizes = {"cases": len(CASES), "builds": len(results)}
    for name, result in results.items():
        red = sum(outcome["fault"] is not None for outcome in result.outcomes.values())
        report.rows.append(_row(f"red cases, {name}", red, "cases", 0))
    disagree = sum(not apart(case, results) <= case.agreement for case in CASES)
    report.rows.append(_row("cases in which builds disagree", disagree, "cases", 0))
    alike = sum(len({r.outcomes[case.identity]["digest"] for r in results.values()}) == 1 for case in CASES)
    report.rows.append(Row("cases that are the same to the bit in all builds", alike, "cases", ""))
    for case in CASES:
        errors = [result.outcomes[case.identity]["error"] for result in results.values()]
        worst = max((_NOT_FINITE if error is None else error for error in errors), default=0.0)
        report.rows.append(_row(case.identity, worst, case.unit, case.bound))
    return report


def _row(name: str, value: float, unit: str, bound: float) -> Row:
    return Row(name, float(value), unit, f"<= {float(bound)!r}")


def _details(case: Case, results: dict[str, Results]) -> dict[str, Any]:
    difference = apart(case, results)
    return {
        "family": case.family,
        "name": case.name,
        "unit": case.unit,
        "bound": case.bound,
        "agreement": case.agreement,
        "reason": case.reason,
        "must_be_known": case.known,
        "apart": difference if np.isfinite(difference) else None,
        "builds": {name: result.outcomes[case.identity] for name, result in results.items()},
    }

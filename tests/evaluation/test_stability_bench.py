"""The benchmark of hard cases: which builds there are, what makes a case red, and the page made of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from server.opencl.device import Device, DeviceInfo
from tests.bench.stability import doc as stability_doc
from tests.bench.stability import suite as stability
from tests.bench.stability.build import run_case
from tests.bench.stability.suite import Results, apart, builds_of, report_of
from tests.hard_cases.cases import CASES
from tests.hard_cases.catalogue import Case, Found

POCL = DeviceInfo("Portable Computing Language", "pthread-x", "CPU", 2, 1, None)
GPU = DeviceInfo("NVIDIA CUDA", "H", "GPU", 2, 1, None)
BROKEN = DeviceInfo("Broken", "B", "GPU", 2, 1, "cannot compile")


def test_every_device_and_every_way_of_pocl_is_a_build() -> None:
    builds = builds_of([GPU, POCL, BROKEN], lambda _device, method: method != "cbs")
    assert [build.name for build in builds] == [
        "H",
        "H, no optimisation",
        "PoCL loopvec",
        "PoCL loopvec, no optimisation",
        "PoCL workitemloops",
        "PoCL workitemloops, no optimisation",
    ]
    assert builds[1].environment == {"PYOPENCL_BUILD_OPTIONS": "-cl-opt-disable"}
    assert builds[4].environment == {"POCL_WORK_GROUP_METHOD": "workitemloops"}
    assert len({build.name for build in builds_of([POCL, POCL], lambda *_: True)}) == 12


def outcome(error: float | None, fault: str | None = None, digest: str = "0") -> dict[str, Any]:
    return {"error": error, "known": None, "digest": digest, "fault": fault, "seconds": 0.1}


def results_of(monkeypatch: pytest.MonkeyPatch) -> tuple[Case, dict[str, Results]]:
    """Two builds of one case of bound 0.5; truth is 0."""
    case = Case("n", "f", lambda _trial: Found(0, 0), 0.5, "m", "So.", apart=0.2)
    monkeypatch.setattr(stability, "CASES", (case,))
    return case, {
        "a": Results({case.identity: outcome(0.1)}, {case.identity: np.array([0.1])}),
        "b": Results({case.identity: outcome(0.4, digest="1")}, {case.identity: np.array([0.4])}),
    }


def test_builds_that_disagree_are_a_fault_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    case, results = results_of(monkeypatch)
    assert apart(case, results) == pytest.approx(0.3)
    rows = {row.name: row for row in report_of(results).rows}
    assert rows["red cases, a"].holds
    assert rows["red cases, b"].holds
    assert not rows["cases in which builds disagree"].holds
    assert rows["f: n"].value == 0.4
    assert rows["f: n"].holds
    results["b"].values[case.identity] = np.array([0.25])
    assert {row.name: row for row in report_of(results).rows}["cases in which builds disagree"].holds


def test_what_is_not_finite_is_red(monkeypatch: pytest.MonkeyPatch) -> None:
    case, results = results_of(monkeypatch)
    results["b"] = Results({case.identity: outcome(None, "not finite")}, {case.identity: np.array([np.nan])})
    rows = {row.name: row for row in report_of(results).rows}
    assert not rows["red cases, b"].holds
    assert not rows["f: n"].holds
    assert not rows["cases in which builds disagree"].holds
    details = stability._details(case, results)
    page = stability_doc.figures({"commit": "c", "device": "d", "builds": ["a", "b"], "cases": [details]})
    assert "| b | 0 | 1 |" in page
    assert "- f: n, b: not finite" in page
    assert "| n | 0.5 m | 0.1 | none | none |  | So. |" in page


def test_a_case_that_raises_or_changes_is_red(device: Device) -> None:
    def broken(_trial: object) -> Found:
        raise RuntimeError("no kernel")

    counter = iter(range(10))
    changing = Case("n", "f", lambda _trial: Found(1e-3 * next(counter), 0), 0.5, "m", "So.")
    assert run_case(Case("n", "f", broken, 0.5, "m", "So."), device, True, False)[0].fault == "RuntimeError: no kernel"
    assert run_case(changing, device, True, False)[0].fault == "other bits the second time"
    assert run_case(changing, device, True, True)[0].fault is None


def test_the_catalogue_covers_what_it_should() -> None:
    """A family that is not imported would be missed silently."""
    families = {case.family for case in CASES}
    assert families == {
        "light by normal equations",
        "light of a room",
        "sums",
        "spherical harmonics",
        "transfer",
        "kept transfer",
        "volume",
        "tracking",
        "input",
        "differential rendering",
        "rasteriser",
        "work-groups",
        "sessions",
    }
    assert len(CASES) > 120

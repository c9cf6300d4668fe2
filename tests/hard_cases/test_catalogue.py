"""The catalogue of hard cases, each once on every device: finite, within its bound, the same bits twice, honest."""

from __future__ import annotations

import numpy as np
import pytest

from server.opencl.device import Device
from tests.hard_cases.cases import CASES
from tests.hard_cases.catalogue import Case, Family, Found, measured, share_beyond


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.identity)
def test_case(device: Device, case: Case) -> None:
    found = measured(case, device)
    assert case.fault(found) is None
    assert measured(case, device).digest == found.digest


def test_names_are_told_apart_and_reasons_given() -> None:
    assert len({case.identity for case in CASES}) == len(CASES)
    assert all(case.reason.strip().endswith(".") and case.unit for case in CASES)


def test_faults_are_found() -> None:
    """What the catalogue rests on: a wrong, endless or overconfident answer is none of the right ones."""
    family = Family("f")
    family.case("n", 0.1, "m", "So.", known=False)(lambda _trial: Found(0, 0))
    case = family.cases[0]
    assert case.fault(Found([1.0, 2.0], [1.05, 2.0], known=False)) is None
    assert "beyond" in str(case.fault(Found([1.0, 2.0], [1.2, 2.0], known=False)))
    assert "not finite" in str(case.fault(Found([np.nan], [1.0], known=False)))
    assert "known" in str(case.fault(Found([1.0], [1.0], known=True)))
    assert "known" in str(case.fault(Found([1.0], [1.0])))
    assert case.between(np.zeros(3), np.zeros(4)) == np.inf
    assert case.between(np.zeros(3), np.array([0, 0.2, 0])) == pytest.approx(0.2)
    assert share_beyond(0.5)(np.array([0.0, 1, 1, 0]), np.zeros(4)) == 0.5

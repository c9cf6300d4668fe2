"""The table of constants in docs/light.md is of the constants as they are, and what measures it sets what it says."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.bench.light.sensitivity import CONSTANTS, Constant, set_before_import

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "light.md"
ELSEWHERE = ("solver", "transport", "fade", "unseen_lamps", "emitters")
"""Modules with constants that the page lists besides those of CONSTANTS."""


def value_of(name: str) -> float | np.ndarray:
    """Of a constant of the model, wherever it stands."""
    modules = [*dict.fromkeys(constant.module for constant in CONSTANTS), *ELSEWHERE]
    found = [importlib.import_module(f"server.light.shell.{module}") for module in modules]
    return next(getattr(module, name) for module in found if hasattr(module, name))


def test_the_page_lists_constants_as_they_are() -> None:
    rows = re.findall(r"^\| `(\w+)` \| ([^|]+) \|", PAGE.read_text(), re.MULTILINE)
    assert {constant.name for constant in CONSTANTS} <= {name for name, _ in rows}
    for name, told in rows:
        parts = [part.split("/") for part in told.replace(" ", "").split(",")]
        numbers = [float(part[0]) / float(part[1] if len(part) > 1 else 1) for part in parts]
        np.testing.assert_allclose(np.ravel(value_of(name)), numbers, rtol=1e-6, err_msg=name)


@pytest.mark.parametrize("constant", CONSTANTS, ids=lambda constant: constant.name)
def test_other_values_lie_on_both_sides(constant: Constant) -> None:
    value = np.ravel(value_of(constant.name)).astype(float)
    low, high = np.abs(np.ravel(constant.low)), np.abs(np.ravel(constant.high))
    assert np.all(low < np.abs(value)), "below"
    assert np.all(high > np.abs(value)), "above"


def test_a_constant_that_is_in_use_is_not_set() -> None:
    importlib.import_module("server.light.shell.objective")
    with pytest.raises(RuntimeError, match="HUBER in a process of its own"):
        set_before_import(next(constant for constant in CONSTANTS if constant.name == "HUBER"), 2.0)


def test_what_uses_a_constant_has_its_other_value() -> None:
    program = (
        "from tests.bench.light.sensitivity import CONSTANTS, set_before_import\n"
        "chosen = {constant.name: constant for constant in CONSTANTS}\n"
        "for name in ('PATCH_NOISE', 'SURFACE_SPREAD', 'RAYS'):\n"
        "    set_before_import(chosen[name], chosen[name].low)\n"
        "from server.light.shell import evidence, objective, transport\n"
        "print(evidence.PATCH_NOISE, objective._AlbedoSpreads().surface, transport.RAYS)\n"
    )
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    assert told.split() == ["0.065", "0.045", "512"]

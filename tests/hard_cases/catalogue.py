"""What a hard case is: something measured, its float64 reference, how far apart they may be, and why just as far.

A case is a function of a Trial (an engine, and whether to be quick) that gives what was found beside the truth. The
same catalogue (tests/hard_cases/cases) is run by pytest on one device and by `probeless bench stability` on every
device and build, which also compares the builds with one another.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from server.opencl.device import Device
from server.opencl.engine import Engine

Floats = NDArray[np.float64]
Distance = Callable[[Floats, Floats], float]


@dataclass(frozen=True)
class Trial:
    """What a case is run with."""

    engine: Engine
    quick: bool = True
    """Few repetitions, for pytest; the benchmark takes as many as the case's name says."""

    @property
    def device(self) -> Device:
        return self.engine.device

    def of(self, quick: int, full: int) -> int:
        """How many: the one of this size of run."""
        return quick if self.quick else full


class Found:
    """What a case measured beside what is true, of one shape, in the case's unit."""

    def __init__(self, values: ArrayLike, truth: ArrayLike, *, known: bool | None = None) -> None:
        """`known`: whether the program says that it knows the answer; None where it has no way to say."""
        self.values = np.asarray(values, np.float64)
        self.truth = np.broadcast_to(np.asarray(truth, np.float64), self.values.shape)
        self.known = known

    @property
    def digest(self) -> str:
        """Of every bit of the values."""
        return hashlib.sha256(np.ascontiguousarray(self.values).tobytes()).hexdigest()[:16]


def largest(values: Floats, truth: Floats) -> float:
    """The greatest difference."""
    return float(np.abs(values - truth).max(initial=0.0))


def share_beyond(tolerance: float) -> Distance:
    """Share of the values that are off by more than `tolerance`."""

    def distance(values: Floats, truth: Floats) -> float:
        return float((np.abs(values - truth) > tolerance).mean()) if values.size else 0.0

    return distance


@dataclass(frozen=True)
class Case:
    """One hard case."""

    name: str
    family: str
    measure: Callable[[Trial], Found]
    bound: float
    """Greatest distance from the truth, in `unit`."""
    unit: str
    reason: str
    """Why the bound is what it is, in one sentence."""
    known: bool | None = None
    """What the program must say of its answer: False where it cannot be known; None: it is not asked."""
    distance: Distance = largest
    apart: float | None = None
    """Greatest distance of two builds, where that is not the bound: truth may be farther off than rounding reaches."""
    checkable: bool = True
    """Small enough for a simulator that checks every access."""

    @property
    def identity(self) -> str:
        return f"{self.family}: {self.name}"

    @property
    def agreement(self) -> float:
        """How far apart the results of two builds may be."""
        return self.bound if self.apart is None else self.apart

    def fault(self, found: Found) -> str | None:
        """What is wrong with a result, None if nothing is."""
        if not np.isfinite(found.values).all():
            return "not finite"
        error = self.distance(found.values, found.truth)
        if not error <= self.bound:
            return f"error {error:.3g} {self.unit} beyond {self.bound:.3g}"
        if self.known is not None and found.known != self.known:
            return f"says that the answer is {'known' if found.known else 'unknown'}, and it is not"
        return None

    def between(self, one: Floats, other: Floats) -> float:
        """Distance of two builds' results; infinite where their shapes differ or a number is none."""
        if one.shape != other.shape or not (np.isfinite(one).all() and np.isfinite(other).all()):
            return float("inf")
        return self.distance(one, other)


@dataclass
class Family:
    """Cases of one subject."""

    name: str
    checkable: bool = True
    """Of its cases, where they do not say."""
    cases: list[Case] = field(default_factory=list)

    def case(self, name: str, bound: float, unit: str, reason: str, **more: Any) -> Callable[[Any], Any]:
        """Decorator: the function measures a case of this name."""

        def add(measure: Callable[[Trial], Found]) -> Callable[[Trial], Found]:
            settings = {"checkable": self.checkable} | more
            self.cases.append(Case(name, self.name, measure, bound, unit, reason, **settings))
            return measure

        return add


def measured(case: Case, device: Device, *, quick: bool = True) -> Found:
    """The case on a fresh queue and fresh memory of the device."""
    engine = Engine(device)
    try:
        return case.measure(Trial(engine, quick))
    finally:
        engine.close()

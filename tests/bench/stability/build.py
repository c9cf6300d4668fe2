"""The catalogue of hard cases in one build of the kernels: `python -m tests.bench.stability.build --device NAME OUT`.

A process of its own, because OpenCL drivers read the variables that choose a build when they start. Writes OUT.json, an
entry a case, and OUT.npz, the cases' values. Each case is run twice: a device gives the same bits again.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from server.opencl.device import Device, open_device
from tests.hard_cases.cases import CASES
from tests.hard_cases.catalogue import Case, Floats, measured


@dataclass(frozen=True)
class Outcome:
    """Of one case in one build."""

    error: float | None
    """In the case's unit; None where it is not finite."""
    known: bool | None
    digest: str
    fault: str | None
    """What is wrong, None if nothing is."""
    seconds: float


def run_case(case: Case, device: Device, quick: bool, once: bool) -> tuple[Outcome, Floats]:
    """The case, and its values; what it raises is a fault."""
    started = time.monotonic()
    try:
        found = measured(case, device, quick=quick)
        fault = case.fault(found)
        if fault is None and not once and measured(case, device, quick=quick).digest != found.digest:
            fault = "other bits the second time"
    except Exception as error:  # any failure of a case is one of its build, named in the table
        return Outcome(None, None, "", f"{type(error).__name__}: {error}".splitlines()[0], 0.0), np.zeros(0)
    distance = case.distance(found.values, found.truth)
    return (
        Outcome(
            distance if np.isfinite(distance) else None,
            found.known,
            found.digest,
            fault,
            time.monotonic() - started,
        ),
        found.values,
    )


def main() -> None:
    """Run all cases, or those of `--only`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--device", default=None)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", nargs="*", default=None, metavar="CASE", help="family: name")
    parser.add_argument("--once", action="store_true", help="not again for the same bits")
    wanted = parser.parse_args()
    device = open_device(wanted.device)
    outcomes, values = {}, {}
    for case in CASES:
        if wanted.only is None or case.identity in wanted.only:
            outcome, values[case.identity] = run_case(case, device, wanted.quick, wanted.once)
            outcomes[case.identity] = asdict(outcome)
            print(f"{case.identity}: {outcome.fault or 'ok'}", flush=True)
    np.savez(wanted.out.with_suffix(".npz"), **{str(k): v for k, v in enumerate(values.values())})
    wanted.out.with_suffix(".json").write_text(
        json.dumps({"device": device.name, "names": list(values), "outcomes": outcomes}, indent=1, allow_nan=False)
    )


if __name__ == "__main__":
    main()

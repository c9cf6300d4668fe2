"""Khronos' validator of glTF, from npm."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

from tests.node import installed_modules, node

PROGRAM = """
const { readFileSync } = require("node:fs");
const { validateBytes } = require(process.argv[1]);
validateBytes(new Uint8Array(readFileSync(process.argv[2])), { maxIssues: 100 })
  .then((report) => console.log(JSON.stringify(report)));
"""
HINT = 2
"""From this severity on an issue is neither an error nor a warning."""


def validated(path: Path) -> dict[str, Any]:
    """The validator's report on a GLB; fails the test with its errors and warnings, if it has any."""
    library = installed_modules() / "gltf-validator"
    command = [node(), "-e", PROGRAM, str(library), str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    report: dict[str, Any] = json.loads(done.stdout)
    bad = [issue for issue in report["issues"]["messages"] if issue["severity"] < HINT]
    assert bad == [], json.dumps(bad[:5])
    return report

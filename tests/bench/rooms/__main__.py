"""`python -m tests.bench.rooms FOLDER --light NAME --seed N`: a furnished room by path tracing, with the true light.

Needs what no other part of the project does: `pip install mitsuba==3.5.2 pyoidn cffi`, and LLVM's library (14 or 15).
"""

from __future__ import annotations

import argparse
import sys
from importlib.util import find_spec
from pathlib import Path

from tests.bench.rooms.furniture import LIGHTS, furnished_room
from tests.bench.rooms.ground_truth import write_room

NEEDED = ("mitsuba", "pyoidn", "cffi")


def main(arguments: list[str] | None = None) -> int:
    """Exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.rooms", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", type=Path, help="of the set; must not exist")
    parser.add_argument("--light", choices=sorted(LIGHTS), default="ceiling")
    parser.add_argument("--seed", type=int, default=1, help="of the furniture, the paints and the noise")
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--samples", type=int, default=16, help="rays of a pixel, before the pictures are denoised")
    parser.add_argument("--turn", action="store_true", help="the camera turns once around, and sees the ceiling")
    parser.add_argument("--large", action="store_true", help="walls a metre farther from the cameras")
    asked = parser.parse_args(arguments)
    if asked.folder.exists():
        return _refuse(f"{asked.folder} exists: name a folder that does not")
    if asked.frames < 1 or asked.samples < 1:
        return _refuse("--frames and --samples must be at least 1")
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        return _refuse(f"{', '.join(missing)} not installed: pip install mitsuba==3.5.2 pyoidn cffi")
    from tests.bench.rooms.tracing import TracedRoom, denoised

    room = furnished_room(asked.seed, asked.light, is_large=asked.large)
    traced = TracedRoom(room)
    write_room(
        asked.folder, room, traced, asked.seed, asked.frames, asked.samples, _say, denoise=denoised, turns=asked.turn
    )
    print(f"wrote {asked.folder}")
    return 0


def _refuse(reason: str) -> int:
    print(reason, file=sys.stderr)
    return 2


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())

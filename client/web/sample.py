"""Make the sample that the page plays by "Try it": `python -m client.web.sample`.

A recording (protocol/README.md) of one sway of the camera before the synthetic desk, so that it can be played in a
loop, with a vase in a free place. It is part of the repository, as making it takes minutes and a server has no client.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from client.options.source import open_source
from client.sources.frame_source import Source
from client.sources.volume import default_volume, default_voxel
from client.streaming.coding import Coding, frame_message
from client.synthetic.scenes import desk
from protocol.messages import Hello, PlaceObject, Wishes
from protocol.recording import write_message
from server.scene.vase import vase_glb

FPS, STEP = 30, 3
"""Frame rate of the scene, and the step between recorded frames: 10 a second are enough to be played."""
FRAMES = range(0, round(desk.PERIOD_S * FPS), STEP)
SPEC = f"synthetic:desk?frames={FRAMES.stop}&size=320x240"
CODING = Coding(quality=80, depth_level=19)
PLACE = Path(__file__).resolve().parent / "src" / "sample.probeless"


def write_sample(path: Path, source: Source | None = None, frames: range = FRAMES) -> None:
    """Write the recording; `source` defaults to the desk. Raises OSError."""
    source = source or open_source(SPEC)
    volume = default_volume(source, frames)
    wishes = Wishes(volume_m=volume, voxel_m=default_voxel(volume), up=source.up)
    vase = PlaceObject(request=0, object="vase", format="glb", data=vase_glb(), position_m=desk.FREE_M)
    with path.open("wb") as file:
        write_message(file, Hello(client="probeless sample", camera=source.camera, wishes=wishes))
        write_message(file, vase)
        for number, index in enumerate(frames):
            write_message(file, frame_message(replace(source[index], index=number), source.camera, coding=CODING))


def main() -> int:
    """Write the sample into the sources of the page."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--out", type=Path, default=PLACE, help="file of the recording")
    given = options.parse_args()
    write_sample(given.out)
    sys.stdout.write(f"{given.out}: {given.out.stat().st_size / 1e6:.2f} MB\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

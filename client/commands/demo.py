"""`probeless demo`: a server in this process, and a client that streams a synthetic scene to it over a socket."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from client.commands.stream import StreamSummary, stream
from client.objects.object_file import ObjectFile
from client.options.source import open_source
from client.progress import say
from client.results.names import PAGE_NAME
from client.sources.frame_source import Source
from client.sources.volume import default_volume, default_voxel
from client.synthetic.scenes import desk
from protocol.messages import Wishes
from server.scene.vase import vase_glb
from server.service.edge.authenticator import Authenticator, new_token
from server.service.serve import BackgroundServer, open_service

SOURCE = "synthetic:desk?frames="
FRAMES, FRAMES_TO_WATCH = 30, 300
"""Frames on the same path: one second for the saved pictures, ten seconds for watching."""


@dataclass(frozen=True)
class Demo:
    """Source, objects and wishes of the demo."""

    source: Source
    objects: tuple[ObjectFile, ...]
    wishes: Wishes


def run_demo(out: Path, device_name: str | None, keep: bool, port: int = 0) -> None:
    """Stream once and write `out`; with `keep`, continue to stream for the page until interrupted.

    Raises ServeError, ClientError or UserError, each with one line.
    """
    service, authenticator = open_service(device_name), Authenticator(new_token())
    with _prepared(FRAMES) as demo, BackgroundServer(service, port=port, authenticator=authenticator) as server:
        say(f"watch it at {server.way_in}")
        done = _stream(demo, server.way_in, out)
        say(f"{done.answered} frames in {done.seconds:.1f} s, pictures in {out / 'frames'}, open {out / PAGE_NAME}")
        if keep:
            say(f"still streaming to {server.way_in}; end with Ctrl-C")
            with _prepared(FRAMES_TO_WATCH) as endless:
                while True:
                    _stream(endless, server.way_in, None)


def _stream(demo: Demo, url: str, out: Path | None) -> StreamSummary:
    return stream(demo.source, url, demo.objects, demo.wishes, out, realtime=out is None, overwrite=True)


@contextmanager
def _prepared(frames: int) -> Iterator[Demo]:
    """The demo with a temporary file of the vase."""
    source = open_source(f"{SOURCE}{frames}")
    volume = default_volume(source, range(len(source)))
    wishes = Wishes(volume_m=volume, voxel_m=default_voxel(volume), up=source.up)
    with tempfile.TemporaryDirectory(prefix="probeless-") as folder:
        vase = Path(folder) / "vase.glb"
        vase.write_bytes(vase_glb())
        yield Demo(source, (ObjectFile(vase, desk.FREE_M),), wishes)

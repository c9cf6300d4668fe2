"""A source of frames that need no pipeline, and the streaming of it."""

import io
from pathlib import Path

from rich.console import Console

from client.commands import stream as streaming
from client.commands.stream import stream
from client.errors import SourceError
from protocol.frames import RgbdFrame
from tests.service.fakes import CAMERA, rgbd_frame


class FakeSource:
    """A source of noise; `depths_mm` gives some frames a first depth that the fake pipeline acts upon."""

    name, camera, has_poses, up = "fake", CAMERA, True, None

    def __init__(self, count: int, fps: float = 1000.0, depths_mm: dict[int, int] | None = None) -> None:
        self.count, self.fps, self.depths_mm = count, fps, depths_mm or {}

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> RgbdFrame:
        if self.depths_mm.get(index) == 0:
            raise SourceError(f"frame {index}: the picture is truncated")
        return rgbd_frame(index, self.depths_mm.get(index, 1000))


def quietly(*args: object, **options: object) -> streaming.StreamSummary:
    return stream(*args, console=Console(file=io.StringIO()), **options)


def files(folder: Path) -> dict[str, bytes]:
    """Every file below a folder by its relative name."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}

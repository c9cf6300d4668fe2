"""How old a frame is when its answer is shown, by stage, on loopback and over far and narrow links; what arrives."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import parse_qs, urlsplit

import numpy as np
from rich.console import Console

from client.commands.stream import Sending, StreamSummary, stream
from client.display.stream_statistics import STAGES
from client.objects.object_file import ObjectFile
from client.sources.frame_source import Source
from client.sources.volume import default_volume, default_voxel
from client.streaming.client import Access
from client.streaming.video import IS_POSSIBLE
from protocol.colors import ColorReader
from protocol.frames import RgbdFrame
from protocol.messages import Frame, Wishes
from protocol.recording import read_messages
from tests.bench.client.bandwidth import kitchen, psnr_db
from tests.bench.report.finished import Part
from tests.bench.report.run import Run, data_folder
from tests.bench.service.process import Served, serving
from tests.bench.speed.suite import OBJECT, OBJECT_SCALE, ON_TABLE_M
from tests.service.proxy import impaired

QUICK_FRAMES, FRAMES = 450, 1200
WARM_UP_FRAMES = 30
LOOKED_AT = 5
"""Every how many of the pictures that were sent are compared with the camera's."""
NAMES = {
    "encode": "captured to sent",
    "way": "on the way, both ways",
    "wait": "received to computing (unread, decoding, turn)",
    "compute": "computed",
    "show": "returned to shown",
    "whole": "captured to shown",
}


@dataclass(frozen=True)
class Link:
    """Between client and server."""

    delay_s: float = 0.0
    """Each way."""
    mbit_per_s: float | None = None
    """Each way; None: as much as loopback carries."""

    @contextlib.contextmanager
    def to(self, served: Served) -> Iterator[str]:
        """URL of the server at its far end."""
        if self.mbit_per_s is None:
            yield served.url
            return
        token = parse_qs(urlsplit(served.url).query)["token"][0]
        with impaired(served.bare_url, self.delay_s, self.mbit_per_s * 1e6 / 8) as proxy:
            yield f"{proxy.url}/?token={token}"


LINKS = {
    "loopback": Link(),
    "40 ms and 10 Mbit/s": Link(0.02, 10.0),
    "40 ms and 2 Mbit/s": Link(0.02, 2.0),
    "200 ms and 20 Mbit/s": Link(0.1, 20.0),
}
SENDINGS = {"adaptive": Sending(), "fixed": Sending(adapts=False)}
if IS_POSSIBLE:
    SENDINGS["adaptive, H.264"] = Sending(video=True)


class ThereAndBack:
    """A source played forwards and backwards for as long as is wanted: the camera never jumps."""

    def __init__(self, source: Source, count: int) -> None:
        self._source, self._count = source, count
        self.name, self.camera, self.fps = source.name, source.camera, source.fps
        self.has_poses, self.up = source.has_poses, source.up

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> RgbdFrame:
        last = len(self._source) - 1
        place = last - abs(index % (2 * last) - last)
        return replace(self._source[place], index=index, timestamp_s=index / self.fps)


def latency_part(name: str, run: Run, _out: Path) -> Part:
    """Of the kitchen at its own rate over the link of this name, one object, as `probeless stream` does by itself."""
    link, count = LINKS[name], run.of(QUICK_FRAMES, FRAMES)
    part = Part(sizes={f"frames of latency, {name}": count})
    with TemporaryDirectory() as folder, serving(Path(folder) / "log") as served, link.to(served) as url:
        _measure(url, WARM_UP_FRAMES, Sending())
        for kind, sending in SENDINGS.items():
            if link.mbit_per_s is None and kind != "adaptive":
                continue
            shown = name if link.mbit_per_s is None else f"{name}, {kind}"
            run.say(f"latency, {shown}: {count} frames")
            record = Path(folder) / "recording"
            summary = _measure(url, count, sending, None if link.mbit_per_s is None else record)
            _add(part, shown, summary)
            if link.mbit_per_s is not None:
                _add_pictures(part, shown, record)
    return part


def _measure(url: str, count: int, sending: Sending, record: Path | None = None) -> StreamSummary:
    source = kitchen()
    volume_m = default_volume(source, range(len(source)))
    thing = ObjectFile(data_folder(OBJECT), ON_TABLE_M, scale=OBJECT_SCALE)
    with TemporaryDirectory() as out:
        return stream(
            ThereAndBack(source, count),
            url,
            objects=(thing,),
            wishes=Wishes(volume_m=volume_m, voxel_m=default_voxel(volume_m), up=source.up),
            out=Path(out),
            record=record,
            access=Access(),
            sending=sending,
            console=Console(file=io.StringIO()),
        )


def _add(part: Part, link: str, summary: StreamSummary) -> None:
    part.add(f"{link}: answered", summary.answered / max(summary.seconds, 1e-9), "frames/s")
    part.add(f"{link}: first picture, from connecting", summary.first_picture_s, "s")
    for stage in STAGES:
        p50, p99 = summary.latency_ms.get(stage, (0.0, 0.0))
        part.add(f"{link}: {NAMES[stage]}, p50", p50, "ms")
        part.add(f"{link}: {NAMES[stage]}, p99", p99, "ms")


def _add_pictures(part: Part, link: str, record: Path) -> None:
    """What the server had to look at, against what the camera saw."""
    source = ThereAndBack(kitchen(), 1 << 30)
    colors, errors, sizes = ColorReader(source.camera), [], []
    for place, frame in enumerate(m for m in read_messages(record, print) if isinstance(m, Frame)):
        assert frame.color is not None
        assert frame.depth is not None
        sizes.append((len(frame.color.data), len(frame.depth.data)))
        sent = colors.decode(frame.color)
        if place % LOOKED_AT == 0:
            errors.append(psnr_db(sent, source[frame.frame].color))
    colour, depth = np.mean(sizes, axis=0) / 1e3
    part.add(f"{link}: colour as sent, PSNR", float(np.mean(errors)), "dB")
    part.add(f"{link}: colour of a frame", float(colour), "kB")
    part.add(f"{link}: depth of a frame", float(depth), "kB")

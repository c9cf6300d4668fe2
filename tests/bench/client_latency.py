"""How old a frame is when its answer is shown, by stage, on loopback and over a far and narrow link."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import parse_qs, urlsplit

import msgspec
from rich.console import Console

from client.client import Access
from client.laptop.source import Source, open_source
from client.laptop.stream import Sending, StreamSummary, stream
from client.laptop.stream_figures import STAGES
from protocol.frames import RgbdFrame
from server.evaluation.report import Row
from tests.bench.client_bandwidth import KITCHEN
from tests.bench.light_runs import wishes_for
from tests.bench.service_process import serving
from tests.service.proxy import impaired

DELAY_S, BYTES_PER_S = 0.02, 10e6 / 8
"""Each way: a round trip of 40 ms, 10 Mbit/s."""
NAMES = {
    "encode": "captured to sent",
    "way": "sent to received, waiting, and back",
    "compute": "computed",
    "show": "returned to shown",
    "whole": "captured to shown",
}


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


def latency_rows(count: int, say: Callable[[str], None]) -> list[Row]:
    """Of the kitchen at its own rate, `count` frames of it, GR15FAST."""
    rows: list[Row] = []
    with TemporaryDirectory() as folder, serving(Path(folder) / "log") as served:
        _measure(served.url, min(count, 30), Sending())  # compiles
        say(f"latency on loopback, {count} frames")
        rows += _rows("loopback", _measure(served.url, count, Sending()))
        for name, sending in {"adaptive": Sending(), "fixed": Sending(adapts=False)}.items():
            say(f"latency at 40 ms and 10 Mbit/s, {name}, {count} frames")
            with impaired(served.bare_url, DELAY_S, BYTES_PER_S) as link:
                url = f"{link.url}/?token={parse_qs(urlsplit(served.url).query)['token'][0]}"
                rows += _rows(f"40 ms and 10 Mbit/s, {name}", _measure(url, count, sending))
    return rows


def _measure(url: str, count: int, sending: Sending) -> StreamSummary:
    source = open_source(str(KITCHEN))
    wishes = msgspec.structs.replace(wishes_for(source, range(len(source))), preset="gr15fast")
    with TemporaryDirectory() as out:
        return stream(
            ThereAndBack(source, count),
            url,
            wishes=wishes,
            out=Path(out),
            access=Access(),
            sending=sending,
            console=Console(file=io.StringIO()),
        )


def _rows(link: str, summary: StreamSummary) -> list[Row]:
    rows = [Row(f"{link}: answered", summary.answered / max(summary.seconds, 1e-9), "frames/s", "")]
    for stage in STAGES:
        p50, p99 = summary.latency_ms.get(stage, (0.0, 0.0))
        rows.append(Row(f"{link}: {NAMES[stage]}, p50", p50, "ms", ""))
        rows.append(Row(f"{link}: {NAMES[stage]}, p99", p99, "ms", ""))
    return rows

"""Terminal view of `stream`: rates, latency by stage, light, plan; with `--view` the picture in half blocks.

There is no window, because the headless OpenCV is installed, which runs everywhere.
"""

from __future__ import annotations

from types import TracebackType

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress import Progress
from rich.style import Style
from rich.table import Table
from rich.text import Text

from client.display.light_words import light_line, unknown_lines
from client.display.stream_statistics import STAGES, StreamStatistics
from client.streaming.coding import Coding
from protocol.messages import Composite, Layer, Light

PICTURE_COLUMNS = 80
TABLE_ROWS = 14
REFRESH_HZ = 4
LABELS = {
    "encode": "captured to sent",
    "way": "there and back",
    "wait": "waited at the server",
    "compute": "computed by the server",
    "show": "returned to shown",
    "whole": "captured to shown",
}
REPORTED_BY_SERVER = ("wait", "compute")
"""A light alone does not report them; they are then part of `way`."""


class StreamView:
    """Redrawn a few times per second if the console is a terminal, else disabled. A context manager."""

    def __init__(self, console: Console, progress: Progress, statistics: StreamStatistics, with_picture: bool) -> None:
        self._progress, self._statistics = progress, statistics
        self._with_picture = with_picture
        self.codec = "JPEG"
        """Name of the colour codec."""
        self.is_on = console.is_terminal
        self._light: Light | None = None
        self._drawn: Composite | Layer | None = None
        self._picture: Text | None = None
        self._coding: Coding | None = None
        self._reconnected = 0
        self._now_s = 0.0
        self._live = Live(console=console, refresh_per_second=REFRESH_HZ, transient=True, get_renderable=self.render)

    @property
    def wants_pictures(self) -> bool:
        """Whether `show` needs the picture."""
        return self.is_on and self._with_picture

    def show(
        self,
        now_s: float,
        light: Light,
        drawn: Composite | Layer | None,
        picture: NDArray[np.uint8] | None,
        coding: Coding | None,
        reconnected: int,
    ) -> None:
        """Set the newest answer, drawn at the next refresh. `coding`: current coding of frames."""
        self._now_s, self._light, self._drawn = now_s, light, drawn
        self._coding, self._reconnected = coding, reconnected
        if picture is not None and self.wants_pictures:
            self._picture = half_blocks(picture, self._columns(picture))

    def render(self) -> RenderableType:
        """The whole view."""
        parts: list[RenderableType] = [self._progress.get_renderable()]
        if self._picture is not None:
            parts.append(self._picture)
        if self._light is not None:
            parts.append(self._table(self._light, self._drawn))
        return Group(*parts)

    def __enter__(self) -> StreamView:
        if self.is_on:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.stop()

    def _columns(self, picture: NDArray[np.uint8]) -> int:
        """Columns of the picture that leave room for the table below."""
        rows = max(self._live.console.height - TABLE_ROWS, 4)
        fitting: int = 2 * rows * picture.shape[1] // picture.shape[0]
        return max(min(PICTURE_COLUMNS, self._live.console.width, fitting), 8)

    def _table(self, light: Light, drawn: Composite | Layer | None) -> Table:
        table = Table.grid(padding=(0, 2))
        table.add_column(style="dim")
        sent, up, answered, down = self._statistics.rates(self._now_s)
        table.add_row("rate", f"{sent:.1f} sent, {answered:.1f} answered a second; {up:.1f} Mbit/s up, {down:.1f} down")
        for stage in STAGES:
            found = self._statistics.percentiles(stage)
            is_reported = drawn is not None or stage not in REPORTED_BY_SERVER
            if found is not None and is_reported:
                table.add_row(LABELS[stage], f"p50 {found[0]:.0f} ms, p99 {found[1]:.0f} ms")
        table.add_row("light", light_line(light))
        for line in unknown_lines(light):
            table.add_row("", line)
        if drawn is not None:
            table.add_row("plan", plan_line(drawn))
        if self._coding is not None:
            table.add_row("sent as", coding_line(self._coding, self.codec))
        table.add_row("connection", f"restored {self._reconnected} times" if self._reconnected else "held")
        return table


def plan_line(drawn: Composite | Layer) -> str:
    """Effects that ran and that were left out, and the operating point."""
    plan = drawn.plan
    left_out = f"; left out: {', '.join(item.effect for item in plan.left_out)}" if plan.left_out else ""
    point = f"; {plan.point.settings} ({plan.point.reason})" if plan.point is not None else ""
    return f"{', '.join(plan.run)}{left_out}{point}; camera {drawn.tracking}"


def coding_line(coding: Coding, codec: str = "JPEG") -> str:
    """Coding of frames in words."""
    size = f" at 1/{coding.divisor} of the size" if coding.divisor > 1 else ""
    noise_per_m = coding.depth_noise_per_m
    depth = "exact depth" if noise_per_m is None else f"depth to within {1e3 * noise_per_m:g} mm at 1 m"
    return f"{codec} of quality {coding.quality}{size}, {depth}"


def half_blocks(picture: NDArray[np.uint8], columns: int) -> Text:
    """[h, w, 3] sRGB -> lines of `columns` characters; each shows two pixels, as foreground and background colour."""
    height, width = picture.shape[:2]
    rows = max(round(columns * height / width / 2), 1)
    small = cv2.resize(picture, (columns, 2 * rows), interpolation=cv2.INTER_AREA)
    text = Text(no_wrap=True, end="\n")
    for upper, lower in zip(small[0::2].tolist(), small[1::2].tolist(), strict=True):
        for over, under in zip(upper, lower, strict=True):
            text.append("▀", Style(color=_color(over), bgcolor=_color(under)))
        text.append("\n")
    text.right_crop(1)
    return text


def _color(rgb: list[int]) -> str:
    return f"#{rgb[0]:02x}{rgb[1]:02x}{rgb[2]:02x}"

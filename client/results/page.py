"""`index.html` of an output folder: a page that shows a run and opens from disk.

The built page (client/web/src/results) has a place for the run's data, as a browser reads no other file for a page that
comes from disk. Pictures stay files beside it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from client.results.description import RunDescription
from client.results.frame_output import FrameOutput
from client.results.frame_rows import FrameRows
from client.results.names import PAGE_NAME
from client.results.point_cloud import ColoredPoints, PointCloud
from protocol.messages import Light, Vector3

PAGE = Path(__file__).parents[1] / "web" / "dist" / "results.html"
_DATA = "<!--data-->"
"""Where the data goes in the built page."""


class ResultsPage:
    """Gathers what the page shows while frames arrive, and writes it."""

    def __init__(self, description: RunDescription) -> None:
        self._description = description
        self._rows = FrameRows()
        self._cloud = PointCloud(description.camera)
        self._up: Vector3 | None = None
        self._first_pose: list[float] | None = None
        self.device = ""
        """Name of the OpenCL device, where it is known."""

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._rows)

    def add(self, output: FrameOutput, has_camera_picture: bool) -> None:
        """Add a frame; `has_camera_picture`: its camera's own picture was written."""
        self._rows.add(output, has_camera_picture)
        if self._first_pose is None:
            self._first_pose = output.world_from_camera[:3].ravel().tolist()
        self._up = output.light.up or self._up
        if output.captured is not None and output.tracking != "lost":
            self._cloud.add(output.captured, output.world_from_camera)

    def scan(self) -> ColoredPoints | None:
        """The scan so far; None: no depth was seen."""
        return self._cloud.points()

    def add_light(self, light: Light) -> None:
        """Add a frame without a picture."""
        self._rows.add_light(light)
        self._up = light.up or self._up

    def write(self, folder: Path, ended: str, video: str | None = None) -> None:
        """Write the page; `ended`: "" or why the run ended early; `video`: name of its file. Raises OSError."""
        before, _, after = PAGE.read_text("utf-8").partition(_DATA)
        with (folder / PAGE_NAME).open("w", encoding="utf-8", newline="\n") as file:
            file.write(before)
            for part in self._data(ended, video):
                file.write(part.replace("<", "\\u003c"))  # nothing ends the page's script
            file.write(after)

    def _data(self, ended: str, video: str | None) -> Iterator[str]:
        """JSON text in parts: a long run's is large."""
        head = json.dumps(self._head(ended, video), allow_nan=False, separators=(",", ":"))
        yield head[:-1] + ',"frames":['
        for number, row in enumerate(self._rows.json()):
            yield f",\n{row}" if number else row
        yield "]}"

    def _head(self, ended: str, video: str | None) -> dict[str, Any]:
        said, scan = self._description, self.scan()
        camera = {name: getattr(said.camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        return {
            "source": said.source,
            "device": self.device,
            "fps": said.fps,
            "total": said.total,
            "ended": ended,
            "objects": said.objects,
            "video": video,
            "camera": camera,
            "up": self._up_direction(),
            "tables": self._rows.tables(),
            "scan": None if scan is None else scan.packed(),
        }

    def _up_direction(self) -> list[float]:
        """World, unit; as everywhere, the first camera's -y where nothing tells it."""
        if self._up is not None:
            return list(self._up)
        if self._first_pose is None:
            return [0.0, -1.0, 0.0]
        down: list[float] = (-np.array(self._first_pose).reshape(3, 4)[:, 1]).tolist()
        return down

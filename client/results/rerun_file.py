"""`--rerun FILE.rrd`: frames, depth, poses, light, timings and the scan on one time line, for the rerun viewer."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from client.errors import OutputError
from client.results.description import RunDescription
from client.results.frame_output import FrameOutput
from client.results.frame_rows import STAGES
from client.results.point_cloud import ColoredPoints
from protocol.messages import ArrivingLight, Light, MeshFormat

QUALITY = 90
"""Of JPEG; raw pictures would make files of a megabyte a frame."""
ARROW_M = 0.2
"""Length of an arrow towards the dominant light."""
AMBER = (255, 180, 84)


class RerunFile:
    """Writes one recording while frames arrive. Entities are in world axes, metres, below `world`."""

    def __init__(self, path: Path, description: RunDescription) -> None:
        """Raises OutputError if the file cannot be written."""
        import rerun

        self._rr, self._said = rerun, description
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.open("wb").close()
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror}); name another with --rerun") from error
        self._stream: Any = rerun.RecordingStream("probeless")
        self._stream.save(str(path))
        self._stream.send_recording_name(description.source)

    def add(self, output: FrameOutput) -> None:
        """Add a frame."""
        self._at(output.frame, output.timestamp_s)
        self._add_camera(output)
        self._add_light(output.light)
        log, scalars = self._stream.log, self._rr.Scalars
        for stage in (*STAGES, "total"):
            log(f"time_ms/{stage}", scalars(getattr(output.timings, stage)))
        left_out = "\n".join(f"- **{each.effect}**: {each.reason}" for each in output.plan.left_out)
        text = f"Ran: {', '.join(output.plan.run)}\n\nLeft out:\n{left_out}"
        log("plan", self._rr.TextDocument(text, media_type="text/markdown"))
        log("tracking", self._rr.TextLog(output.tracking))
        for note in output.notes:
            log("notes", self._rr.TextLog(note))

    def add_light(self, light: Light) -> None:
        """Add a frame of which only the light is known."""
        self._at(light.frame, light.timestamp_s)
        self._add_light(light)

    def add_mesh(self, files: Mapping[MeshFormat, bytes]) -> None:
        """Add the scene's mesh, for all times."""
        import trimesh

        mesh: Any = trimesh.load(io.BytesIO(files["ply"]), file_type="ply", process=False)
        colors = np.asarray(mesh.visual.vertex_colors)[:, :3]
        shown = self._rr.Mesh3D(vertex_positions=mesh.vertices, triangle_indices=mesh.faces, vertex_colors=colors)
        self._stream.log("world/mesh", shown, static=True)

    def close(self, scan: ColoredPoints | None) -> None:
        """Add the scan, for all times, and finish the file."""
        if scan is not None:
            points = self._rr.Points3D(scan.places_m, colors=scan.colors, radii=scan.cell_m / 2)
            self._stream.log("world/scan", points, static=True)
        self._stream.flush()
        self._stream.disconnect()

    def _at(self, frame: int, timestamp_s: float) -> None:
        self._stream.set_time("frame", sequence=frame)
        self._stream.set_time("time", duration=timestamp_s)

    def _add_camera(self, output: FrameOutput) -> None:
        rr, log, camera = self._rr, self._stream.log, self._said.camera
        pose = output.world_from_camera
        log("world/camera", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        matrix = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
        lens = rr.Pinhole(image_from_camera=matrix, width=camera.width, height=camera.height)
        log("world/camera/composite", lens, rr.Image(output.color).compress(jpeg_quality=QUALITY))
        if output.captured is None:
            return
        log("world/camera/captured", lens, rr.Image(output.captured.color).compress(jpeg_quality=QUALITY))
        if output.captured.depth is not None and camera.depth is None:
            log("world/camera/depth", lens, rr.DepthImage(output.captured.depth, meter=1 / camera.depth_scale_m))

    def _add_light(self, light: Light) -> None:
        """Numbers of each light, and an arrow from its place towards where most of it comes from."""
        self._add_place("beyond", light)
        for arriving in light.at:
            self._add_place(f"{arriving.of}_{arriving.index}", arriving)

    def _add_place(self, name: str, light: Light | ArrivingLight) -> None:
        rr, log = self._rr, self._stream.log
        log(f"light/{name}/intensity", rr.Scalars(light.dominant_intensity))
        if light.spread_deg is not None:
            log(f"light/{name}/spread_deg", rr.Scalars(light.spread_deg))
        log(f"light/{name}/sh", rr.Tensor(np.array(light.sh, np.float32), dim_names=("coefficient", "rgb")))
        if light.position is not None and name != "beyond":
            vector = ARROW_M * np.array(light.dominant_direction)
            arrow = rr.Arrows3D(origins=[light.position], vectors=[vector], colors=[AMBER])
            log(f"world/light/{name}", arrow)

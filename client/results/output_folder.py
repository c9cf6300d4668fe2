"""Output folder of `run` and `stream`: pictures, lights, trajectory, timings, the scene's mesh, and a page of it all.

Equal inputs give equal bytes: PNG parameters and JSON separators are fixed, floats are the shortest of Python.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from client.errors import OWN_PACKAGES, OutputError
from client.objects.object_file import as_asked
from client.results.camera_pictures import encode_camera_picture
from client.results.description import RunDescription
from client.results.frame_output import FrameOutput
from client.results.names import ENVIRONMENT_NAME, PAGE_NAME, SCENE_NAME, VIDEO_NAME
from client.results.page import ResultsPage
from client.results.rerun_file import RerunFile
from client.results.video_file import VideoFile
from client.sources.poses import quaternion
from protocol.messages import ArrivingLight, Light, MeshFormat

_PNG = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG)
"""One filter and runs alone: two fifths of the time of zlib's level 3 with a filter for each row. Paeth's filter takes
a quarter longer, and 8 % less bytes."""
_LINE_FILES = ("light.jsonl", "trajectory.txt", "timings.jsonl")
_WHOLE_FILES = ("mesh.ply", "mesh.glb", SCENE_NAME, ENVIRONMENT_NAME, PAGE_NAME, VIDEO_NAME)
_PICTURES = {"frames": re.compile(r"\d{6,}\.png"), "camera": re.compile(r"\d{6,}\.jpg")}
"""Folder -> names of the pictures in it that are ours."""


class OutputWriter:
    """Writes frames as they arrive; a context manager, whose end writes the page of what there is by then."""

    def __init__(
        self,
        folder: Path,
        page: RunDescription | None = None,
        *,
        overwrite: bool = False,
        video: bool = False,
        rerun: Path | None = None,
    ) -> None:
        """`page`: what the page says of the run; None: no page. `overwrite`: remove the files of an earlier run.
        `video`: write video.mp4, which needs PyAV. `rerun`: write this recording, which needs rerun-sdk and `page`.

        Raises OutputError if the folder cannot be written, or holds an earlier run that may not be overwritten.
        """
        self.folder = folder
        self._page = None if page is None else ResultsPage(page)
        self._video = VideoFile(folder / VIDEO_NAME, 0.0 if page is None else page.fps) if video else None
        try:
            if not overwrite:
                _refuse_earlier_run(folder)
            (folder / "frames").mkdir(parents=True, exist_ok=True)
            _remove_earlier_run(folder)
            self._rerun = None if rerun is None or page is None else RerunFile(rerun, page)
            self._files = {name: (folder / name).open("w", encoding="utf-8", newline="\n") for name in _LINE_FILES}
        except OSError as error:
            raise _unwritable(folder, error) from error

    def note_device(self, name: str) -> None:
        """Name of the OpenCL device, for the page."""
        if self._page is not None:
            self._page.device = name

    def write(self, output: FrameOutput) -> None:
        """Write one frame. Raises OutputError if the disk refuses or a number is not finite."""
        output = replace(output, light=as_asked(output.light))
        try:
            picture = self.folder / "frames" / f"{output.frame:06d}.png"
            picture.write_bytes(encode_png(output.color))
            self._line("light.jsonl", _json(light_row(output.light), output.frame))
            self._line("trajectory.txt", trajectory_row(output.timestamp_s, output.world_from_camera))
            self._line("timings.jsonl", _json(timings_row(output), output.frame))
            if self._page is not None:
                self._page.add(output, self._write_camera_picture(output))
        except OSError as error:
            raise _unwritable(self.folder, error) from error
        if self._video is not None:
            self._video.add(output.color, output.timestamp_s)
        if self._rerun is not None:
            self._rerun.add(output)

    def _write_camera_picture(self, output: FrameOutput) -> bool:
        """Write the camera's own picture where the composite is another one."""
        if output.captured is None or np.array_equal(output.captured.color, output.color):
            return False
        folder = self.folder / "camera"
        folder.mkdir(exist_ok=True)
        (folder / f"{output.frame:06d}.jpg").write_bytes(encode_camera_picture(output.captured.color))
        return True

    def write_light(self, light: Light) -> None:
        """Write the light of a frame without a picture. Raises OutputError."""
        light = as_asked(light)
        try:
            self._line("light.jsonl", _json(light_row(light), light.frame))
        except OSError as error:
            raise _unwritable(self.folder, error) from error
        if self._page is not None:
            self._page.add_light(light)
        if self._rerun is not None:
            self._rerun.add_light(light)

    def write_mesh(self, files: Mapping[MeshFormat, bytes]) -> None:
        """Write mesh.ply and mesh.glb. Raises OutputError."""
        if self._rerun is not None:
            self._rerun.add_mesh(files)
        try:
            for format_, data in files.items():
                (self.folder / f"mesh.{format_}").write_bytes(data)
        except OSError as error:
            raise _unwritable(self.folder, error) from error

    def write_scene(self, files: Mapping[str, bytes]) -> None:
        """Write scene.glb and scene.hdr. Raises OutputError."""
        try:
            for name, data in files.items():
                (self.folder / name).write_bytes(data)
        except OSError as error:
            raise _unwritable(self.folder, error) from error

    def close(self, ended: str = "") -> None:
        """Write the page, if there is a frame, and close all files; `ended`: "" or why the run ended early.

        Raises OutputError.
        """
        for file in self._files.values():
            file.close()
        if self._rerun is not None and self._page is not None:
            self._rerun.close(self._page.scan())
        has_video = self._video is not None and self._video.close()
        if self._page is not None and len(self._page):
            try:
                self._page.write(self.folder, ended, VIDEO_NAME if has_video else None)
            except OSError as error:
                raise _unwritable(self.folder, error) from error

    def _line(self, name: str, text: str) -> None:
        file: TextIO = self._files[name]
        file.write(text + "\n")
        file.flush()  # an interrupted run leaves whole lines

    def __enter__(self) -> OutputWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close(_why(error))
        except OutputError:
            if error is None:  # or the error before it is the one to tell
                raise


def encode_png(color: NDArray[np.uint8]) -> bytes:
    """PNG bytes of [height, width, 3] RGB; deterministic."""
    done, data = cv2.imencode(".png", cv2.cvtColor(color, cv2.COLOR_RGB2BGR), _PNG)
    if not done:
        raise OutputError(f"a picture of shape {color.shape} could not be encoded as PNG")
    return data.tobytes()


def light_row(light: Light) -> dict[str, Any]:
    """A line of light.jsonl; `sh_all` only with more than 16 coefficients."""
    row = {
        "frame": light.frame,
        "timestamp_s": light.timestamp_s,
        "sh": light.sh,
        "sh_all": light.sh_all,
        "sh_std": light.sh_std,
        "sh_webxr": light.sh_webxr,
        "dominant_direction": light.dominant_direction,
        "dominant_intensity": light.dominant_intensity,
        "dominant_lights": msgspec.to_builtins(light.dominant_lights),
        "lamps": msgspec.to_builtins(light.lamps),
        "exposure": light.exposure,
        "condition": light.condition,
        "valid": light.valid,
        "spread_deg": light.spread_deg,
        "position": light.position,
        "at": [arriving_row(arriving) for arriving in light.at],
    }
    if light.sh_all is None:
        del row["sh_all"]
    return row


def arriving_row(arriving: ArrivingLight) -> dict[str, Any]:
    """An entry of `at`. Names of objects are of the session, not of the source, and are left out."""
    row: dict[str, Any] = msgspec.structs.asdict(arriving)
    del row["object"]
    return row


def trajectory_row(timestamp_s: float, world_from_camera: NDArray[np.float64]) -> str:
    """A line `timestamp tx ty tz qx qy qz qw`. Raises OutputError if a number is not finite."""
    numbers = np.array([*world_from_camera[:3, 3], *quaternion(world_from_camera[:3, :3])])
    if not np.isfinite(numbers).all():
        raise OutputError("a pose has NaN or infinity and was not written")
    return f"{timestamp_s:.6f} " + " ".join(f"{x:.9f}" for x in numbers.round(9) + 0.0)  # + 0.0: no "-0"


def timings_row(output: FrameOutput) -> dict[str, Any]:
    """A line of timings.jsonl: times in milliseconds, tracking, plan, and notes if any."""
    row = {
        "frame": output.frame,
        **msgspec.structs.asdict(output.timings),
        "tracking": output.tracking,
        "plan": msgspec.to_builtins(output.plan),
    }
    if output.notes:
        row["notes"] = list(output.notes)
    return row


def _json(row: dict[str, Any], frame: int) -> str:
    try:
        return json.dumps(row, allow_nan=False, separators=(", ", ": "))
    except ValueError as error:
        raise OutputError(f"frame {frame}: a number is NaN or infinite and was not written") from error


def _why(error: BaseException | None) -> str:
    """Why a run ended early, in one line; "" if it did not."""
    if error is None:
        return ""
    if type(error).__module__.split(".")[0] in OWN_PACKAGES:
        return " ".join(str(error).split())
    return "interrupted" if isinstance(error, KeyboardInterrupt) else "stopped by an error"


def _refuse_earlier_run(folder: Path) -> None:
    """Raises OutputError if the folder holds the results of a run; what was begun and has no frame is none."""
    if any((folder / name).is_file() and (folder / name).stat().st_size > 0 for name in _LINE_FILES):
        raise OutputError(
            f"{folder}: holds an earlier run; name another folder with --out, or replace what is in it with --overwrite"
        )


def _remove_earlier_run(folder: Path) -> None:
    """Remove files of an earlier, perhaps longer run, which could be mistaken for new ones."""
    if not (folder / "light.jsonl").is_file():
        return
    for name in _WHOLE_FILES:
        (folder / name).unlink(missing_ok=True)
    for where, names in _PICTURES.items():
        for picture in (folder / where).iterdir() if (folder / where).is_dir() else ():
            if names.fullmatch(picture.name):
                picture.unlink()


def _unwritable(folder: Path, error: OSError) -> OutputError:
    return OutputError(f"{folder}: cannot be written ({error.strerror}); name another folder with --out")

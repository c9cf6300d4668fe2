"""Output folder of `run` and `stream`: pictures, lights, trajectory, timings and the scene's mesh.

Equal inputs give equal bytes: PNG parameters and JSON separators are fixed, floats are the shortest of Python.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from client.errors import OutputError
from client.sources.poses import quaternion
from protocol.messages import ArrivingLight, Light, MeshFormat, Plan, Timings

_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 3, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_DEFAULT)
_LINE_FILES = ("light.jsonl", "trajectory.txt", "timings.jsonl")
_MESH_FILES = ("mesh.ply", "mesh.glb")
_OWN_PICTURE = re.compile(r"\d{6,}\.png")


@dataclass(frozen=True)
class FrameOutput:
    """Results of one frame."""

    frame: int
    """Position in the source; names the picture."""
    timestamp_s: float
    color: NDArray[np.uint8]
    """[height, width, 3] composite, 8-bit sRGB."""
    light: Light
    world_from_camera: NDArray[np.float64]
    """[4, 4] metres."""
    tracking: str
    """given, tracked or lost."""
    timings: Timings
    plan: Plan
    notes: tuple[str, ...] = ()


class OutputWriter:
    """Writes frames as they arrive; a context manager. Results of an earlier run in the folder are replaced."""

    def __init__(self, folder: Path) -> None:
        """Raises OutputError if the folder cannot be written."""
        self.folder = folder
        try:
            (folder / "frames").mkdir(parents=True, exist_ok=True)
            _remove_earlier_run(folder)
            self._files = {name: (folder / name).open("w", encoding="utf-8", newline="\n") for name in _LINE_FILES}
        except OSError as error:
            raise _unwritable(folder, error) from error

    def write(self, output: FrameOutput) -> None:
        """Write one frame. Raises OutputError if the disk refuses or a number is not finite."""
        try:
            picture = self.folder / "frames" / f"{output.frame:06d}.png"
            picture.write_bytes(encode_png(output.color))
            self._line("light.jsonl", _json(light_row(output.light), output.frame))
            self._line("trajectory.txt", trajectory_row(output.timestamp_s, output.world_from_camera))
            self._line("timings.jsonl", _json(timings_row(output), output.frame))
        except OSError as error:
            raise _unwritable(self.folder, error) from error

    def write_light(self, light: Light) -> None:
        """Write the light of a frame without a picture. Raises OutputError."""
        try:
            self._line("light.jsonl", _json(light_row(light), light.frame))
        except OSError as error:
            raise _unwritable(self.folder, error) from error

    def write_mesh(self, files: Mapping[MeshFormat, bytes]) -> None:
        """Write mesh.ply and mesh.glb. Raises OutputError."""
        try:
            for format_, data in files.items():
                (self.folder / f"mesh.{format_}").write_bytes(data)
        except OSError as error:
            raise _unwritable(self.folder, error) from error

    def close(self) -> None:
        for file in self._files.values():
            file.close()

    def _line(self, name: str, text: str) -> None:
        file: TextIO = self._files[name]
        file.write(text + "\n")
        file.flush()  # an interrupted run leaves whole lines

    def __enter__(self) -> OutputWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


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


def _remove_earlier_run(folder: Path) -> None:
    """Remove pictures and meshes of an earlier, perhaps longer run, which could be mistaken for new ones."""
    if not (folder / "light.jsonl").is_file():
        return
    for name in _MESH_FILES:
        (folder / name).unlink(missing_ok=True)
    for picture in (folder / "frames").iterdir():
        if _OWN_PICTURE.fullmatch(picture.name):
            picture.unlink()


def _unwritable(folder: Path, error: OSError) -> OutputError:
    return OutputError(f"{folder}: cannot be written ({error.strerror}); name another folder with --out")

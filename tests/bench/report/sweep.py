"""Runs many measurements, one line of JSON each as it is done: a sweep that was stopped goes on where it was.

One after the other in this process; or over the machines of a Ray cluster, an extra (`pip install ray`), one at a time
on each, so that none disturbs another's times.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, get_args

import msgspec
from msgspec import Struct

from server.opencl.device import Device, open_device
from tests.bench.accuracy.points import MeasuredPoint, measure_point
from tests.bench.accuracy.scenes import SweptScene, scene_named

Engine = Literal["serial", "ray"]
ENGINES = get_args(Engine)


class Task(Struct, frozen=True, kw_only=True):
    """One point on one scene."""

    scene: str
    knob: str
    settings: dict[str, Any]
    frames: int
    quick: bool
    device: str | None = None
    """Part of its name, as for --device."""

    @property
    def identity(self) -> str:
        """Equal tasks have equal ones."""
        return msgspec.json.encode(self, order="deterministic").decode()


class SweepError(ValueError):
    """The engine that was asked for cannot be used; one line that says what to do."""


def run_sweep(
    tasks: Sequence[Task], path: Path, key: str, say: Callable[[str], None], engine: Engine = "serial"
) -> list[MeasuredPoint]:
    """Every task's point, in their order. Lines of `path` that have the same key are taken, others measured.

    key: of the code, the device and whatever else makes figures comparable. Raises SweepError.
    """
    done = _read(path, key)
    missing = [task for task in tasks if task.identity not in done]
    if len(missing) < len(tasks):
        say(f"{len(tasks) - len(missing)} of {len(tasks)} points were measured before, taken from {path}")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as lines:
        measured = _serially(missing) if engine == "serial" else _on_ray(missing)
        for number, (task, point) in enumerate(measured, len(tasks) - len(missing) + 1):
            done[task.identity] = point
            line = {"key": key, "task": task.identity, "point": msgspec.to_builtins(point)}
            lines.write(json.dumps(line, allow_nan=False) + "\n")
            lines.flush()
            say(f"{number}/{len(tasks)} {task.scene}: {point.words}")
    return [done[task.identity] for task in tasks]


def _read(path: Path, key: str) -> dict[str, MeasuredPoint]:
    """Points by their tasks; a last line that was cut off is none."""
    found: dict[str, MeasuredPoint] = {}
    if not path.exists():
        return found
    for text in path.read_text(encoding="utf-8").splitlines():
        try:
            line = json.loads(text)
        except ValueError:
            continue
        if line["key"] == key:
            found[line["task"]] = msgspec.convert(line["point"], MeasuredPoint)
    return found


def measure(task: Task) -> MeasuredPoint:
    """Raises ValueError for settings that a session cannot have, UnmeasurableError for a scene that is not here."""
    device, scene = _opened(task.device, task.scene, task.quick)
    return measure_point(device, scene, task.knob, task.settings, task.frames)


@lru_cache(maxsize=1)
def _opened(device_name: str | None, scene: str, quick: bool) -> tuple[Device, SweptScene]:
    device = open_device(device_name)
    return device, scene_named(scene, device, quick)


def _serially(tasks: Sequence[Task]) -> Iterator[tuple[Task, MeasuredPoint]]:
    for task in tasks:
        yield task, measure(task)


def _on_ray(tasks: Sequence[Task]) -> Iterator[tuple[Task, MeasuredPoint]]:
    """As they are finished. A worker takes a whole machine: the least number of processors that any of them has."""
    try:
        import ray
    except ImportError as error:
        raise SweepError("--engine ray: Ray is not installed: pip install ray, or leave --engine out") from error
    if not ray.is_initialized():
        ray.init(log_to_driver=False)
    cores = min(node["Resources"].get("CPU", 1.0) for node in ray.nodes() if node["Alive"])
    remote = ray.remote(num_cpus=cores, max_calls=0)(measure)
    waiting = {remote.remote(task): task for task in tasks}
    while waiting:
        [ready], _ = ray.wait(list(waiting), num_returns=1)
        yield waiting.pop(ready), ray.get(ready)

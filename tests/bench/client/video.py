"""Colour as H.264 against colour as JPEG: bytes at the same error, the light found with them, time to encode."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray

from client.options.source import open_source
from client.sources.frame_source import Source
from client.streaming.coding import Coding, frame_message
from client.streaming.video import IS_POSSIBLE, VideoEncoder
from protocol.colors import ColorReader
from protocol.frames import RgbdFrame
from tests.bench.client.bandwidth import FPS, add_light, kitchen, psnr_db, run_pipeline
from tests.bench.report.finished import Part, UnmeasurableError
from tests.bench.report.run import Run

QUICK_FRAMES, FRAMES = {"colour": 12, "light": 26}, {"colour": 24, "light": 60}
SOURCES: dict[str, Callable[[], Source]] = {
    "kitchen": kitchen,
    "synthetic room": lambda: open_source("synthetic:room?frames=160&noise=1"),
}
RATES = (30.0, 15.0, 7.5)
"""At which frames are sent: the camera moves further between two of them where they are fewer."""
CODINGS = {"full size, quality 90": Coding(90), "full size, 75": Coding(75), "half size, 75": Coding(75, 2)}


@dataclass(frozen=True)
class Coded:
    """A sequence, sent."""

    colors: list[NDArray[np.uint8]]
    """As they are read at the other end."""
    kbit: float
    """Of a frame's colour; the first one, which is a key picture, left out."""
    psnr_db: float
    encode_ms: float
    """Median."""


def coded(frames: Iterable[RgbdFrame], source: Source, coding: Coding, video: VideoEncoder | None) -> Coded:
    """Over the wire, frame by frame."""
    reader = ColorReader(source.camera)
    colors, sizes, errors, times_ms = [], [], [], []
    for frame in frames:
        blind = replace(frame, depth=np.zeros((8, 8), np.uint16))
        began_s = time.perf_counter()
        message = frame_message(blind, source.camera, coding=coding, video=video)
        times_ms.append((time.perf_counter() - began_s) * 1e3)
        assert message.color is not None
        colors.append(np.asarray(reader.decode(message.color), np.uint8))
        sizes.append(len(message.color.data))
        errors.append(psnr_db(colors[-1], frame.color))
    return Coded(colors, float(np.mean(sizes[1:])) * 8e-3, float(np.mean(errors)), median(times_ms))


def video_part(run: Run, _out: Path) -> Part:
    """Both ways of sending the same frames."""
    if not IS_POSSIBLE:
        raise UnmeasurableError("PyAV is not installed (make install-video)")
    part = Part()
    for name, opened in SOURCES.items():
        source = opened()
        for rate in RATES:
            run.say(f"colour of {name} at {rate:g} frames a second")
            _add_sizes(part, run, f"{name}, {rate:g}/s", source, rate)
    _add_light(part, run)
    return part


def _add_sizes(part: Part, run: Run, name: str, source: Source, rate: float) -> None:
    step = max(round(30.0 / rate), 1)
    count = run.of(QUICK_FRAMES["colour"], FRAMES["colour"])
    frames = [source[place] for place in range(0, len(source), step)][:count]
    part.sizes["frames of colour, at most"] = count
    for kind, coding in CODINGS.items():
        jpeg, video = coded(frames, source, coding, None), coded(frames, source, coding, VideoEncoder())
        part.add(f"{name}, {kind}: JPEG", jpeg.kbit * FPS / 1e3, "Mbit/s")
        part.add(f"{name}, {kind}: H.264", video.kbit * FPS / 1e3, "Mbit/s")
        part.add(f"{name}, {kind}: JPEG, PSNR", jpeg.psnr_db, "dB")
        part.add(f"{name}, {kind}: H.264, PSNR", video.psnr_db, "dB")
        part.add(f"{name}, {kind}: JPEG, to encode", jpeg.encode_ms, "ms")
        part.add(f"{name}, {kind}: H.264, to encode", video.encode_ms, "ms")


def _add_light(part: Part, run: Run) -> None:
    """What it does to the light, against that of the frames themselves."""
    source, count = kitchen(), run.of(QUICK_FRAMES["light"], FRAMES["light"])
    part.sizes["frames of light from coded colour"] = count
    frames = list(islice((source[place] for place in range(0, len(source), 2)), count))
    truth = run_pipeline(run.device, frames)
    for kind, coding in CODINGS.items():
        for codec, video in {"JPEG": None, "H.264": VideoEncoder()}.items():
            run.say(f"light from {kind}, {codec}")
            colors = coded(frames, source, coding, video).colors
            sent = [replace(frame, color=color) for frame, color in zip(frames, colors, strict=True)]
            add_light(part, f"light from {kind}, {codec}", run_pipeline(run.device, sent), truth)


if __name__ == "__main__":
    import sys

    from server.opencl.device import open_device

    run = Run(open_device(None), "--quick" in sys.argv, lambda line: print(line, file=sys.stderr))
    for row in video_part(run, Path()).rows:
        print(f"{row.name:60} {row.value:8.3f} {row.unit}")

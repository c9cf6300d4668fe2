"""Change detection: whether a frame differs from the frames before it by more than sensor noise.

The noise is measured on the frames themselves. For each tile of 8 x 8 pixels it is the mean square difference from the
mean of the frames before. A frame has changed where a tile differs by more than noise does by chance (the edge of a
hand), or where the mean of a block of 4 x 4 tiles does (a lamp that goes out). Smaller changes are not detected: less
than HIDDEN_MEAN_CODES in the mean of the picture, less than HIDDEN_CODES plus six deviations in the mean of a block.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from server.maths.registration import angle_between, distance_between
from server.opencl.engine import Engine
from server.reuse.frame_difference import Differences, MeanPicture

Floats = NDArray[np.float64]

MOST_NOISE_CODES, MOST_NOISE_M = 12.0, 0.1
"""Standard deviations that no camera noise exceeds: a larger difference is another picture."""
ODD_MEDIAN = 1.5
"""Times its usual value that the energy of the median tile may have. Slow motion of the whole picture grows beyond."""
DEVIATIONS = 6.0
"""Standard deviations by which the energy of a tile, or the mean of a block, may be off by chance."""
BLOCK = 4
"""Tiles along a side of a block. Shadows are larger than a tile, and a mean of more pixels has less noise."""
TOGETHER, TOGETHER_DEPTH = 4.0, 16.0
"""Values whose errors are correlated, by JPEG and by stereo: the mean of n has the noise of n over this."""
HIDDEN_CODES, HIDDEN_MEAN_CODES = 0.5, 0.25
"""Codes of 255 that are tolerated besides: rounding, and the flicker of lamps."""
MOST_FLIPS = 6.0
"""Depth values of a tile that may appear or vanish, beyond twice the most so far."""
FIRST = 2
"""Frames until the noise is known. Until then any camera noise is accepted."""
PARALLAX_PX = 0.05
"""Pixels that the picture may move by, where the client gives the pose."""
NEAREST_M = 0.3
"""Nearest surface, for the parallax: sensors do not measure nearer."""


@dataclass
class _Noise:
    """Noise statistics of each tile, of colour or of depth."""

    energy: Floats
    """Sum over frames of the mean square, as if one frame had been compared with an endless mean."""
    flips: Floats
    frames: int = 0

    @property
    def usual(self) -> Floats:
        """Mean square noise, at least a quarter of the median: a clipped tile shows less than it has."""
        own = self.energy / max(self.frames, 1)
        return np.maximum(own, 0.25 * float(np.median(own)))


class ChangeDetection:
    """Of one camera. Call `look` for each frame; `count` is the number of unchanged frames."""

    def __init__(self, engine: Engine, camera: CameraModel, *, poses_are_given: bool) -> None:
        self._camera = camera
        self._unit = 257.0 if camera.color_encoding == "linear16" else 1.0
        self._poses_are_given = poses_are_given
        self._color, self._depth = MeanPicture(engine), MeanPicture(engine)
        self._noise: tuple[_Noise, _Noise] | None = None
        self._first: RgbdFrame | None = None
        self.count = 0
        self.is_exact = True
        """Whether all frames were equal byte for byte."""

    def forget(self) -> None:
        """Start again with the next frame."""
        self._first, self._noise, self.count, self.is_exact = None, None, 0, True
        self._color.forget()
        self._depth.forget()

    def look(self, frame: RgbdFrame, *, learn: bool) -> bool:
        """Whether the frame is unchanged; if not, detection restarts with it. learn: update the noise statistics."""
        if self._first is not None and self._is_placed_alike(self._first, frame):
            if self.count == 1:  # a moving camera needs no upload
                self._add(self._first)
            color, depth = self._color.upload(frame.color), self._depth.upload(frame.depth)
            parts = (self._color.compare(color), self._depth.compare(depth))
            is_alike, usual = self._judge(parts)
            if is_alike:
                self.count += 1
                self.is_exact = self.is_exact and not any(p.mean_square.any() or p.flipped.any() for p in parts)
                if learn:
                    self._noise = usual
                    self._color.add(color)
                    self._depth.add(depth)
                return True
        self.forget()
        self._first, self.count = frame, 1
        return False

    def _add(self, frame: RgbdFrame) -> None:
        self._color.add(self._color.upload(frame.color))
        self._depth.add(self._depth.upload(frame.depth))

    def _is_placed_alike(self, first: RgbdFrame, frame: RgbdFrame) -> bool:
        if first.exposure != frame.exposure:
            return False
        if not self._poses_are_given or first.world_from_camera is None or frame.world_from_camera is None:
            return True
        return parallax_px(self._camera, first.world_from_camera, frame.world_from_camera) <= PARALLAX_PX

    def _judge(self, parts: tuple[Differences, Differences]) -> tuple[bool, tuple[_Noise, _Noise]]:
        """Whether the difference is noise, and the statistics with it."""
        before = self._color.frames
        known = self._noise or tuple(_Noise(np.zeros(len(p.count)), np.zeros(len(p.count))) for p in parts)
        most = (MOST_NOISE_CODES * self._unit, MOST_NOISE_M / self._camera.depth_scale_m)
        hidden = (HIDDEN_CODES * self._unit, 1.0)
        is_alike, learnt = True, []
        for part, noise, limit, floor, together in zip(
            parts, known, most, hidden, (TOGETHER, TOGETHER_DEPTH), strict=True
        ):
            energy = part.mean_square * before / (before + 1)
            is_alike &= _is_noise(part, energy, noise, limit, floor, together)
            learnt.append(_Noise(noise.energy + energy, np.maximum(noise.flips, part.flipped), noise.frames + 1))
        color = parts[0]
        total = float((color.mean * color.count).sum() / max(float(color.count.sum()), 1.0))
        is_alike &= abs(total) <= HIDDEN_MEAN_CODES * self._unit
        return is_alike, (learnt[0], learnt[1])


def _is_noise(part: Differences, energy: Floats, noise: _Noise, limit: float, floor: float, together: float) -> bool:
    """Whether all tiles differ by noise alone. energy: mean squares, as of one frame; floor: tolerated codes."""
    median = float(np.median(energy))
    if median > limit**2 / 4:
        return False
    if noise.frames < FIRST:
        return bool((energy <= limit**2).all())
    usual = noise.usual
    if median > ODD_MEDIAN * float(np.median(usual)) + floor**2:
        return False
    by_chance = DEVIATIONS * np.sqrt(together / np.maximum(part.count, 1.0))
    block_count = np.maximum(_of_blocks(part.count, part.cols), 1.0)
    block_mean = _of_blocks(part.mean * part.count, part.cols) / block_count
    block_usual = _of_blocks(usual * part.count, part.cols) / block_count
    return bool(
        (energy <= (1.0 + math.sqrt(2.0) * by_chance) * usual + floor**2).all()
        and (np.abs(block_mean) <= DEVIATIONS * np.sqrt(block_usual * together / block_count) + floor).all()
        and (part.flipped <= 2 * noise.flips + MOST_FLIPS).all()
    )


def _of_blocks(of_tiles: Floats, cols: int) -> Floats:
    """Sums over BLOCK x BLOCK tiles."""
    rows = of_tiles.reshape(-1, cols)
    down = np.add.reduceat(rows, np.arange(0, len(rows), BLOCK), axis=0)
    return np.asarray(np.add.reduceat(down, np.arange(0, cols, BLOCK), axis=1))


def parallax_px(camera: CameraModel, before: Floats, now: Floats) -> float:
    """Approximate bound of the image motion between two poses, for surface at NEAREST_M or farther."""
    turned, moved = angle_between(before, now), distance_between(before, now)
    corner = math.hypot(camera.width / camera.fx, camera.height / camera.fy) / 2
    return max(camera.fx, camera.fy) * (1 + corner**2) * (turned + moved / NEAREST_M)

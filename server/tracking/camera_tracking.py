"""Camera pose: from the client, or tracked against the volume (thesis 4.2.1); detects tracking loss and relocalises."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.frames import CameraModel, RgbdFrame
from protocol.messages import Poses, Tracking
from server.input.denoise import bilateral_depth
from server.input.measure import Measurement
from server.maths.registration import angle_between, distance_between
from server.maths.rigid import inverse_rigid, repaired_pose
from server.opencl.engine import Engine
from server.tracking.reconstruction import Reconstruction
from server.tracking.relocalize import Keyframes, relocalize, thumbnail
from server.tracking.track import (
    ModelView,
    Pyramid,
    Registration,
    ViewBuffers,
    depth_pyramid,
    finest_level,
    level_intrinsics,
    register,
    view_model,
)
from server.volume.raycast import Surface
from server.volume.volume import BRICK, Volume

Floats = NDArray[np.float64]

TOLERANCE_VOXELS = 0.25
"""A motion that the scene fixes less accurately is not estimated."""
_LEAST_SHARE, _LEAST_OVERLAP, _GREATEST_DEVIATION_M = 0.4, 0.05, 0.015
"""Measured on four data sets: correct registrations have shares of 0.76 and more, wrong ones up to 0.32."""
_GREATEST_STEP_M, _GREATEST_TURN_RAD = 0.25, np.radians(20.0)
"""Greatest deviation from the predicted motion between two frames."""
_GREATEST_CORRECTION_M, _GREATEST_CORRECTION_RAD = 0.1, np.radians(10.0)
"""Greatest correction of a client's motion between two frames."""
_KEPT_M, _KEPT_RAD, _KEPT_FIT = 0.05, np.radians(3.0), 0.95
"""A view of the volume is kept while the camera stays this near and fits it about as well as at first. With a new view
in every frame, the bias of registrations would add up and a still camera would drift."""
_SETTLING_FRAMES = 32
"""The same view is renewed after 1, 2, 4, ... frames up to this number, while fusion improves it."""
_NEAREST_DEPTH_M = 0.1
"""A covered sensor measures less."""
_LEAST_START = 0.05
"""Share of the first picture that must show surface inside the volume."""

_LOST = "the camera is lost, nothing is fused: "


@dataclass(frozen=True)
class PoseEstimate:
    """Camera pose of one frame."""

    world_from_camera: Floats
    """The last good pose if tracking is lost."""
    tracking: Tracking
    notes: tuple[str, ...] = ()

    @property
    def fuse(self) -> bool:
        """Whether to fuse the frame."""
        return self.tracking != "lost"


@dataclass
class _Place:
    """A pose at which the camera has stayed for some frames."""

    volume_from_camera: Floats
    frames: int = 0
    fit: float = 0.0
    """Best share of measured pixels that agreed with the volume."""

    def holds(self, volume_from_camera: Floats, fit: float) -> bool:
        """Whether the camera is still there and the scene unchanged."""
        return (
            distance_between(self.volume_from_camera, volume_from_camera) < _KEPT_M
            and angle_between(self.volume_from_camera, volume_from_camera) < _KEPT_RAD
            and fit > _KEPT_FIT * self.fit
        )


class CameraTracking:
    """One camera's pose from frame to frame. `locate` a frame, fuse it, then `remember` the volume's surface.

    given: the client's poses. track: tracking against the volume. refine: the client's frame-to-frame motion, corrected
    by tracking if the two agree.
    """

    def __init__(
        self, engine: Engine, camera: CameraModel, mode: Poses, reconstruction: Reconstruction | None = None
    ) -> None:
        """`reconstruction`: shared with other cameras, with common keyframes; None: keyframes of its own."""
        self._engine = engine
        self._camera = camera
        self._mode = mode
        self._view_buffers = ViewBuffers(engine.workspace)
        self._view: ModelView | None = None
        self._pose: Floats | None = None
        self._given: Floats | None = None
        self._is_lost = False
        self._fit = 0.0
        self._place: _Place | None = None
        self._pyramid: Pyramid = ()
        self._keyframes = reconstruction.keyframes if reconstruction else Keyframes()
        self._is_remembered = mode == "track" or (reconstruction is not None and reconstruction.is_shared)

    def first_guess(self, frame: RgbdFrame) -> Floats:
        """world_from_camera before tracking. Raises ValueError, one line, for an invalid or missing pose."""
        if self._mode == "track" and self._pose is not None:
            return self._pose
        if frame.world_from_camera is not None:
            return repaired_pose(frame.world_from_camera)
        if self._mode == "track":
            return np.eye(4)
        raise ValueError("the frame has no pose: use a source with poses, or --poses track")

    def locate(self, frame: RgbdFrame, measurement: Measurement, volume: Volume) -> PoseEstimate:
        """Pose of a frame. Raises ValueError as `first_guess` does."""
        guess = self.first_guess(frame)
        engine, camera = self._engine, self._camera
        if self._mode == "given":
            if self._is_remembered and self._keyframes.is_new(volume.volume_from_world() @ guess):
                self._pyramid = depth_pyramid(engine, camera, bilateral_depth(engine, measurement.depth_m))
            return PoseEstimate(guess, "given")
        self._pyramid = depth_pyramid(engine, camera, bilateral_depth(engine, measurement.depth_m))
        if self._pose is None or self._view is None:
            return self._join(frame, guess, volume) if self._must_join(volume) else self._start(guess, volume)
        return self._follow(frame, guess, volume) if self._mode == "track" else self._refine(guess, volume)

    def remember(self, frame: RgbdFrame, located: PoseEstimate, model: Surface, volume_from_camera: Floats) -> None:
        """Keep the predicted surface, with which the next frame is compared, and a keyframe if the view is new."""
        if self._mode != "given":
            if self._needs_view(volume_from_camera):
                self._view = view_model(self._engine, self._camera, volume_from_camera, model, self._view_buffers)
            self._pose, self._given = located.world_from_camera, frame.world_from_camera
            self._is_lost = False
        if self._is_remembered and self._keyframes.is_new(volume_from_camera):
            self._keyframes.add(thumbnail(frame, self._engine.download(self._pyramid[0])), volume_from_camera)

    def _needs_view(self, volume_from_camera: Floats) -> bool:
        """Whether to compare the next frame with a new view of the volume instead of the last one kept."""
        place = self._place
        if place is None or self._is_lost or not place.holds(volume_from_camera, self._fit):
            place = self._place = _Place(volume_from_camera)
        place.frames += 1
        place.fit = max(place.fit, self._fit)
        return place.frames <= _SETTLING_FRAMES and place.frames.bit_count() == 1

    def _start(self, guess: Floats, volume: Volume) -> PoseEstimate:
        """The first frame defines the world, if it shows enough surface to track the next one."""
        if self._mode == "refine":
            return PoseEstimate(guess, "given")
        if self._starting_share(guess, volume) < _LEAST_START:
            return PoseEstimate(guess, "lost", (_LOST + "there is too little depth inside the volume to begin with",))
        return PoseEstimate(guess, "tracked")

    def _must_join(self, volume: Volume) -> bool:
        """Whether other cameras have scanned the volume, so that this one has to relocalise in it."""
        return self._mode == "track" and volume.frames > 0

    def _join(self, frame: RgbdFrame, guess: Floats, volume: Volume) -> PoseEstimate:
        seen = thumbnail(frame, self._engine.download(self._pyramid[0]))
        places = [volume.volume_from_world() @ guess, *self._keyframes.most_similar(seen, count=2)]
        found = relocalize(self._engine, self._camera, volume, self._pyramid, places)
        if found is None:
            return PoseEstimate(guess, "lost", (_LOST + "it does not show what the room has seen",))
        return self._tracked(found, volume, "left as it was")

    def _follow(self, frame: RgbdFrame, last: Floats, volume: Volume) -> PoseEstimate:
        found = self._register(last, volume)
        why = _why_lost(found, last, volume)
        if why is None and not (self._is_lost and len(_free(found))):
            return self._tracked(found, volume, "left as it was")
        self._is_lost = True
        seen = thumbnail(frame, self._engine.download(self._pyramid[0]))
        if seen.is_deep.mean() < _LEAST_START:
            return PoseEstimate(last, "lost", (_LOST + "there is no usable depth",))
        near = self._keyframes.most_similar(seen, count=3)
        found = relocalize(self._engine, self._camera, volume, self._pyramid, near)
        if found is None:
            return PoseEstimate(last, "lost", (_LOST + (why or "the scene does not fix where it is"),))
        return self._tracked(found, volume, "left as it was")

    def _refine(self, given: Floats, volume: Volume) -> PoseEstimate:
        assert self._pose is not None
        assert self._given is not None
        guess = repaired_pose(self._pose @ inverse_rigid(repaired_pose(self._given)) @ given)
        found = self._register(guess, volume)
        why = _why_lost(found, guess, volume, _GREATEST_CORRECTION_M, _GREATEST_CORRECTION_RAD)
        if why is not None:
            return PoseEstimate(guess, "given", (f"the client's motion is not corrected: {why}",))
        return self._tracked(found, volume, "taken from the client's pose")

    def _register(self, world_from_camera: Floats, volume: Volume) -> Registration | None:
        assert self._view is not None
        guess = volume.volume_from_world() @ world_from_camera
        tolerance_m = TOLERANCE_VOXELS * volume.voxel_m
        return register(self._engine, self._camera, self._view, self._pyramid, guess, tolerance_m)

    def _tracked(self, found: Registration | None, volume: Volume, fallback: str) -> PoseEstimate:
        assert found is not None
        self._fit = found.share
        pose = inverse_rigid(volume.volume_from_world()) @ found.volume_from_camera
        notes = (f"the scene does not fix {motions_in_words(found.free)}: {fallback}",) if len(found.free) else ()
        return PoseEstimate(pose, "tracked", notes)

    def _starting_share(self, world_from_camera: Floats, volume: Volume) -> float:
        """Share of the picture with smooth depth inside the volume."""
        depth = self._engine.download(self._pyramid[0]).astype(np.float64)
        v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
        fx, fy, cx, cy = level_intrinsics(self._camera, finest_level(self._camera))
        points = np.stack([(u - cx) / fx * depth, (v - cy) / fy * depth, depth], -1)
        volume_from_camera = volume.volume_from_world() @ world_from_camera
        placed = points @ volume_from_camera[:3, :3].T + volume_from_camera[:3, 3]
        inside = ((placed > 0) & (placed < BRICK * volume.voxel_m * np.array(volume.bricks))).all(-1) & (
            depth > _NEAREST_DEPTH_M
        )
        smooth = np.abs(np.diff(depth, axis=1, append=np.inf)) < 0.05 * depth
        return float((inside & smooth).mean())


def motions_in_words(free: Floats) -> str:
    """Directions [k, 6] (turn, shift; of comparable size) as "motion along (x, y, z) and turning about (x, y, z)"."""
    shifts = [row[3:] for row in free if np.linalg.norm(row[3:]) >= np.linalg.norm(row[:3])]
    turns = [row[:3] for row in free if np.linalg.norm(row[3:]) < np.linalg.norm(row[:3])]
    parts = []
    for word, axes in (("motion along", shifts), ("turning about", turns)):
        if axes:
            parts.append(f"{word} {', '.join(_axis_in_words(axis) for axis in axes)}")
    return " and ".join(parts)


def _axis_in_words(axis: Floats) -> str:
    unit = axis / np.linalg.norm(axis)
    unit = np.where(np.abs(unit) < 0.005, 0.0, unit * np.sign(unit[np.abs(unit).argmax()]))
    return f"({unit[0]:.2f}, {unit[1]:.2f}, {unit[2]:.2f})"


def _free(found: Registration | None) -> Floats:
    return np.empty((0, 6)) if found is None else found.free


def _why_lost(
    found: Registration | None,
    guess: Floats,
    volume: Volume,
    greatest_step_m: float = _GREATEST_STEP_M,
    greatest_turn_rad: float = _GREATEST_TURN_RAD,
) -> str | None:
    """Reason to reject a registration; None to accept it."""
    if found is None or found.overlap < _LEAST_OVERLAP:
        return "hardly any of its depth meets the volume's surface"
    if found.share < _LEAST_SHARE or found.deviation_m > _GREATEST_DEVIATION_M:
        return "its depth does not fit the volume's surface"
    expected = volume.volume_from_world() @ guess
    far = distance_between(found.volume_from_camera, expected) > greatest_step_m
    if far or angle_between(found.volume_from_camera, expected) > greatest_turn_rad:
        return "it would have moved too far in one frame"
    return None

"""Interface of all sources of frames: data-set folders, synthetic scenes, recordings and cameras."""

from __future__ import annotations

from typing import Protocol

from protocol.frames import CameraModel, RgbdFrame

GALLERY_PREFIX = "synthetic:gallery/"
ENDLESS = 2**31
"""Length of a live source, which runs until it is stopped."""


class Source(Protocol):
    """A sequence of RGB-D frames of one camera. Indexing may raise SourceError with the name of a damaged file."""

    @property
    def name(self) -> str: ...

    @property
    def camera(self) -> CameraModel: ...

    @property
    def fps(self) -> float: ...

    @property
    def has_poses(self) -> bool:
        """Whether every frame has `world_from_camera`."""

    @property
    def up(self) -> tuple[float, float, float] | None:
        """Up direction in world axes; None: unknown."""

    def __len__(self) -> int:
        """Number of frames; `ENDLESS` for a live source."""

    def __getitem__(self, index: int) -> RgbdFrame:
        """The frame with this number; a live source returns its newest frame, with this number."""


def is_live(source: Source) -> bool:
    """Whether the source is a camera, which sets the frame rate itself and has no last frame."""
    return len(source) == ENDLESS

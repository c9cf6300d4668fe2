"""The interface of everything that frames come from: data-set folders, synthetic scenes, recordings and cameras."""

from __future__ import annotations

from typing import Protocol

from protocol.frames import CameraModel, RgbdFrame

GALLERY_PREFIX = "synthetic:gallery/"
ENDLESS = 2**31
"""Length of a source that goes on until it is stopped: a camera."""


class Source(Protocol):
    """A sequence of RGB-D frames of one camera. Indexing may raise SourceError naming the damaged file."""

    @property
    def name(self) -> str: ...

    @property
    def camera(self) -> CameraModel: ...

    @property
    def fps(self) -> float: ...

    @property
    def has_poses(self) -> bool:
        """Every frame has its `world_from_camera`."""

    @property
    def up(self) -> tuple[float, float, float] | None:
        """World direction, where the source knows it."""

    def __len__(self) -> int:
        """`ENDLESS` of a camera."""

    def __getitem__(self, index: int) -> RgbdFrame:
        """The frame of that number; of a camera, its newest, given that number."""


def is_live(source: Source) -> bool:
    """True of a camera: frames come when they come, and go on."""
    return len(source) == ENDLESS

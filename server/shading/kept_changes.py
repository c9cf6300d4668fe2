"""How far off what was kept turns out to be, where it is found anew. Kernel side: count_change of kept_shadows.clh.

No bound follows from the scene: when a scan changes by a voxel, a narrow view of a lamp may open. So it is measured. In
view, each value is found anew after LONGEST frames at most, soon after transfer of its place was traced again, if it
was (transfer_cache.py). What a picture has of either, it has by R' / R and by what occluders take from virtual surface:
that is compared with what was kept, in codes of the brightest surface that a picture can show; darker ones change by
less, and virtual ones by more only where they are shown brighter than white. What is about to be found anew is the
furthest off, if what changes goes on changing; and samples of one cell look in different directions, which counts, too.
So what stands is taken to be off as often as what the last LONGEST frames found anew. What happens suddenly is not
foreseen: a thing that is carried in counts when values around it are found anew.
"""

from __future__ import annotations

from collections import deque

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.messages import LeftOut
from server.opencl.engine import Engine
from server.opencl.pending_read import PendingRead
from server.shading.kept_shadows import LONGEST, STEADY
from server.transfer.kept_bounds import KeptBounds, kept_left_out

STEPS, LEAST_CODES = 21, 0.25
"""The n-th count is of changes of at most LEAST_CODES 2^(n / 2) codes, as in kept_shadows.clh; the last, of all."""
HARDLY = 0.001
"""Share of the picture's pixels that a bound leaves out, as bounds under noise do (temporal_reuse.py)."""
SHADOWS_OF_KNOWN_PLACES = "shadows_of_known_places"
_ALL_CODES = 255.0


class _Kind:
    """One kind of samples."""

    def __init__(self) -> None:
        self.begun: list[tuple[float, bool, PendingRead]] = []
        self.shown: NDArray[np.float64] = np.zeros(2)
        """Share of the picture in which the last frame shows what is known, and what is lent."""
        self.found: deque[NDArray[np.int64]] = deque(maxlen=LONGEST)
        """[2, STEPS] changes in each of the last frames in which something was found anew."""

    def settle(self) -> None:
        """Take in what was begun; waits for the device."""
        for pixels, are_all_known, read in self.begun:
            counts = read.result().astype(np.int64)
            self.shown = np.asarray(pixels * counts[:, 0])
            if are_all_known:
                self.shown[0] = 1.0 - self.shown[1]
            if counts[:, 1:].any():
                self.found.append(counts[:, 1:])
        self.begun.clear()


class KeptChanges:
    """Of a session's last frames."""

    def __init__(self) -> None:
        self._kinds: dict[type, _Kind] = {}

    def begin_frame(self) -> None:
        """Nothing is shown yet."""
        for kind in self._kinds.values():
            kind.settle()
            kind.shown = np.zeros(2)

    def counts(self, engine: Engine) -> cl_array.Array:
        """[2, 1 + STEPS] int32 for a kernel to count in, all 0."""
        counts = engine.array_to_read((2, 1 + STEPS), np.int32)
        engine.fill(counts, 0)
        return counts

    def take(
        self, engine: Engine, kind: type, counts: cl_array.Array, pixels: float, *, are_all_known: bool = False
    ) -> None:
        """What a kernel has counted of one frame's samples of one `kind`, each of which stands for so much of the
        picture. are_all_known: those that are not lent show what is known, whether it stands or not."""
        self._kinds.setdefault(kind, _Kind()).begun.append((pixels, are_all_known, engine.begin_download(counts)))

    def bounds(self) -> KeptBounds:
        """As they are now known; waits for the device."""
        for kind in self._kinds.values():
            kind.settle()
        shown = np.array([kind.shown for kind in self._kinds.values()]).reshape(-1, 2)
        changes = np.array([sum(kind.found, np.zeros((2, STEPS), np.int64)) for kind in self._kinds.values()])
        changes = changes.reshape(-1, 2, STEPS)
        return KeptBounds(bound_of(shown[:, 0], changes[:, 0]), bound_of(shown[:, 1], changes[:, 1]))


def shadows_left_out(bounds: KeptBounds) -> LeftOut:
    """Shadows that are shown as an earlier frame found them."""
    kept = f"kept at the same place, under a light that is the same to {STEADY:.0%}; in view, {LONGEST} frames at most"
    return kept_left_out(SHADOWS_OF_KNOWN_PLACES, kept, bounds.known)


def bound_of(shown: NDArray[np.float64], changes: NDArray[np.int64]) -> float | None:
    """Codes that all but HARDLY of the picture are within. shown: [kinds] share of it that samples of each kind show;
    changes: [kinds, STEPS] counts. None where too much is shown of a kind of which nothing was found anew."""
    if not shown.any():
        return 0.0
    found = changes.sum(axis=1, keepdims=True)
    beyond = np.where(found, (found - np.cumsum(changes, axis=1)) / np.maximum(found, 1), 1.0)
    is_hardly = shown @ beyond <= HARDLY
    if not is_hardly.any():
        return None
    return float(min(LEAST_CODES * 2.0 ** (int(np.argmax(is_hardly)) / 2), _ALL_CODES))

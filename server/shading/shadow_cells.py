"""Tables in which what virtual things take from the light is kept by cell of the world.

One is of the shadows on real surface, one of what occluders take from virtual surface. How long a value is true,
kept_shadows.py says. Kernels: keep_shadows of kept_shadows.cl; include/kept_shadows.clh.

A table is a hash of cells, with one place for each: of two cells that ask for the same place, the one that asked last
has it. Of a frame's samples in a cell one fills it, whatever the order in which work-items run: the first, or the first
that differs from what was kept. Where samples of a cell differ, what is kept is found anew in each frame, by all of
them: at the foot of a thing shadows are as sharp as without.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.objects.pixel_boxes import PixelBox
from server.opencl.buffers import BufferDescription, StageBuffers, Workspace
from server.opencl.engine import Engine, KernelArgument, float4, int4
from server.opencl.structs import SHADOW_CELLS
from server.shading.kept_changes import KeptChanges
from server.shading.kept_shadows import LONGEST, KeptShadows, ShadowCause
from server.shading.traced_scene import TracedScene
from server.transfer.sample_grid import SampleGrid, grid_of

WORDS = 8
"""Of an entry."""


class ShadowTable(StageBuffers):
    """One session's table of one kind."""

    places_a_sample: ClassVar[float]
    """Size of the table, in samples of a frame, rounded up to a power of two; 32 bytes each."""

    close: ClassVar[float]
    """A value that differs by more from the one that was kept is another."""

    is_of_transfer: ClassVar[bool]
    """Whether values are made of radiance transfer, which is kept, too."""

    table = BufferDescription(np.uint32)
    """[places, WORDS] as in kept_shadows.clh."""
    asked = BufferDescription(cl_types.int4)
    """[rows, cols] the cells that samples ask to fill."""
    found = BufferDescription(cl_types.float4)
    """[rows, cols] what they fill them with."""

    def __init__(self, workspace: Workspace) -> None:
        super().__init__(workspace)
        self.memory: KeptShadows = KeptShadows()
        self.places = 0
        self.is_whole = True
        """Whether no frame was given up between its claims and what it keeps."""

    def reserve(self, engine: Engine, samples: int) -> None:
        """Room for the cells of so many samples; what was kept for another number, or by halves, is forgotten."""
        places = places_for(int(self.places_a_sample * samples))
        if places != self.places or not self.is_whole:
            kernel = engine.kernel("shading/kept_shadows.cl", "begin_shadows")
            engine.launch(kernel, (places,), places, self.table.array((places, WORDS)))
            self.places, self.is_whole = places, True


class RealShadows(ShadowTable):
    """R' / R of real surface."""

    places_a_sample = 4
    close = 0.01
    is_of_transfer = True


class VirtualOcclusions(ShadowTable):
    """Radiance that occluders take from virtual surface, which fills a part of a picture; over the light's mean.

    A sample traces few directions: with .02 in place of .05 half as many again would seem to have changed.
    """

    places_a_sample = 1
    close = 0.05
    is_of_transfer = False


@dataclass(frozen=True)
class ShadowCells:
    """The cells of one frame's samples."""

    parameters: np.void
    """SHADOW_CELLS of structs.py."""
    table: cl_array.Array
    """[places, WORDS]."""
    asked: cl_array.Array
    found: cl_array.Array
    changes: cl_array.Array
    """Of KeptChanges."""
    of: ShadowTable

    def arguments(self) -> tuple[KernelArgument, ...]:
        """SHADOW_CELLS of kept_shadows.clh."""
        return self.parameters, self.table

    def keep(self, engine: Engine, camera: CameraModel, samples: SampleGrid, around: PixelBox) -> None:
        """Keep what a kernel before found at the samples `around`."""
        engine.launch(
            engine.kernel("shading/kept_shadows.cl", "keep_shadows"),
            (around[2] - around[0], around[3] - around[1]),
            grid_of(samples, camera),
            int4(*around),
            *self.arguments(),
            self.asked,
            self.found,
        )
        pixels = samples.stride**2 / (camera.width * camera.height)
        are_all_known = type(self.of).is_of_transfer
        engine.state(KeptChanges).take(engine, type(self.of), self.changes, pixels, are_all_known=are_all_known)
        self.of.is_whole = True


def shadow_cells(
    engine: Engine,
    kind: type[ShadowTable],
    camera: CameraModel,
    eye: NDArray[np.float64],
    scene: TracedScene,
    samples: SampleGrid,
    level: float = 1.0,
    *,
    fills: bool = True,
) -> ShadowCells:
    """The cells for a frame's `samples`.

    eye: [3] where the camera is, volume metres. level: of the light's radiance, where values are radiance. fills: what
    is found is kept, and the next call is of the next frame; else of the same.
    """
    table, count = engine.buffers(kind), samples.rows * samples.cols
    table.reserve(engine, count)
    cause = ShadowCause.of(scene)
    since = table.memory.since(cause)
    now = table.memory.begin_frame(cause) if fills else table.memory.now + 1
    parameters = SHADOW_CELLS(
        eye=float4(*eye, 0.0),
        spacing=samples.stride / camera.fx,
        level=max(level, float(np.finfo(np.float32).tiny)),
        places=table.places,
        since=since,
        turns=LONGEST,
        close=table.close,
        now=now,
    )
    shape = (samples.rows, samples.cols)
    by_sample = table.asked.array(shape), table.found.array(shape)
    table.is_whole = not fills  # until what was found is kept
    changes = engine.state(KeptChanges).counts(engine) if fills else engine.unused
    return ShadowCells(parameters, table.table.array((table.places, WORDS)), *by_sample, changes, table)


def no_cells(engine: Engine) -> tuple[KernelArgument, ...]:
    """SHADOW_CELLS of kept_shadows.clh where nothing is kept."""
    return _NOTHING, engine.unused


_NOTHING = SHADOW_CELLS(
    eye=float4(0, 0, 0, 0), spacing=1.0, level=1.0, close=0.0, places=0, now=0, since=0, turns=LONGEST
)


def places_for(count: int) -> int:
    """The least power of two that is not less."""
    return 1 << (max(count, 1) - 1).bit_length()

"""What effects read and write. A resource is a type, which the type checker sees, and has one writer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NewType

import pyopencl.array as cl_array

from server.objects.rasterize import Placed, VirtualSurface
from server.shading.differential_rendering import RealShadow
from server.shading.traced_scene import DeviceLight, TracedScene
from server.transfer.sample_grid import SampleGrid

# Given to the effects.

VirtualObjects = NewType("VirtualObjects", Sequence[Placed])
"""At least one object."""
KnownLight = NewType("KnownLight", DeviceLight)
"""The light, once one has been found."""
SharpLight = NewType("SharpLight", DeviceLight)
"""The light, where it has discs that need shadow maps."""
ReturnedRadiance = NewType("ReturnedRadiance", float)
"""The most that the radiance of real surface can change by, in the picture's units: all of it can be hidden."""


@dataclass(frozen=True)
class FaintShadows:
    """How weak a change of real surface may be to be left out."""

    pixel_share: float
    """Of R' / R of a pixel."""
    sample_share: float
    """Of R' / R of a sample, by light that bounces."""


# Written by effects. Arrays are [h, w] float4 on the device.

Gain = NewType("Gain", float)
"""By which virtual surface is brighter than the light makes it (7.1, H)."""
Coverage = NewType("Coverage", cl_array.Array)
"""Of rasterize.py: how much of each pixel the objects cover."""
ChangedScene = NewType("ChangedScene", TracedScene)
"""The scene as the objects have changed it: what they send, and what real surface then sends."""
Reflected = NewType("Reflected", cl_array.Array)
"""What glossy virtual surface reflects."""
VirtualOcclusion = NewType("VirtualOcclusion", SampleGrid)
"""What occluders take from virtual surface, less what they send to it."""
BouncedShadow = NewType("BouncedShadow", RealShadow)
"""RealShadow with one bounce between real surfaces."""
RefinedVirtual = NewType("RefinedVirtual", cl_array.Array)
"""VirtualOcclusion at single pixels; w = 1 where it counts."""
RefinedReal = NewType("RefinedReal", cl_array.Array)
"""RealShadow at single pixels; w = 1 where it counts."""
ChangeMask = NewType("ChangeMask", cl_array.Array)
"""Of change_mask.py: the cells of the picture in which the shadow counts."""
DirectVirtual = NewType("DirectVirtual", cl_array.Array)
"""What the discs of the light bring to virtual surface."""
DirectReal = NewType("DirectReal", cl_array.Array)
"""R' / R of the whole light at every pixel, its discs by shadow maps."""


@dataclass(frozen=True)
class PictureParts:
    """What the picture is composed of besides the camera's own; None: that effect was left out."""

    light: DeviceLight
    virtual: VirtualSurface | None = None
    occluded: VirtualOcclusion | None = None
    ratio: RealShadow | None = None
    bounced: BouncedShadow | None = None
    refined_occluded: RefinedVirtual | None = None
    refined_ratio: RefinedReal | None = None
    coverage: Coverage | None = None
    reflected: Reflected | None = None
    gain: Gain | None = None
    """None: the light's own scale."""
    direct_virtual: DirectVirtual | None = None
    direct_ratio: DirectReal | None = None
    changed: ChangeMask | None = None

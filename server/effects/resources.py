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
"""Bound on the change of real surface's radiance, in the picture's units."""


@dataclass(frozen=True)
class FaintShadows:
    """Changes of real surface that are too weak to be drawn."""

    pixel_share: float
    """Largest change of a pixel's R' / R that is left out."""
    sample_share: float
    """Largest change of a sample's R' / R by bounced light that is left out."""


# Written by effects. Arrays are [h, w] float4 on the device.

Gain = NewType("Gain", float)
"""Factor on the shading of virtual surface (7.1, H)."""
ChangedScene = NewType("ChangedScene", TracedScene)
"""The scene with the light that the objects send and the changed light that real surface sends."""
FirstShadow = NewType("FirstShadow", RealShadow)
"""RealShadow of objects that send no light yet, in blocks of 2 x 2 samples."""
Reflected = NewType("Reflected", cl_array.Array)
"""Radiance that glossy virtual surface reflects."""
VirtualOcclusion = NewType("VirtualOcclusion", SampleGrid)
"""Radiance that occluders take from virtual surface, less the radiance that they send to it."""
BouncedShadow = NewType("BouncedShadow", RealShadow)
"""RealShadow with one bounce between real surfaces."""
RefinedVirtual = NewType("RefinedVirtual", cl_array.Array)
"""VirtualOcclusion at single pixels; w = 1 where it counts."""
RefinedReal = NewType("RefinedReal", cl_array.Array)
"""RealShadow at single pixels; w = 1 where it counts."""
ChangeMask = NewType("ChangeMask", cl_array.Array)
"""The cells of the picture in which the shadow counts, of change_mask.py."""
DirectVirtual = NewType("DirectVirtual", cl_array.Array)
"""Radiance of virtual surface from the discs of the light."""
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
    reflected: Reflected | None = None
    gain: Gain | None = None
    """None: the light's own scale."""
    direct_virtual: DirectVirtual | None = None
    direct_ratio: DirectReal | None = None
    changed: ChangeMask | None = None

"""Glossy virtual surface (thesis fig. 8.4): what it reflects. Kernel: reflect.cl.

A few rays around the mirrored view, the wider the rougher, meet real and virtual surface or the light beyond, which is
blurred as a lobe of that width does. How much of it is reflected: the microfacet model of glTF (GGX), integrated.
"""

from __future__ import annotations

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.objects.rasterize import VirtualSurface
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine, float4
from server.opencl.structs import REFLECTION_PARAMETERS
from server.shading.traced_scene import TracedScene
from server.transfer.sample_grid import pixel_grid

LEAST_GLOSS = 0.02
"""Of one less the roughness, or of the metalness: below it a surface is matt, its diffuse shading all there is."""


class _Buffers(StageBuffers):
    reflected = BufferDescription(cl_types.float4)
    """[h, w] as reflect_surroundings returns it."""


def is_glossy(materials: NDArray[np.float32]) -> bool:
    """Whether any of an object's materials, rows as in MaterialTables, may not be matt; textures lower roughness."""
    gloss = np.maximum(1 - materials[:, 0], materials[:, 1])
    return bool((gloss >= LEAST_GLOSS).any() or (materials[:, 3] >= 0).any())


def reflect_surroundings(
    engine: Engine,
    camera: CameraModel,
    volume_from_camera: NDArray[np.float64],
    virtual: VirtualSurface,
    scene: TracedScene,
) -> cl_array.Array:
    """[h, w] float4: radiance that virtual surface reflects, and in w what remains of its diffuse radiance."""
    assert virtual.material is not None
    reflected = engine.buffers(_Buffers).reflected.array((camera.height, camera.width))
    engine.launch(
        engine.kernel("reflect.cl", "reflect_surroundings", **scene.defines(engine)),
        (camera.width, camera.height),
        REFLECTION_PARAMETERS(
            scene=scene.parameters(engine, pixel_grid(camera)),
            eye=float4(*volume_from_camera[:3, 3], 1.0),
            least_gloss=LEAST_GLOSS,
        ),
        *scene.arguments(engine),
        virtual.position,
        virtual.normal,
        virtual.base_color,
        virtual.material,
        virtual.object_index,
        reflected,
    )
    return reflected

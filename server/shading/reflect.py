"""Glossy virtual surface (thesis fig. 8.4): what it reflects. Kernel: reflect.cl.

A few rays are traced in a cone around the mirrored view direction; rough surfaces have a wide cone. A ray takes the
radiance of the real or virtual surface that it meets, or else the light, blurred by a lobe of the cone's width. The
reflected part follows the microfacet model of glTF (GGX), integrated over the hemisphere.
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
"""A surface is matt if both 1 - roughness and its metalness are below this: then only its diffuse shading is drawn."""


class _Buffers(StageBuffers):
    reflected = BufferDescription(cl_types.float4)
    """[h, w] as reflect_surroundings returns it."""


def is_glossy(materials: NDArray[np.float32]) -> bool:
    """Whether any material (rows as in MaterialTables) may be glossy. Textures can lower the roughness."""
    gloss = np.maximum(1 - materials[:, 0], materials[:, 1])
    return bool((gloss >= LEAST_GLOSS).any() or (materials[:, 3] >= 0).any())


def reflect_surroundings(
    engine: Engine,
    camera: CameraModel,
    volume_from_camera: NDArray[np.float64],
    virtual: VirtualSurface,
    scene: TracedScene,
) -> cl_array.Array:
    """[h, w] float4: radiance that virtual surface reflects; w: the factor of its diffuse radiance."""
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

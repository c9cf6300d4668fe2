"""The hybrid geometry buffer (thesis 4.2.2, eq. 4.1-4.5): the volume's surface, and what changed too fast for it.

Kernels: merge.cl, geometry_buffer.cl. Depth runs through three passes: D' takes the volume where the sensor agrees
with it and the sensor elsewhere, and fills the sensor's holes; D'' is a joint bilateral median, D''' a median. What the
thesis leaves open:

- lambda_D, the depths that agree: 1.5 voxels and four deviations of the sensor's noise (agreement.clh).
- lambda_I: LAMBDA_INTENSITY. k: 17 pixels for holes (a hole up to 16 pixels wide is filled), 5 for D'', 3 for D'''.
- Where the volume knows nothing, the sensor is taken. A hole that too few neighbours support (LEAST_SUPPORT in
  merge.cl) keeps the volume's surface; without one it stays a hole.
- The median of an even count is the lower one. D'' and D''' fill no holes.
- D'' and D''' take noise of the sensor away. Where all that their window knows is the volume's there is none, and the
  volume's depth is kept: no filter runs where measured and fused depth agree.
- Where the final depth agrees with the volume, the volume's own surface is taken, unfiltered: the medians would put
  voxel-exact surface back by up to the slope of their windows, and never by more than lambda_D.
"""

from __future__ import annotations

import numpy as np
import pyopencl.array as cl_array
import pyopencl.cltypes as cl_types
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.input.measure import Measurement, intrinsics
from server.maths.rigid import inverse_rigid
from server.opencl.engine import Engine, float16, int4
from server.volume.raycast import Surface
from server.volume.volume import Volume

LAMBDA_INTENSITY = 0.04
"""Intensities that may belong to one surface (eq. 4.1), in square roots of linear luminance, in which noise is about
the same at every brightness. Three deviations of a difference (times sqrt 2) at a deviation of 0.01, a camera's 2.5
codes of 255 indoors; the JPEG pictures of the public data sets have 0.001 to 0.004."""

TRUSTED_WEIGHT = 15.0
"""Frames that must have seen a surface of the volume before it fills holes of the sensor, or half of all while there
are fewer than twice as many. A sparse volume keeps no memory of free space, so that what moves through it becomes
surface at once; where the sensor is blind, as beside a hand, nothing else would tell it from the room."""

STILL_WEIGHT = 5.0
"""Frames, likewise, that must have seen a surface before it is called static: what moves agrees with a volume that it
was fused into just now."""

_BORDER = 8
_PLANES = ("measured", "predicted", "shade", "sensed", "merged", "aligned")


def merge_depth(
    engine: Engine,
    camera: CameraModel,
    volume_from_camera: NDArray[np.float64],
    measurement: Measurement,
    model: Surface,
    volume: Volume,
    smooth: bool = True,
) -> Surface:
    """The hybrid geometry buffer, in buffers of its own. Its colour is `measurement.radiance`, pixel by pixel.

    smooth: whether the median D''' is taken of D''.

    Labels: static where it is the volume's surface; dynamic where the sensor says otherwise, or the volume nothing;
    filled where the depth is neither's but the neighbourhood's median; none where nothing is known.
    """
    size, space = (camera.width, camera.height), engine.workspace
    shape, groups = size[::-1], (-(-size[0] // 8), size[1])
    bordered = (8 * groups[0] + 2 * _BORDER, size[1] + 2 * _BORDER)
    planes = {name: space.array(f"plane_{name}", bordered[::-1], np.float32) for name in _PLANES}
    measured, predicted, shade, sensed, merged, aligned = planes.values()
    smoothed = merged  # D''' does not read D'
    trusted = aligned  # until D'' is written

    def launch(file: str, name: str, items: tuple[int, int], *arguments: cl_array.Array | np.generic | float) -> None:
        engine.launch(engine.kernel(file, name), items, *size, bordered[0], *arguments)

    launch(
        "merge.cl",
        "lay_out",
        bordered,
        measurement.depth_m,
        measurement.radiance,
        model.positions,
        float16(inverse_rigid(volume_from_camera)),
        *planes.values(),
    )
    launch(
        "merge.cl",
        "compare_depth",
        groups,
        measured,
        predicted,
        model.positions,
        int4(*volume.bricks, 0),
        volume.slots_device,
        volume.voxels,
        volume.voxel_m,
        min(STILL_WEIGHT, volume.frames / 2),
        min(TRUSTED_WEIGHT, volume.frames / 2),
        trusted,
        sensed,
    )
    launch(
        "merge.cl", "merge_depth", groups, sensed, trusted, shade, volume.voxel_m, LAMBDA_INTENSITY, merged
    )  # eq. 4.3
    launch("merge.cl", "align_depth", groups, merged, predicted, shade, LAMBDA_INTENSITY, aligned)  # eq. 4.4
    if smooth:
        launch("merge.cl", "smooth_depth", groups, aligned, predicted, smoothed)  # eq. 4.5
    else:
        smoothed = aligned

    surface = Surface(
        space.array("merged_positions", shape, cl_types.float4),
        space.array("merged_normals", shape, cl_types.float4),
        space.array("labels", shape, np.uint8),
    )
    lens, pose = intrinsics(camera), float16(volume_from_camera)
    outputs = (surface.positions, surface.normals, surface.labels)
    depths = (smoothed, sensed, predicted)
    launch(
        "geometry_buffer.cl",
        "label_surface",
        size,
        *depths,
        lens,
        pose,
        volume.voxel_m,
        model.positions,
        model.normals,
        *outputs,
    )
    launch("geometry_buffer.cl", "fit_normals", groups, smoothed, surface.labels, lens, pose, surface.normals)
    return surface

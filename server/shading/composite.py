"""Compositing (thesis 7.2.1): the finished picture. Kernel: composite.cl."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray

from protocol.frames import CameraModel
from server.input.measure import linear_values
from server.maths.rigid import inverse_rigid
from server.maths.sh import LUMINANCE
from server.objects.dirty_region import EMPTY, box_around
from server.objects.rasterize import VirtualSurface
from server.opencl.buffers import BufferDescription, StageBuffers
from server.opencl.engine import Engine, KernelArgument, float4, float16, int4
from server.opencl.structs import MIXTURE_PARAMETERS
from server.shading.change_mask import mark_changes
from server.shading.traced_scene import DeviceLight
from server.transfer.sample_grid import SampleGrid, grid_of, no_samples
from server.transfer.sampling import Upsampling
from server.volume.raycast import Surface

COLORED = 4.0
"""Largest factor between a light's channel and its luminance: that of a candle or of shade is 2."""


def srgb_codes(linear: NDArray[np.float64]) -> NDArray[np.uint8]:
    """sRGB codes of linear radiance, clipped to [0, 1] (IEC 61966-2-1)."""
    clipped = np.clip(linear, 0.0, 1.0)
    encoded = np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)
    return (255 * encoded + 0.5).astype(np.uint8)


@cache
def _shown_codes() -> NDArray[np.uint8]:
    return srgb_codes(linear_values("linear16").astype(np.float64))


def shown_picture(
    engine: Engine, camera: CameraModel, color: NDArray[np.uint8] | NDArray[np.uint16], radiance: cl_array.Array
) -> NDArray[np.uint8]:
    """[h, w, 3] the camera picture as sRGB codes: unchanged if it is sRGB, sRGB(value / 65535) if linear.

    A distorted camera's picture is shown rectified, because virtual things are drawn as a pinhole camera sees them.
    """
    if camera.is_distorted:
        rectified = engine.download(radiance)
        return srgb_codes(np.stack([rectified[channel] for channel in "xyz"], axis=-1).astype(np.float64))
    if camera.color_encoding == "linear16":
        return _shown_codes()[color]
    return color.astype(np.uint8, copy=False)


class _Buffers(StageBuffers):
    srgb_codes = BufferDescription(np.uint8)
    shown = BufferDescription(np.uint8)
    """[h, w, 3] the camera's picture."""
    """[h, w, 3] the result."""


@dataclass(frozen=True)
class CompositeInputs:
    """What is mixed with the camera's picture, and what it is mixed by: arguments of composite_inputs.clh."""

    camera: CameraModel
    volume_from_camera: NDArray[np.float64]
    radiance: cl_array.Array
    """[h, w] float4, the camera's picture, linear; w < 0 outside of it."""
    surface: Surface
    tolerance_m: float
    """How far behind a real surface a virtual one still shows, for objects that stand on it."""
    light: DeviceLight
    virtual: VirtualSurface | None = None
    occluded: SampleGrid | None = None
    ratio: SampleGrid | None = None
    refined_occluded: cl_array.Array | None = None
    """[h, w] float4: what stands for `occluded` where w = 1."""
    refined_ratio: cl_array.Array | None = None
    upsampling: Upsampling = "bilateral"
    reflected: cl_array.Array | None = None
    """[h, w] float4 of reflect_surroundings."""
    gain: float = 1.0
    """By which virtual surface is brighter than `light` makes it (tone_mapping.py)."""
    direct_virtual: cl_array.Array | None = None
    """What the light's discs bring besides."""
    direct_ratio: cl_array.Array | None = None
    """Stands for `ratio` and `refined_ratio` where the light has discs (shadow_map.py)."""
    reached: cl_array.Array | None = None
    """Of mark_changes: the cells in which `ratio` counts; None: wherever it is not 1."""
    codes: cl_array.Array | None = None
    """[h, w, 3] uint8 as of Measurement."""
    restores_clipped: bool = False
    """Whether a shadow falls on the radiance that clipped channels are likely to have (restored.clh): what the picture
    shows of it is a lower bound."""

    @property
    def is_nothing(self) -> bool:
        """Whether nothing is virtual."""
        return self.virtual is None and self.ratio is None


def log_white(mean: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3] log of the colour of a light of RGB radiance `mean` over its luminance, at most COLORED away from white."""
    luminance = float(mean @ LUMINANCE)
    if luminance <= 0:
        return np.zeros(3)
    colors: NDArray[np.float64] = np.log(np.clip(mean / luminance, 1 / COLORED, COLORED))
    return colors


def mixture_parameters(mixture: CompositeInputs) -> np.void:
    """MixtureParameters of structs.py."""
    occluded, ratio, camera = mixture.occluded, mixture.ratio, mixture.camera
    return MIXTURE_PARAMETERS(
        camera_from_volume=float16(inverse_rigid(mixture.volume_from_camera)),
        around=int4(*(box_around(mixture.virtual.boxes) if mixture.virtual else EMPTY)),
        height=camera.height,
        tolerance_m=mixture.tolerance_m,
        virtual_gain=mixture.gain,
        log_white=float4(*log_white(mixture.light.mean), float(mixture.restores_clipped)),
        light=mixture.light.layout,
        virtual_samples=grid_of(occluded, camera) if occluded else no_samples(camera),
        real_samples=grid_of(ratio, camera) if ratio else no_samples(camera),
        has_refined_occluded=mixture.refined_occluded is not None,
        has_refined_ratio=mixture.refined_ratio is not None,
    )


def launch_mixture(
    engine: Engine, file: str, name: str, mixture: CompositeInputs, parameters: np.void, *others: KernelArgument
) -> None:
    """Enqueue a kernel whose arguments are its `parameters`, MIXTURE_BUFFERS of composite_inputs.clh and `others`."""
    camera, light, virtual, ratio = mixture.camera, mixture.light, mixture.virtual, mixture.ratio
    nearest = virtual.nearest if virtual else None
    unused = engine.unused

    def given(array: cl_array.Array | None) -> cl_array.Array:
        return unused if array is None else array

    reached = mixture.reached
    if reached is None and ratio is not None and not light.discs:
        reached = mark_changes(engine, camera, mixture.surface, ratio)
    kernel = engine.kernel(
        file,
        name,
        BANDS=light.bands,
        HAS_OBJECTS=virtual is not None,
        HAS_SHADOWS=ratio is not None,
        BICUBIC=mixture.upsampling == "bicubic",
        SUBPIXELS=0 if nearest is None else nearest.shape[0] // camera.height,
        HAS_GLOSS=mixture.reflected is not None,
        HAS_DIRECT=bool(light.discs),
        LANES=engine.lanes,
    )
    engine.launch(
        kernel,
        (-(-camera.width // engine.lanes), camera.height),
        parameters,
        mixture.radiance,
        mixture.surface.positions,
        mixture.surface.normals,
        *((virtual.position, virtual.normal, virtual.base_color) if virtual else (unused, unused, unused)),
        given(nearest),
        given(mixture.reflected),
        virtual.object_index if virtual else unused,
        light.table.memory,
        mixture.occluded.values if mixture.occluded else unused,
        ratio.values if ratio else unused,
        given(reached),
        given(mixture.refined_occluded),
        given(mixture.refined_ratio),
        given(mixture.direct_virtual),
        given(mixture.direct_ratio),
        *others,
    )


def srgb_table(engine: Engine) -> cl_array.Array:
    """[65536] uint8: the sRGB code of linear radiance i / 65535."""
    return engine.buffers(_Buffers).srgb_codes.constant(_shown_codes())


def composite(engine: Engine, shown: NDArray[np.uint8], mixture: CompositeInputs) -> NDArray[np.uint8]:
    """Picture [h, w, 3] sRGB of the camera picture `shown` with what is virtual; unchanged where nothing virtual is."""
    return shown if mixture.is_nothing else engine.download(composite_on_device(engine, shown, mixture))


def composite_on_device(engine: Engine, shown: NDArray[np.uint8], mixture: CompositeInputs) -> cl_array.Array:
    """The same where something is virtual, not read yet; valid in this frame."""
    buffers, camera = engine.buffers(_Buffers), mixture.camera
    picture = engine.array_to_read((camera.height, camera.width, 3), np.uint8)
    codes = buffers.shown.upload(shown) if mixture.codes is None else mixture.codes
    others = (codes, srgb_table(engine), picture)
    launch_mixture(engine, "composite.cl", "composite", mixture, mixture_parameters(mixture), *others)
    return picture

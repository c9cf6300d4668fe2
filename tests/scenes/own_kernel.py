"""Kernels that only a test has."""

from __future__ import annotations

from collections.abc import Sequence

import pyopencl as cl

from server.opencl.device import Device
from server.opencl.program import PROLOGUE


def own_kernel(device: Device, source: str, name: str, options: Sequence[str] = ()) -> cl.Kernel:
    """Kernel `name` of `source`, held to the same warnings as the program's own; options: `-D` and others besides."""
    program = cl.Program(device.context, PROLOGUE + source).build(["-cl-std=CL1.2", "-Werror", *options])
    return cl.Kernel(program, name)

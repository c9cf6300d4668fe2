"""The process that compiles kernels beside a server (compiling.py)."""

from __future__ import annotations

import json
import os
import select
import sys
from typing import Any

import numpy as np
import pyopencl as cl

from server.opencl.compiling import DONE, NICENESS, Launch
from server.opencl.device import Device, open_device
from server.opencl.program import KernelBuildError

LARGEST_TYPE = 128
"""Bytes of `long16`, by which OpenCL aligns memory (specification of OpenCL 1.2, 5.2.1 and 6.1.5)."""


def main() -> None:
    """The process: `DEVICE IDLE_S`; requests come as lines of JSON, each is answered by a line."""
    os.nice(NICENESS)
    # unbuffered, so that `select` sees what is left
    requests, answers = os.fdopen(os.dup(0), "rb", 0), os.fdopen(os.dup(1), "wb", 0)
    os.dup2(2, 1)  # what a driver prints is no answer
    device, idle_s = open_device(sys.argv[1]), float(sys.argv[2])
    while select.select([requests], [], [], idle_s)[0]:
        line = requests.readline()
        if not line:
            return  # the server has ended
        _do(device, json.loads(line))
        answers.write(DONE)


def _do(device: Device, request: dict[str, Any]) -> None:
    try:
        program = device.programs.get(request["file"], request["defines"])
    except KernelBuildError:
        return  # the server finds the same
    if request["launch"] is None:
        return
    launch = Launch(**request["launch"])
    kernel, queue = cl.Kernel(program, launch.kernel), cl.CommandQueue(device.context)
    arguments = [bytes.fromhex(one) if isinstance(one, str) else zeros(device.context, one) for one in launch.arguments]
    kernel.set_args(*arguments)  # which keeps none of them alive
    offset = None if launch.offset is None else tuple(launch.offset)
    cl.enqueue_nd_range_kernel(queue, kernel, tuple(launch.size), tuple(launch.local), offset)
    queue.finish()


def zeros(context: cl.Context, size: int | None) -> cl.Buffer | None:
    """Memory of `size` bytes that is all zeros; what no kernel touches takes none of the machine's. None: no memory.

    It is aligned as memory that PoCL allocates is: kernels are compiled to rely on it, and crash where it is not.
    """
    if size is None:
        return None
    host = np.zeros(size + LARGEST_TYPE, np.uint8)
    start = -host.ctypes.data % LARGEST_TYPE
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR
    return cl.Buffer(context, flags, hostbuf=host[start : start + size])

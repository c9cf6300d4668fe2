"""`python -m server.opencl.link_probe` runs a kernel on PoCL's processor: status 0 if that works (see linker.py)."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from server.opencl.pocl_cpu import is_pocl, name_unknown_cpu

_SOURCE = "kernel void probe(global int *x) { x[0] = 7; }"


def main() -> None:
    """Raises, or ends by PoCL's own hand, where a kernel cannot be linked."""
    devices = [device for platform in cl.get_platforms() if is_pocl(platform) for device in platform.get_devices()]
    name_unknown_cpu(devices[0])
    context = cl.Context([devices[0]])
    queue = cl.CommandQueue(context)
    value = np.zeros(1, np.int32)
    buffer = cl.Buffer(context, cl.mem_flags.WRITE_ONLY, value.nbytes)
    cl.Program(context, _SOURCE).build("-cl-std=CL1.2").probe(queue, (1,), None, buffer)
    cl.enqueue_copy(queue, value, buffer)
    if value[0] != 7:
        raise RuntimeError(f"the kernel wrote {value[0]}, expected 7")


if __name__ == "__main__":
    main()

"""How far a float32 kernel may be from its float64 twin: one place, one figure a kind of device."""

from server.opencl.device import Device


def relative_tolerance(device: Device) -> float:
    """Relative difference that rounding alone may cause, for values that no subtraction has shortened.

    A chain of some ten float32 operations rounds to 1e-6; 1e-5 leaves room for another order of them. GPUs may divide
    and take roots less exactly (OpenCL 1.2, 7.4: up to 3 ulp each) and contract differently.
    """
    return 1e-4 if device.is_gpu else 1e-5

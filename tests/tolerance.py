"""How far a device may be from a float64 reference: stated once for all kernel tests."""

from server.opencl.device import Device


def relative(device: Device) -> float:
    """Relative tolerance of elementwise float32 arithmetic: OpenCL's GPU maths functions may be several ulp off."""
    return 1e-4 if device.is_gpu else 1e-5

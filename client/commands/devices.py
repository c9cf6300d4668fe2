"""`probeless devices`: list the OpenCL devices, with the one that is used by default and the reason."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from server.opencl.device import DeviceError, DeviceInfo, list_devices
from server.opencl.linker import CANNOT_LINK


def show_devices(console: Console | None = None) -> None:
    """Print the table. Raises DeviceError if no device is usable."""
    infos = list_devices()
    chosen = next((info for info in infos if info.usable is None), None)
    if infos:
        (console or Console()).print(_table(infos, chosen))
    if chosen is None:
        unlinked = [info.usable for info in infos if info.usable and CANNOT_LINK in info.usable]
        advice = unlinked[0] if unlinked else "install a driver, or PoCL with pip install 'pyopencl[pocl]'"
        raise DeviceError(f"no usable OpenCL device: {advice}")


def why(info: DeviceInfo, chosen: DeviceInfo | None, infos: list[DeviceInfo]) -> str:
    """Reason why this device is or is not used by default."""
    if info.usable is not None:
        return info.usable
    if info is not chosen:
        return "usable: name it with --device"
    others = len(infos) - 1
    reason = "GPUs come first" if "GPU" in info.kind else "no usable GPU"
    return f"would be used: {reason if others else 'the only one'}"


def _table(infos: list[DeviceInfo], chosen: DeviceInfo | None) -> Table:
    table = Table("", "platform", "device", "kind", "units", "memory", "why", title="OpenCL devices")
    for info in infos:
        mark = "*" if info is chosen else ""
        memory = f"{info.memory_bytes / 2**30:.1f} GiB"
        units = str(info.compute_units)
        table.add_row(mark, info.platform, info.name, info.kind, units, memory, why(info, chosen, infos))
    return table

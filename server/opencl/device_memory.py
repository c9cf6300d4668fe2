"""How much memory of a device is in use."""

from __future__ import annotations

from threading import Lock
from typing import Protocol
from weakref import ref


class Holder(Protocol):
    """An owner of arrays on the device."""

    @property
    def bytes_held(self) -> int:
        """Device memory."""


class DeviceMemory:
    """Sums the memory of all owners on one device. Thread-safe; owners that were deleted do not count."""

    def __init__(self) -> None:
        self._holders: dict[int, ref[Holder]] = {}
        self._changing = Lock()

    def add(self, holder: Holder) -> None:
        """Count the memory of `holder` from now on."""
        with self._changing:
            self._holders = {key: held for key, held in self._holders.items() if held() is not None}
            self._holders[id(holder)] = ref(holder)

    @property
    def bytes_held(self) -> int:
        """Device memory of all owners."""
        with self._changing:
            holders = [held() for held in self._holders.values()]
        return sum(holder.bytes_held for holder in holders if holder is not None)

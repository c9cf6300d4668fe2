"""Who holds memory of a device, so that it can be said how much there is."""

from __future__ import annotations

from threading import Lock
from typing import Protocol
from weakref import ref


class Holder(Protocol):
    """Something with arrays on the device."""

    @property
    def bytes_held(self) -> int:
        """Device memory."""


class DeviceMemory:
    """Of one device, for any thread. Who is gone holds nothing."""

    def __init__(self) -> None:
        self._holders: dict[int, ref[Holder]] = {}
        self._changing = Lock()

    def add(self, holder: Holder) -> None:
        """From now on it is counted."""
        with self._changing:
            self._holders = {key: held for key, held in self._holders.items() if held() is not None}
            self._holders[id(holder)] = ref(holder)

    @property
    def bytes_held(self) -> int:
        """Of all together."""
        with self._changing:
            holders = [held() for held in self._holders.values()]
        return sum(holder.bytes_held for holder in holders if holder is not None)

"""A copy of device memory on its way to the host: begun now, waited for where its values are needed."""

from __future__ import annotations

from typing import Any

import pyopencl as cl
import pyopencl.array as cl_array
from numpy.typing import NDArray

from server.opencl.profile import Profile


class PendingRead:
    """Made by Engine.begin_download."""

    def __init__(self, queue: cl.CommandQueue, array: cl_array.Array, profile: Profile) -> None:
        self._profile = profile
        self._values, self._event = array.get_async(queue)
        profile.copies += 1
        queue.flush()  # a driver may keep what is enqueued until somebody waits

    def result(self, *, is_counted: bool = False) -> NDArray[Any]:
        """The array as it was when the read was begun. A read that has to be waited for is counted, as is one that
        `is_counted` anyway."""
        if is_counted or self._event.command_execution_status != cl.command_execution_status.COMPLETE:
            self._profile.count_read(self._values.nbytes)
        self._event.wait()
        return self._values

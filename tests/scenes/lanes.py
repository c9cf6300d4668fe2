"""Engines that choose how many neighbouring samples a work-item handles."""

from __future__ import annotations

import pytest

from server.opencl.engine import Engine


class Narrow(Engine):
    """Runs kernels as on a GPU."""

    @property
    def lanes(self) -> int:
        return 1


class Wide(Engine):
    """Runs kernels as on a processor."""

    @property
    def lanes(self) -> int:
        return 8


KINDS = pytest.mark.parametrize("kind", [Narrow, Wide])
"""Runs a test with both; its `kind` is the engine's class."""

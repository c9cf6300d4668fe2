"""include/sh.clh against the host's basis and scipy's."""

from __future__ import annotations

import numpy as np
import pytest

from server.maths import sh
from server.opencl.device import Device
from server.opencl.engine import Engine
from server.opencl.program import with_headers
from tests.reference.sh import lambert_bands, sh_basis
from tests.scenes.lights import random_directions
from tests.scenes.own_kernel import own_kernel
from tests.scenes.sh_kernel import AXES, NEAR_POLES, SOURCE
from tests.scenes.tolerance import relative_tolerance


@pytest.mark.parametrize("bands", range(2, 7))
def test_basis_and_lambert(device: Device, engine: Engine, bands: int) -> None:
    kernel = own_kernel(device, with_headers(SOURCE, "evaluate.cl"), "evaluate", [f"-DBANDS={bands}"])
    directions = np.concatenate([AXES, NEAR_POLES, random_directions(500, 1)]).astype(np.float32)
    space, count = engine.workspace, len(directions)
    basis = space.array("basis", (count, bands * bands), np.float32)
    lambert = space.array("lambert", (bands,), np.float32)
    engine.launch(kernel, (count,), count, space.upload("directions", directions), basis, lambert)
    exact = directions.astype(np.float64)
    # Recurrences of a dozen float32 operations on values below 2: absolute, because functions cross zero.
    atol = 0.2 * relative_tolerance(device)
    np.testing.assert_allclose(engine.download(basis), sh.sh_basis(exact, bands), atol=atol)
    np.testing.assert_allclose(engine.download(basis), sh_basis(exact, bands), atol=2 * atol)  # scipy takes unit length
    np.testing.assert_allclose(engine.download(lambert), lambert_bands(bands), atol=1e-8)

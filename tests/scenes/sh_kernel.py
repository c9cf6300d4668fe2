"""Spherical harmonics as a kernel, and directions where they are hard: along the axes and beside the poles."""

from __future__ import annotations

import numpy as np

from tests.scenes.lights import unit

SOURCE = """
#include "sh.clh"
kernel void evaluate(const int count, const global float *directions, global float *basis, global float *lambert) {
    const int i = get_global_id(0);
    if (i >= count) return;
    float y[COEFFICIENTS];
    sh_basis(vload3(i, directions), y);
    for (int c = 0; c < COEFFICIENTS; c++) basis[i * COEFFICIENTS + c] = y[c];
    if (i < BANDS) lambert[i] = lambert_band(i);
}
"""
AXES = np.concatenate([np.eye(3), -np.eye(3)])
NEAR_POLES = unit([[1e-9, 0, 1], [0, -1e-7, 1], [1e-4, 1e-4, -1], [0, 1e-3, -1]])

"""More polyhedra: roofs, shafts and spires, positioned by the centre of the bottom face."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from client.synthetic.solids.polyhedra import Polyhedron

Place = tuple[float, float, float]


def gable(foot: Place, size: tuple[float, float, float], rotation: NDArray[np.float64] | None = None) -> Polyhedron:
    """A gable roof: `size` is the length along the ridge (x), the height and the width; metres."""
    length, height, width = size
    eaves = [(x, 0, z) for x in (-length / 2, length / 2) for z in (-width / 2, width / 2)]
    ridge = [(x, height, 0) for x in (-length / 2, length / 2)]
    faces = [(0, 1, 2), (0, 4, 2), (1, 5, 3), (0, 1, 4), (2, 3, 5)]
    return _polyhedron(np.array([*eaves, *ridge], float), faces, foot, rotation)


def frustum(
    foot: Place, sides: int, radii: tuple[float, float], height: float, rotation: NDArray[np.float64] | None = None
) -> Polyhedron:
    """A tapered shaft with `sides` equal sides and `radii` to the corners at bottom and top (0: a spire).

    One side faces +z.
    """
    angle = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    ring = np.stack([np.sin(angle), np.zeros(sides), np.cos(angle)], axis=1)
    if radii[1]:
        top = radii[1] * ring + (0, height, 0)
        faces = [(k, (k + 1) % sides, sides + k) for k in range(sides)] + [(sides, sides + 1, sides + 2)]
    else:
        top = np.array([[0, height, 0]])
        faces = [(k, (k + 1) % sides, sides) for k in range(sides)]
    return _polyhedron(np.concatenate([radii[0] * ring, top]), [(0, 1, 2), *faces], foot, rotation)


def _polyhedron(
    corners: NDArray[np.float64],
    faces: list[tuple[int, int, int]],
    foot: Place,
    rotation: NDArray[np.float64] | None,
) -> Polyhedron:
    """The convex solid of these corners; `faces`: three corners of each. Rotated, then moved to `foot`."""
    a, b, c = (corners[[face[k] for face in faces]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    outward = np.sign(((a - corners.mean(axis=0)) * normals).sum(axis=1))
    matrix = np.eye(3) if rotation is None else rotation
    normals = outward[:, None] * normals @ matrix.T
    corners = corners @ matrix.T + np.array(foot)
    return Polyhedron(normals, (normals * corners[[face[0] for face in faces]]).sum(axis=1), corners)

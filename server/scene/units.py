"""The unit of a model's numbers, guessed from their size."""

from __future__ import annotations

from server.scene.mesh import Mesh

LARGEST_M = 3.0
"""Things that are put into a room are smaller: a wardrobe, a sofa."""
_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}


def guessed_unit(mesh: Mesh) -> tuple[str, float]:
    """Name and metres of the first unit in which the model is not larger than LARGEST_M; mm if it is in all.

    glTF is in metres by its specification, yet many files are not. Y-up files come from graphics, where centimetres are
    next; z-up ones (PLY, STL) from scanners and printers, which use millimetres.
    """
    low, high = mesh.bounds
    size = float((high - low).max())
    names = ("m", "cm", "mm") if mesh.up_axis == "y" else ("m", "mm")
    name = next((name for name in names if size * _UNITS[name] <= LARGEST_M), "mm")
    return name, _UNITS[name]

"""What the thesis (Gruber 2015) measured, by our names of presets and rows; its figures are told in words."""

from __future__ import annotations

from collections.abc import Mapping

PRESETS = ("rm", "reg4", "reg8", "art1", "art4", "art8")
"""Of thesis 6.1.3."""
THESIS_NAME = {"rm": "GR12", "art4": "GR14", "gr15": "GR15", "gr15fast": "GR15FAST"}
"""Of 6.2.3 and 7.4; RM is GR12, ART4 is GR14."""
FAMILIES = tuple(THESIS_NAME)

STATIC, MOVING = "static", "moving"

DOTS: Mapping[str, Mapping[str, tuple[float, float]]] = {
    STATIC: {
        "rm": (0.9488, 0.0348),
        "reg4": (0.9399, 0.0446),
        "reg8": (0.9393, 0.0449),
        "art1": (0.9574, 0.0320),
        "art4": (0.9475, 0.0412),
        "art8": (0.9521, 0.0376),
    },
    MOVING: {
        "rm": (0.9616, 0.0196),
        "reg4": (0.9606, 0.0261),
        "reg8": (0.9626, 0.0257),
        "art1": (0.9621, 0.0186),
        "art4": (0.9559, 0.0302),
        "art8": (0.9624, 0.0256),
    },
}
"""Table 6.1: mean and standard deviation of the dot product of dominant directions, by path of the camera."""

TRANSFER_MS = {"rm": 203.5, "reg4": 88.886, "reg8": 83.385, "art1": 117.06, "art4": 85.306, "art8": 79.827}
"""Fig. 6.5: radiance transfer and light estimation, 640x480, 268^3 voxels, 81 rays of 10 cm."""

ROWS = {
    "fps": "FPS",
    "total": "Update",
    "input": "Input",
    "reconstruct": "Reconstruct",
    "surface": "Surface",
    "dynamic_geometry": "DynGeo",
    "radiance_transfer": "RadTransfer",
    "light_estimation": "LightEst",
    "rendering": "Rendering",
}
"""Of tables 6.2 and 6.3, in their order; all but FPS are milliseconds."""


def _column(*values: float) -> dict[str, float]:
    return dict(zip(ROWS, values, strict=True))


TABLE_6_2 = {
    "rm": _column(5.8, 172.45, 7.3, 11.1, 6.69, 0, 130.48, 3.86, 0.92),
    "gr15": _column(13.98, 71.5, 7.06, 10.9, 12.57, 1.19, 36.22, 2.67, 0.86),
    "art4": _column(12.29, 81.36, 7.44, 10.24, 6.69, 0, 50.54, 5.27, 0.98),
    "gr15fast": _column(22.46, 44.53, 7.02, 10.64, 12.6, 1.02, 10.5, 1.8, 0.87),
}
"""GeForce GTX 780, 256^3 voxels over 2 m."""

MACHINES = {"PC": "GeForce GTX 780", "NB": "Quadro K2100M", "M": "GT640M LE (tablet)"}
TABLE_6_3 = {
    "gr15": {
        "PC": _column(18.24, 54.8, 0.8, 9.42, 5.28, 1.27, 34.57, 2.56, 0.89),
        "NB": _column(3.23, 309.86, 0.86, 37.68, 30.73, 18.25, 214.27, 4.56, 3.52),
        "M": _column(2.19, 456.78, 1.29, 66.0, 45.68, 25.77, 314.68, 1.98, 1.36),
    },
    "gr15fast": {
        "PC": _column(33.60, 29.76, 0.79, 9.42, 5.28, 1.12, 9.96, 1.93, 1.24),
        "NB": _column(7.34, 136.24, 0.81, 36.86, 30.02, 17.89, 38.69, 8.52, 3.43),
        "M": _column(5.0, 200.48, 0.9, 66.16, 44.99, 25.75, 59.17, 2.24, 1.26),
    },
}
"""64^3 voxels and no D'''."""

RAY_LENGTHS_M = (0.0, 0.05, 0.1, 0.2)
"""Of fig. 5.7, whose text says 0 to 0.2 m in four steps; the two between are ours."""

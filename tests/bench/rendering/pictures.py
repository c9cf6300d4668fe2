"""Composites to look at: beside the truth and what pasting makes of it, with maps of what differs.

`draw_set` is for judging one set; `preset_strip` and `bounce_strip` are rows of the thesis's fig. 7.11 and 7.10, which
`stack` makes a sheet of.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.bench.rendering.flip import Codes, flip_map
from tests.bench.report.drawing import Picture, side_by_side
from tests.bench.truth.composite_truth import CompositeTruth, linear_from_codes

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

SHOWN_CHANGE = 0.15
"""Of linear luminance, at which a map of changes is fully red or blue."""
SHOWN_BOUNCE = 0.04
"""Of linear radiance, at which a map of indirect light is fully bright about its grey."""
ON_OBJECTS = 0.2
"""A map of indirect light shows so much less of what arrives on the objects, which is all of it and not a change."""
CROP, ENLARGED = (120, 200), 2
"""Height and width of the part that a strip shows, and how much larger."""
JPEG_QUALITY = 88
STRIPS = "strips"


def bgr(codes: Codes) -> Picture:
    """A picture as cv2 has it."""
    return np.ascontiguousarray(codes[..., ::-1])


def flip_picture(reference: Codes, test: Codes) -> Picture:
    """Black where the two look the same, white where they could not look more different."""
    shown = (255 * np.clip(flip_map(reference, test), 0, 1)).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(shown, cv2.COLORMAP_MAGMA), np.uint8)


def change_picture(change: Floats, greatest: float = SHOWN_CHANGE) -> Picture:
    """[h, w] white where there is none, red where it is darker, blue where it is brighter."""
    share = np.clip(change / greatest, -1, 1)
    keep = 1 - np.abs(share)
    shown = np.stack([np.where(share < 0, keep, 1), keep, np.where(share > 0, keep, 1)], axis=-1)
    return (255 * shown + 0.5).astype(np.uint8)


def tinted(change: Floats, greatest: float = SHOWN_BOUNCE) -> Picture:
    """[h, w, 3] a change in its own colours about grey."""
    return bgr((127.5 + 127.5 * np.clip(change / greatest, -1, 1)).astype(np.uint8))


def draw_set(path: Path, truth: CompositeTruth, composites: Mapping[str, list[Codes]], index: int) -> None:
    """Every composite of one frame, its FLIP map, the change that it predicts, and how that errs."""
    wanted, shown, pasted = truth.wanted[index], truth.shown[index], truth.pasted[index]
    without, true = _luminance(shown), _luminance(wanted)
    cells = [("camera", bgr(shown)), ("truth", bgr(wanted))]
    cells += [("change: red darker, blue brighter", change_picture(true - without))]
    cells += [("what the objects change", bgr(np.repeat(truth.changed[index][..., None], 3, axis=2) * np.uint8(255)))]
    for name, codes in {"pasted without shadows": pasted, **{k: v[index] for k, v in composites.items()}}.items():
        cells += [(name, bgr(codes)), ("FLIP", flip_picture(wanted, codes))]
        cells += [("its change of luminance", change_picture(_luminance(codes) - without))]
        cells += [("too dark red, too bright blue", change_picture(_luminance(codes) - true))]
    save_jpeg(path, side_by_side(cells, columns=4))


def preset_strip(
    folder: Path, name: str, truth: CompositeTruth, composites: Mapping[str, list[Codes]], index: int
) -> None:
    """A row of fig. 7.11: the truth and the presets, and below how each differs from it in luminance."""
    window = around_objects(truth.objects[index])
    wanted = truth.wanted[index]
    true = _luminance(wanted)
    cells = [(f"{name}: truth", bgr(wanted)), *((label, bgr(found[index])) for label, found in composites.items())]
    maps = [("darker red, brighter blue", np.full_like(wanted, 255))]
    maps += [("", change_picture(_luminance(found[index]) - true)) for found in composites.values()]
    enlarged = [(words, _enlarged(picture[window])) for words, picture in cells + maps]
    save_strip(folder, f"presets {name}", side_by_side(enlarged, columns=len(cells)))


def bounce_strip(
    folder: Path, name: str, without: Codes, with_it: Codes, ours: Floats, true: Floats, objects: Bools
) -> None:
    """A row of fig. 7.10: without indirect light, with it, the difference; and indirect light, ours and the true one.

    `ours`, `true` [h, w, 3]: what global illumination adds to direct light, to the change that the objects make; on the
    objects, all that it adds.
    """
    window = around_objects(objects)
    difference = linear_from_codes(with_it) - linear_from_codes(without)
    gain = np.where(objects[..., None], ON_OBJECTS, 1.0)
    cells = [
        (f"{name}: without indirect light", bgr(without)),
        ("with", bgr(with_it)),
        ("their difference about grey", tinted(gain * difference)),
        ("indirect light, ours", tinted(gain * ours)),
        ("indirect light, path tracer's", tinted(gain * true)),
    ]
    enlarged = [(words, _enlarged(picture[window])) for words, picture in cells]
    save_strip(folder, f"bounce {name}", side_by_side(enlarged, columns=len(cells)))


def around_objects(objects: Bools) -> tuple[slice, slice]:
    """Rows and columns of what lies around the objects."""
    rows, columns = np.nonzero(objects.any(axis=1))[0], np.nonzero(objects.any(axis=0))[0]
    height, width = objects.shape
    middle = [(rows[0] + rows[-1]) // 2, (columns[0] + columns[-1]) // 2]
    starts = [int(np.clip(m - s // 2, 0, limit - s)) for m, s, limit in zip(middle, CROP, (height, width), strict=True)]
    return slice(starts[0], starts[0] + CROP[0]), slice(starts[1], starts[1] + CROP[1])


def stack(folder: Path, first_word: str, path: Path, rows: Sequence[str] = (), share: float = 1.0) -> bool:
    """Put the strips whose names begin with `first_word` below each other, or those of `rows` alone, `share` as large.

    False where there are none.
    """
    found = sorted((folder / STRIPS).glob(f"{first_word}_*.png"))
    wanted = [file for file in found if not rows or file.stem.removeprefix(f"{first_word}_") in rows]
    if not wanted:
        return False
    strips = [cv2.resize(cv2.imread(str(f)), None, fx=share, fy=share, interpolation=cv2.INTER_AREA) for f in wanted]
    width = max(strip.shape[1] for strip in strips)
    wide = [cv2.copyMakeBorder(s, 0, 0, 0, width - s.shape[1], cv2.BORDER_CONSTANT, value=(255,) * 3) for s in strips]
    save_jpeg(path, np.vstack(wide))
    return True


def save_strip(folder: Path, name: str, picture: Picture) -> None:
    """Keep a row for `stack`, without loss. Raises OSError."""
    _write(folder / STRIPS / f"{name.replace(' ', '_')}.png", picture, [])


def save_jpeg(path: Path, picture: Picture) -> None:
    """Write a JPEG. Raises OSError."""
    _write(path, picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])


def _write(path: Path, picture: Picture, parameters: Sequence[int]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), picture, parameters):
        raise OSError(f"{path} cannot be written")


def _enlarged(picture: Picture) -> Picture:
    return np.ascontiguousarray(picture.repeat(ENLARGED, axis=0).repeat(ENLARGED, axis=1))


def _luminance(codes: Codes) -> Floats:
    shown: Floats = linear_from_codes(codes) @ np.array([0.2126, 0.7152, 0.0722])
    return shown

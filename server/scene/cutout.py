"""Alpha cutout (glTF's alphaMode MASK): cuts triangles along the outline of their texture's alpha channel.

The cut is made once, when the file is read. The result is an ordinary mesh, whose outline is used for visibility,
shadows and light without alpha tests. Triangles that cross the outline are bisected until they are about a texel in
size, or until there are too many, and are then cut along a straight line.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from server.scene.limits import MAX_CUTOUTS, MeshError
from server.scene.materials import Beyond, Texture
from server.scene.mesh_parts import MeshPart
from server.scene.normals import numbered, unit

MOST_SIDE = 512
"""Largest side of the image in which outlines are found, texels."""
MOST_TRIANGLES = 200_000
"""Limit on the triangles that cutting adds to a file."""
SMALL_TEXELS = 1.5
"""Triangles with shorter edges are not bisected."""
_MOST_HALVINGS = 10

Floats = NDArray[np.float64]
_UV = slice(9, 11)


@dataclass(frozen=True)
class Outline:
    """Opacity test for one texture."""

    excess: Floats
    """[h, w] opacity minus the cutoff."""
    beyond: tuple[Beyond, Beyond]
    """Wrap mode in u and in v."""
    sums: NDArray[np.int64]
    """[H + 1, W + 1] summed-area table of the kept texels; over two periods if the texture repeats."""

    @classmethod
    def of(cls, texture: Texture, opacity: float, cutoff: float) -> Outline:
        """For a texture with an alpha channel, which is multiplied by `opacity`."""
        assert texture.alpha is not None
        alpha = texture.alpha
        height, width = (min(side, MOST_SIDE) for side in alpha.shape)
        small = cv2.resize(alpha, (width, height), interpolation=cv2.INTER_AREA)
        excess = opacity / 255.0 * np.asarray(small, np.float64) - cutoff
        kept = excess >= 0
        for axis, beyond in zip((1, 0), texture.beyond, strict=True):
            if beyond is Beyond.MIRROR:
                kept = np.concatenate([kept, np.flip(kept, axis)], axis)
            if beyond is not Beyond.CLAMP:
                kept = np.concatenate([kept, kept], axis)
        sums = np.pad(kept.astype(np.int64).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
        return cls(excess, texture.beyond, sums)

    @property
    def size(self) -> Floats:
        """[2] width and height in texels."""
        return np.array(self.excess.shape[::-1], np.float64)

    def at(self, uv: Floats) -> Floats:
        """[n] excess at coordinates [n, 2], bilinear."""
        place = uv * self.size - 0.5
        low = np.floor(place).astype(np.int64)
        share = place - low
        total = np.zeros(len(uv))
        for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
            x, y = (_inside(low[:, k] + d, int(self.size[k]), self.beyond[k]) for k, d in ((0, dx), (1, dy)))
            weight = np.where(dx, share[:, 0], 1 - share[:, 0]) * np.where(dy, share[:, 1], 1 - share[:, 1])
            total += weight * self.excess[y, x]
        return total

    def kept_shares(self, low: Floats, high: Floats) -> Floats:
        """[n] share of kept texels that boxes of coordinates [n, 2] may read: 1 all, 0 none."""
        first, last = np.floor(low * self.size - 0.5).astype(np.int64), np.floor(high * self.size - 0.5).astype(int) + 1
        ends = []
        for k in (0, 1):
            side, a, b = int(self.size[k]), first[:, k], last[:, k]
            if self.beyond[k] is Beyond.CLAMP:
                a, b = np.clip(a, 0, side - 1), np.clip(b, 0, side - 1)
            else:
                period = side * (2 if self.beyond[k] is Beyond.MIRROR else 1)
                b = np.minimum(b, a + period - 1)
                a, b = a % period, a % period + b - a
            ends.append((a, b + 1))
        (left, right), (top, bottom) = ends
        inside = self.sums[bottom, right] - self.sums[top, right] - self.sums[bottom, left] + self.sums[top, left]
        shares: Floats = inside / ((right - left) * (bottom - top))
        return shares


def _inside(index: NDArray[np.int64], side: int, beyond: Beyond) -> NDArray[np.int64]:
    if beyond is Beyond.CLAMP:
        return np.clip(index, 0, side - 1)
    if beyond is Beyond.MIRROR:
        turned = index % (2 * side)
        return np.where(turned < side, turned, 2 * side - 1 - turned)
    return index % side


def cut_out(parts: list[MeshPart]) -> list[MeshPart]:
    """The parts (with normals) after the cutout; empty parts are removed. Raises MeshError for too many materials."""
    share = MOST_TRIANGLES // max(sum(part.material.cutoff is not None for part in parts), 1)
    outlines: dict[tuple[int, float, float], Outline] = {}
    cut = [part if part.material.cutoff is None else _cut(part, share, outlines) for part in parts]
    return [part for part in cut if len(part.triangles)]


def _has_area(corners: Floats) -> NDArray[np.bool_]:
    """[t] triangles [t, 3, columns] whose area is above rounding error."""
    a, b, c = (corners[:, k, :3] for k in range(3))
    longest = np.maximum(np.linalg.norm(b - a, axis=1), np.linalg.norm(c - a, axis=1))
    good: NDArray[np.bool_] = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-6 * longest**2
    return good


def _cut(part: MeshPart, most: int, outlines: dict[tuple[int, float, float], Outline]) -> MeshPart:
    material = part.material
    assert material.cutoff is not None
    texture = material.color_texture
    if texture is None or texture.alpha is None:
        return part if material.opacity >= material.cutoff else replace(part, triangles=part.triangles[:0])
    key = (id(texture), material.opacity, material.cutoff)
    if key not in outlines:
        if len(outlines) == MAX_CUTOUTS:
            raise MeshError(f"more than {MAX_CUTOUTS} materials are cut out by their textures: join them")
        outlines[key] = Outline.of(texture, material.opacity, material.cutoff)
    outline = outlines[key]
    assert part.normals is not None
    columns = np.hstack([part.vertices, part.colors, part.normals, part.uv]).astype(np.float64)
    corners = _clipped(outline, *_halved(outline, columns[part.triangles], most))
    corners = corners[_has_area(corners)]
    flat = corners.reshape(-1, columns.shape[1])
    same = numbered(flat)
    _, first, inverse = np.unique(same, return_index=True, return_inverse=True)
    rows = flat[first]
    return replace(
        part,
        vertices=rows[:, :3],
        triangles=inverse.reshape(-1, 3),
        colors=rows[:, 3:6].astype(np.float32),
        normals=unit(rows[:, 6:9]),
        uv=rows[:, 9:].astype(np.float32),
    )


def _halved(outline: Outline, corners: Floats, most: int) -> tuple[Floats, Floats]:
    """Triangles [t, 3, columns] that are kept whole, and small ones that the outline crosses."""
    whole, small, left, count = [], [], corners, 0
    for _ in range(_MOST_HALVINGS):
        uv = left[..., _UV]
        shares = outline.kept_shares(uv.min(axis=1), uv.max(axis=1))
        whole.append(left[shares == 1])
        left = left[(shares > 0) & (shares < 1)]
        edges = np.linalg.norm(np.diff(left[:, [0, 1, 2, 0], _UV], axis=1) * outline.size, axis=2)
        is_small = edges.max(axis=1, initial=0.0) <= SMALL_TEXELS
        small.append(left[is_small])
        left = left[~is_small]
        count += len(whole[-1]) + len(small[-1])
        if not len(left) or count + 4 * len(left) > len(corners) + most:
            break
        a, b, c = left[:, 0], left[:, 1], left[:, 2]
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        left = np.concatenate([np.stack(quarter, axis=1) for quarter in quarters])
    return np.concatenate(whole), np.concatenate([*small, left])


def _clipped(outline: Outline, whole: Floats, crossed: Floats) -> Floats:
    """`whole`, and the kept parts of `crossed`, cut between the points where its edges cross the outline."""
    excess = outline.at(crossed[..., _UV].reshape(-1, 2)).reshape(-1, 3)
    inside = excess >= 0
    parts = [whole, crossed[inside.all(axis=1)]]
    for alone in (True, False):  # rotate so that the single corner inside, or outside, is the first
        one = inside.sum(axis=1) == (1 if alone else 2)
        turn = (inside[one] == alone).argmax(axis=1)[:, None] + np.arange(3)
        corners = np.take_along_axis(crossed[one], turn[..., None] % 3, axis=1)
        values = np.take_along_axis(excess[one], turn % 3, axis=1)
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        ab, ac = (
            a + (values[:, 0] / (values[:, 0] - values[:, k]))[:, None] * (other - a) for k, other in ((1, b), (2, c))
        )
        made = [(a, ab, ac)] if alone else [(ab, b, c), (ab, c, ac)]
        parts += [np.stack(triangle, axis=1) for triangle in made]
    return np.concatenate(parts)

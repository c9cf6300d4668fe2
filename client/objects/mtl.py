"""Material libraries of OBJ files (MTL), with the later keys for roughness and metalness (Pr, Pm)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from client.errors import ObjectError


@dataclass(frozen=True)
class TextureMap:
    """A texture file and its coordinate transform."""

    file: Path
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    clamp: bool = False


@dataclass(frozen=True)
class Material:
    """The used properties of an MTL material."""

    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """sRGB, 0 to 1."""
    texture: TextureMap | None = None
    specular: tuple[float, float, float] = (0.0, 0.0, 0.0)
    exponent: float | None = None
    """Phong exponent."""
    given_roughness: float | None = None
    given_metalness: float | None = None
    roughness_map: TextureMap | None = None
    """Its red channel multiplies the roughness, which is 1 if not given."""
    metalness_map: TextureMap | None = None
    """Its red channel multiplies the metalness, which is 1 if not given."""
    unread: frozenset[str] = frozenset()
    """Keys of maps that are not supported."""

    @property
    def roughness(self) -> float:
        """Perceptual roughness, 0 to 1. Phong exponent n corresponds to alpha^2 = 2 / (n + 2) (Karis 2013).

        1 without a highlight, or with a map.
        """
        if self.given_roughness is not None:
            return self.given_roughness
        if self.roughness_map is not None:
            return 1.0
        shines = self.exponent is not None and any(self.specular)
        return (2 / (max(self.exponent or 0.0, 0.0) + 2)) ** 0.25 if shines else 1.0

    @property
    def metalness(self) -> float:
        """0 to 1: the given value, else 1 with a map and 0 without."""
        if self.given_metalness is not None:
            return self.given_metalness
        return 0.0 if self.metalness_map is None else 1.0


def read_materials(path: Path) -> dict[str, Material]:
    """Materials by name. Raises ObjectError with file and line."""
    materials: dict[str, Material] = {}
    name = ""
    for number, line in enumerate(path.read_text("utf-8", errors="replace").splitlines(), 1):
        match line.split("#")[0].split():
            case ["newmtl", *words]:
                name = " ".join(words)
                materials[name] = Material()
            case [key, *words] if name in materials:
                materials[name] = _with_entry(materials[name], path, number, key, words)
    return materials


def _with_entry(material: Material, path: Path, number: int, key: str, words: list[str]) -> Material:
    """The material with one line of the library added. Raises ObjectError."""
    match key:
        case "Kd":
            material = replace(material, color=_rgb(path, number, key, words))
        case "Ks":
            material = replace(material, specular=_rgb(path, number, key, words))
        case "Ns":
            material = replace(material, exponent=_numbers(path, number, key, words, 1)[0])
        case "Pr":
            material = replace(material, given_roughness=_clipped(_numbers(path, number, key, words, 1)[0]))
        case "Pm":
            material = replace(material, given_metalness=_clipped(_numbers(path, number, key, words, 1)[0]))
        case "map_Kd" if words:
            material = replace(material, texture=_texture_map(path, words))
        case "map_Pr" if words:
            material = replace(material, roughness_map=_texture_map(path, words))
        case "map_Pm" if words:
            material = replace(material, metalness_map=_texture_map(path, words))
        case "map_Ns" | "map_Ks" | "map_d" | "map_Bump" | "map_bump" | "norm":
            material = replace(material, unread=material.unread | {key})
    return material


def _rgb(path: Path, number: int, key: str, words: list[str]) -> tuple[float, float, float]:
    red, green, blue = (_clipped(value) for value in _numbers(path, number, key, words, 3))
    return red, green, blue


def _clipped(value: float) -> float:
    return min(max(value, 0.0), 1.0)


def _numbers(path: Path, number: int, key: str, words: list[str], count: int) -> list[float]:
    try:
        values = [float(word) for word in words[:count]]
    except ValueError:
        values = []
    if len(values) < count or not np.isfinite(values).all():
        counted = {1: "one number", 3: "three numbers"}[count]
        raise ObjectError(f"{path}, line {number}: {key} needs {counted}")
    return values


def _texture_map(path: Path, words: list[str]) -> TextureMap:
    """The file after the options of a map; names may contain spaces, so the longest existing tail is used."""
    for start in range(len(words)):
        file = path.parent / " ".join(words[start:]).replace("\\", "/")
        if file.is_file():
            scale, offset = (_option(words[:start], name, default) for name, default in (("-s", 1.0), ("-o", 0.0)))
            return TextureMap(file, scale, offset, clamp="-clamp on" in " ".join(words[:start]).lower())
    raise ObjectError(f"{path.parent / words[-1]}: the texture that {path.name} names is missing")


def _option(words: list[str], name: str, default: float) -> tuple[float, float]:
    """The first two of up to three numbers after an option."""
    values = [default, default]
    if name in words:
        for k, word in enumerate(words[words.index(name) + 1 :][:2]):
            try:
                values[k] = float(word)
            except ValueError:
                break
    return values[0], values[1]

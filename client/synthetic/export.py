"""Export of a synthetic scene as a folder of the ground-truth layout.

    write_ground_truth(open_synthetic("synthetic:stage?texture=town&with=ball"), Path("out/stage"), range(0, 60, 10))

The guests on the stage set (`with=`) become virtual objects: `color` and `depth` are without them, `with_objects` is
the exact picture with them, `objects/*.ply` are their meshes in world coordinates.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from client.errors import SourceError
from client.sources.poses import quaternion
from client.synthetic.scenes.guests import Guest
from client.synthetic.solids.tessellate import Triangles, can_tessellate, triangles_of
from client.synthetic.source import SyntheticSource, Truth

_NORMAL, _ALBEDO = np.float16, np.float16
_KEYS = {"appearance": "look"}
"""Keys of scene.json that differ from the names of the options."""


def write_ground_truth(source: SyntheticSource, folder: Path, frames: Sequence[int]) -> None:
    """Write `frames` of the scene, numbered from 0. Depth has the source's noise, `truth` is exact.

    Raises SourceError unless the light is one constant distant light, OSError if it cannot be written.
    """
    if source.lamps or source.options.name == "light" or source.options.exposure != "constant":
        raise SourceError(f"{source.name}: cannot be exported, because light.json holds one constant distant light")
    bare = SyntheticSource(replace(source.options, guest="none"))
    for name in ("color", "depth", "truth", *(("objects", "with_objects") if source.guests else ())):
        (folder / name).mkdir(parents=True, exist_ok=True)
    truths, with_guests = [], []
    for number, index in enumerate(frames):
        truths.append(bare.truth(index))
        _write_png(folder / "depth" / f"{number:06d}.png", bare[index].depth)
        _write_png(folder / "color" / f"{number:06d}.png", linear16(truths[-1].radiance))
        if source.guests:
            with_guests.append(source.truth(index))
            _write_png(folder / "with_objects" / f"{number:06d}.png", linear16(with_guests[-1].radiance))
    for guest in source.guests:
        (folder / "objects" / f"{guest.name}.ply").write_bytes(guest_ply(guest))
    _write_json(folder / "light.json", {"sh": truths[0].sh.tolist()})
    (folder / "poses.txt").write_text("".join(_tum_line(source, index) for index in frames), encoding="utf-8")
    _write_json(folder / "meta.json", _meta(source, len(frames)))
    _write_truth(folder / "truth", source, truths, with_guests)


def guest_ply(guest: Guest) -> bytes:
    """A guest's mesh as binary PLY: world metres, normals, sRGB vertex colours."""
    return _ply(triangles_of([guest.solid]), guest.srgb)


def write_guests(folder: Path, source: SyntheticSource) -> list[Path]:
    """Write the meshes of a source's guests in world coordinates; returns the files. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{guest.name}.ply" for guest in source.guests]
    for path, guest in zip(paths, source.guests, strict=True):
        path.write_bytes(guest_ply(guest))
    return paths


def linear16(radiance: NDArray[np.float64]) -> NDArray[np.uint16]:
    """[h, w, 3] 16-bit picture of linear radiance; 1 is 65535."""
    return (np.clip(radiance, 0, 1) * 65535).round().astype(np.uint16)


def _ply(mesh: Triangles, srgb: tuple[int, int, int] | None = None) -> bytes:
    colors = None if srgb is None else np.tile(np.array([*srgb, 255], np.uint8), (len(mesh.vertices), 1))
    made = trimesh.Trimesh(
        mesh.vertices, mesh.faces, vertex_normals=mesh.normals, vertex_colors=colors, process=False, validate=False
    )
    data = made.export(file_type="ply", vertex_normal=True)
    assert isinstance(data, bytes)
    return data


def _meta(source: SyntheticSource, frames: int) -> dict[str, Any]:
    camera = source.camera
    meta: dict[str, Any] = {
        "camera": {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        "depth_scale_m": camera.depth_scale_m,
        "frames": frames,
        "depth": "depth",
        "poses": "poses.txt",
        "color": "color",
        "color_encoding": "linear16",
        "radiance_at_65535": 1.0,
        "light": "light.json",
        "up": list(source.up or ()),
    }
    if source.guests:
        meta |= {"with_objects": "with_objects", "objects": [f"objects/{guest.name}.ply" for guest in source.guests]}
    return meta


def _write_truth(folder: Path, source: SyntheticSource, bare: list[Truth], with_guests: list[Truth]) -> None:
    arrays: dict[str, NDArray[Any]] = {
        "depth_m": np.stack([truth.depth_m for truth in bare]),
        "normal_in_world": np.stack([truth.normals for truth in bare]).astype(_NORMAL),
        "albedo_textured": np.stack([truth.albedo for truth in bare]).astype(_ALBEDO),
    }
    if with_guests:
        masks = np.stack([truth.guest for truth in with_guests])
        albedo = np.stack([truth.albedo for truth in with_guests])
        arrays |= {
            "virtual_mask": masks,
            "virtual_albedo": (albedo * masks[..., None]).astype(_ALBEDO),
            "depth_with_virtual_m": np.stack([truth.depth_m for truth in with_guests]),
        }
    np.savez_compressed(folder / "geometry.npz", allow_pickle=False, **arrays)
    guests = [{"name": guest.name, "srgb": guest.srgb, "albedo": guest.albedo.tolist()} for guest in source.guests]
    options = {_KEYS.get(name, name): value for name, value in asdict(source.options).items()}
    _write_json(folder / "scene.json", {"synthetic": options, "guests": guests})
    if can_tessellate(source.scene.solids):
        (folder / "room.ply").write_bytes(_ply(triangles_of(source.scene.solids)))


def _tum_line(source: SyntheticSource, index: int) -> str:
    pose = source.pose(index)
    numbers = [index / source.fps, *pose[:3, 3], *quaternion(pose[:3, :3])]
    return " ".join(f"{number:.12g}" for number in numbers) + "\n"


def _write_png(path: Path, picture: NDArray[np.uint16]) -> None:
    swapped = picture[..., ::-1] if picture.ndim == 3 else picture
    path.write_bytes(cv2.imencode(".png", swapped)[1].tobytes())


def _write_json(path: Path, document: dict[str, Any]) -> None:
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")

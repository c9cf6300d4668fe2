"""`--scene`: the scan, the virtual objects, the lights and the camera's path as one glTF 2.0 file (GLB).

Below one node, which turns the world upright (+y up, the first camera's view near -z), all numbers are in world axes
and metres. What the materials and lights are like is in docs/exchange.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.objects.gltf_merge import append_glb
from client.results.bright_parts import BrightPart
from client.sources.poses import quaternion
from protocol.frames import CameraModel
from protocol.messages import ObjectFormat
from server.meshing.scene_mesh import SceneMesh
from server.scene.glb import add_array, to_bytes
from server.scene.mesh import Mesh, load_mesh

LIGHTS, UNLIT = "KHR_lights_punctual", "KHR_materials_unlit"
NEAREST_M = 0.01
"""Near plane of the camera."""
_CV_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])

Json = dict[str, Any]
Pose = NDArray[np.float64]


@dataclass(frozen=True)
class PlacedObject:
    """A virtual object where it stands."""

    name: str
    path: Path
    format: ObjectFormat
    data: bytes
    """Of the file, as `pack_mesh` returns it."""
    world_from_model: Pose
    """[4, 4] rotation, uniform scale, translation."""


def scene_glb(
    scan: SceneMesh,
    objects: Sequence[PlacedObject],
    lights: Sequence[BrightPart],
    path: Sequence[tuple[float, Pose]],
    camera: CameraModel,
    environment: str,
) -> bytes:
    """The GLB. `path`: (time_s, world_from_camera) of the frames; `environment`: name of the lat-long file beside it.

    Raises ObjectError or MeshError for an object's file that cannot be read.
    """
    document: Json = {"asset": {"version": "2.0", "generator": "probeless", "extras": {"environment": environment}}}
    document |= {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [], "extensionsUsed": [UNLIT]}
    body = bytearray()
    upright = np.eye(4)
    upright[:3, :3] = scan.gltf_from_world
    world: Json = {"name": "world", **_placed(upright), "children": []}
    document["nodes"].append(world)
    children: list[int] = world["children"]
    children.append(_add_scan(document, body, scan))
    children += [_add_object(document, body, item) for item in objects]
    if lights:
        children += _add_lights(document, lights, scan.gltf_from_world)
    if path:
        children.append(_add_camera(document, body, path, camera))
    return to_bytes(document, body)


def _add_scan(document: Json, body: bytearray, scan: SceneMesh) -> int:
    """Colours contain the room's light, so the material is not lit again."""
    linear = _linear(scan.colors)
    lengths = np.linalg.norm(scan.normals, axis=1, keepdims=True)
    normals = np.where(lengths > 0, scan.normals / np.maximum(lengths, 1e-12), (0.0, 0.0, 1.0)).astype(np.float32)
    rough = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    material = {"name": "scan", "pbrMetallicRoughness": rough, "extensions": {UNLIT: {}}}
    return _add_mesh(document, body, "scan", scan.vertices, normals, linear, scan.triangles, material)


def _add_object(document: Json, body: bytearray, item: PlacedObject) -> int:
    if item.format == "glb":
        children = append_glb(document, body, item.data, item.path)
    else:
        mesh = load_mesh(item.data, item.format)
        children = [_add_plain(document, body, item.name, mesh)]
    node = {"name": item.name, **_placed(item.world_from_model), "children": children}
    return _add(document, "nodes", node)


def _add_plain(document: Json, body: bytearray, name: str, mesh: Mesh) -> int:
    """Of PLY, STL and OBJ, which have vertex colours at most."""
    surface = mesh.materials[0]
    rough = {"metallicFactor": float(surface.metalness), "roughnessFactor": float(surface.roughness)}
    material = {"name": name, "pbrMetallicRoughness": rough}
    return _add_mesh(document, body, name, mesh.vertices, mesh.normals, mesh.vertex_colors, mesh.triangles, material)


def _add_mesh(
    document: Json,
    body: bytearray,
    name: str,
    vertices: NDArray[np.float32],
    normals: NDArray[np.float32],
    colors: NDArray[np.float32],
    triangles: NDArray[np.int32],
    material: Json,
) -> int:
    """Append a node with a mesh; colours are linear."""
    attributes = {
        "POSITION": add_array(document, body, vertices.astype(np.float32), bounds=True),
        "NORMAL": add_array(document, body, normals.astype(np.float32)),
        "COLOR_0": add_array(document, body, colors.astype(np.float32)),
    }
    indices = add_array(document, body, triangles.astype(np.uint32).ravel())
    primitive = {"attributes": attributes, "indices": indices, "material": _add(document, "materials", material)}
    return _add(document, "nodes", {"name": name, "mesh": _add(document, "meshes", {"primitives": [primitive]})})


def _add_lights(document: Json, lights: Sequence[BrightPart], gltf_from_world: NDArray[np.float64]) -> list[int]:
    """Directional lights; intensity in lux is the irradiance in units of the picture's radiance times steradian."""
    nodes, entries = [], []
    for number, light in enumerate(lights):
        strongest = max(light.irradiance)
        color = [value / strongest for value in light.irradiance]
        name = f"light {number}"
        entries.append({"name": name, "type": "directional", "color": color, "intensity": strongest})
        turn = quaternion(_looking_from(gltf_from_world.T @ np.array(light.direction)))
        node = {"name": name, "rotation": turn.tolist(), "extensions": {LIGHTS: {"light": number}}}
        nodes.append(_add(document, "nodes", node))
    document["extensions"] = {LIGHTS: {"lights": entries}}
    if LIGHTS not in document["extensionsUsed"]:
        document["extensionsUsed"].append(LIGHTS)
    return nodes


def _looking_from(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3, 3] rotation that takes +z to `direction`: a light shines along its node's -z."""
    z = direction / np.linalg.norm(direction)
    x = np.cross((0.0, 1.0, 0.0) if abs(z[1]) < 0.9 else (1.0, 0.0, 0.0), z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _add_camera(document: Json, body: bytearray, path: Sequence[tuple[float, Pose]], camera: CameraModel) -> int:
    """A camera node that an animation moves along the path; its place without the animation is the first frame's."""
    perspective = {
        "yfov": 2 * math.atan(camera.height / (2 * camera.fy)),
        "aspectRatio": (camera.width / camera.fx) / (camera.height / camera.fy),
        "znear": NEAREST_M,
    }
    names = ("width", "height", "fx", "fy", "cx", "cy")
    extras = {"intrinsics_px": {name: getattr(camera, name) for name in names}}
    lens = {"name": "camera", "type": "perspective", "perspective": perspective, "extras": extras}
    times_s, places, turns = _keys(path)
    node = {
        "name": "camera",
        "camera": _add(document, "cameras", lens),
        "translation": places[0].tolist(),
        "rotation": turns[0].tolist(),
    }
    index = _add(document, "nodes", node)
    if len(times_s) > 1:
        when = add_array(document, body, times_s)
        document["accessors"][when] |= {"min": [float(times_s.min())], "max": [float(times_s.max())]}
        channels: list[Json] = []
        samplers: list[Json] = []
        for target, values in (("translation", places), ("rotation", turns)):
            channels.append({"sampler": len(samplers), "target": {"node": index, "path": target}})
            samplers.append({"input": when, "output": add_array(document, body, values), "interpolation": "LINEAR"})
        document["animations"] = [{"name": "camera path", "channels": channels, "samplers": samplers}]
    return index


def _keys(path: Sequence[tuple[float, Pose]]) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Seconds after the first frame, positions [n, 3], rotations [n, 4] (x, y, z, w) whose neighbours are near."""
    times: list[float] = []
    places: list[NDArray[np.float64]] = []
    turns: list[NDArray[np.float64]] = []
    for time_s, world_from_camera in path:
        at = float(np.float32(time_s - path[0][0]))
        if times and at <= times[-1]:
            continue  # times of an animation increase strictly
        pose = world_from_camera @ _CV_FROM_GL
        turn = quaternion(pose[:3, :3])
        turns.append(-turn if turns and turn @ turns[-1] < 0 else turn)
        times.append(at)
        places.append(pose[:3, 3])
    return np.array(times, np.float32), np.array(places, np.float32), np.array(turns, np.float32)


def _add(document: Json, key: str, item: Json) -> int:
    document.setdefault(key, []).append(item)
    return len(document[key]) - 1


def _placed(matrix: Pose) -> Json:
    """The field of a node with a matrix, by columns; none if it is the unit matrix."""
    return {} if np.array_equal(matrix, np.eye(4)) else {"matrix": [float(value) for value in matrix.T.ravel()]}


def _linear(srgb8: NDArray[np.uint8]) -> NDArray[np.float32]:
    encoded = srgb8 / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return linear.astype(np.float32)

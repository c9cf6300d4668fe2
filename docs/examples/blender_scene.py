"""Render the scene of a run with Blender: the virtual objects in the room's light, seen by the camera of the run.

    probeless run SOURCE --object Duck.glb@auto --scene --out out/duck
    python docs/examples/blender_scene.py out/duck out/duck/blender.png          # with bpy from PyPI
    blender --background --python docs/examples/blender_scene.py -- out/duck out/duck/blender.png

Options: --frame SECONDS after the first frame (default: the middle of the path), --samples N (default: 64).
"""

import argparse
import math
import sys
from pathlib import Path

import bpy


def main() -> None:
    options = argparse.ArgumentParser()
    options.add_argument("folder", type=Path)
    options.add_argument("picture", type=Path)
    options.add_argument("--frame", type=float)
    options.add_argument("--samples", type=int, default=64)
    words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    given = options.parse_args(words)

    bpy.ops.wm.read_factory_settings(use_empty=True)
    # RAW: intensities as they are. The default takes them for lux and divides by 683.
    bpy.ops.import_scene.gltf(filepath=str(given.folder / "scene.glb"), export_import_convert_lighting_mode="RAW")
    light_by(given.folder / "scene.hdr")
    look_through_camera(given.frame)
    render(given.picture, given.samples)


def light_by(panorama: Path) -> None:
    """Light the world with the lat-long picture that belongs to the lights of scene.glb."""
    world = bpy.data.worlds.new("room")
    bpy.context.scene.world = world
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    picture = nodes.new("ShaderNodeTexEnvironment")
    picture.image = bpy.data.images.load(str(panorama.resolve()))
    # Blender's middle column is along +x; glTF's -z, the middle of ours, is Blender's +y.
    turn = nodes.new("ShaderNodeMapping")
    turn.inputs["Rotation"].default_value[2] = -math.pi / 2
    where = nodes.new("ShaderNodeTexCoord")
    links.new(where.outputs["Generated"], turn.inputs["Vector"])
    links.new(turn.outputs["Vector"], picture.inputs["Vector"])
    links.new(picture.outputs["Color"], nodes["Background"].inputs["Color"])


def look_through_camera(seconds: float | None) -> None:
    """Make the run's camera the active one, at a time of its path."""
    scene = bpy.context.scene
    scene.camera = next(item for item in scene.objects if item.type == "CAMERA")
    pixels = scene.camera.data.get("intrinsics_px") or {}
    scene.render.resolution_x = int(pixels.get("width", 640))
    scene.render.resolution_y = int(pixels.get("height", 480))
    actions = [action for action in bpy.data.actions if action.frame_range[1] > action.frame_range[0]]
    if actions:
        first, last = actions[0].frame_range
        at = (first + last) / 2 if seconds is None else first + seconds * scene.render.fps
        scene.frame_set(int(at), subframe=at % 1)


def render(picture: Path, samples: int) -> None:
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples = samples
    # Colours of the scan are sRGB pictures: no film curve over them.
    scene.view_settings.view_transform = "Standard"
    scene.render.filepath = str(picture.resolve())
    bpy.ops.render.render(write_still=True)
    print(f"wrote {picture}")


main()

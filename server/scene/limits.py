"""What a mesh may be: refused beyond, before memory is spent on it."""

MAX_TRIANGLES = 2_000_000
MAX_VERTICES = 3 * MAX_TRIANGLES
MAX_PARTS = 20_000
MAX_COORDINATE_M = 1e6

MAX_TEXTURE_PIXELS = 16384 * 16384
"""Of one picture as the file has it."""
MAX_KEPT_SIDE = 4096
"""Longer sides are scaled down."""
MAX_KEPT_PIXELS = 8192 * 8192
"""Of all pictures of a model together, as they are kept; all are scaled down until they fit."""

MAX_SCENE_TRIANGLES = 8_000_000
"""Of all objects of a session together, each as often as it is placed."""
MAX_SCENE_TEXTURE_PIXELS = 4 * MAX_KEPT_PIXELS
"""Likewise."""
MAX_OBJECTS = 4096


class MeshError(ValueError):
    """A file that is no mesh that can be placed; one line that says what is wrong with it."""

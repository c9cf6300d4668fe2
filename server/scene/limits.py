"""Limits of meshes, checked before memory is allocated."""

MAX_TRIANGLES = 2_000_000
MAX_VERTICES = 3 * MAX_TRIANGLES
MAX_PARTS = 20_000
MAX_COORDINATE_M = 1e6

MAX_TEXTURE_PIXELS = 16384 * 16384
"""Pixels of one image in the file."""
MAX_KEPT_SIDE = 4096
"""Images with longer sides are scaled down."""
MAX_KEPT_PIXELS = 8192 * 8192
"""Pixels of all images of a model together after scaling; all are scaled down until they fit."""

MAX_SCENE_TRIANGLES = 8_000_000
"""Triangles of all objects of a session together, counted per placed object."""
MAX_SCENE_TEXTURE_PIXELS = 4 * MAX_KEPT_PIXELS
"""Texture pixels, likewise."""
MAX_OBJECTS = 4096


class MeshError(ValueError):
    """The file is not a mesh that can be placed; one line."""

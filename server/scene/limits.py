"""What a mesh may be: refused beyond, before memory is spent on it."""

MAX_TRIANGLES = 2_000_000
MAX_VERTICES = 3 * MAX_TRIANGLES
MAX_TEXTURE_PIXELS = 8192 * 8192
MAX_COORDINATE_M = 1e6


class MeshError(ValueError):
    """A file that is no mesh that can be placed; one line that says what is wrong with it."""

"""Limits of meshes, checked before memory is allocated."""

MAX_TRIANGLES = 2_000_000
MAX_VERTICES = 3 * MAX_TRIANGLES
MAX_PARTS = 20_000
MAX_COORDINATE_M = 1e6

MAX_TEXTURE_PIXELS = 16384 * 16384
"""Pixels of one image in the file."""
MAX_DECODED_PIXELS = MAX_TEXTURE_PIXELS
"""Pixels of all different images of a file together; about ten seconds of decoding and scaling."""
MAX_IMAGE_BYTES = 64 << 20
"""Encoded bytes of all different images of a file together. More than a message holds: images may share bytes."""
MAX_CUTOUTS = 100
"""Different cut-out materials of a file: each needs a table of its texture, about 25 ms and 9 MB."""
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

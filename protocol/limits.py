"""Limits of the wire format, checked before anything is allocated."""

PROTOCOL_VERSION = 1
SUBPROTOCOL = f"probeless-v{PROTOCOL_VERSION}"
SUBPROTOCOL_PREFIX = "probeless-v"

MAX_MESSAGE_BYTES = 16 << 20
MAX_IMAGE_SIDE_PX = 4096
MAX_IMAGE_PIXELS = 1920 * 1200
MAX_MESH_BYTES = 12 << 20
MAX_MESH_PART_BYTES = 4 << 20
MAX_SCENE_MESH_BYTES = 256 << 20
MAX_NAME_CHARS = 64
MAX_REASON_CHARS = 400
MAX_SH_BANDS = 6
MAX_LIGHT_PLACES = 16
FEW_INFLIGHT, MOST_INFLIGHT = 2, 8
"""Frames that a client may have unanswered if it does not say, and at most.

Two: one is computed while the next is on its way. Eight: 15 frames/s over a round trip of half a second.
"""
VALID_SPREAD_DEG = 25
"""Not a limit of sizes: `light.valid` is true up to this `spread_deg` (server/light/place_light.py has the reason)."""
MAX_PANORAMA_BYTES = 8 << 20

"""Golden vectors in tests/golden: the bytes of every sample, decoded by the Python and the TypeScript tests alike.

`python -m tests.protocol.golden` rewrites them; a change of these files is a change of the wire format.
"""

from __future__ import annotations

import base64
import json
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from protocol.codec import encode
from protocol.images import encode_depth
from protocol.messages import ClientMessage, ColorImage, ServerMessage
from tests.protocol.samples import CLIENT, COLOR, SERVER

FOLDER = Path(__file__).resolve().parents[1] / "golden"
EXPECTED = FOLDER / "messages.json"
EARLIER = FOLDER / "earlier"
"""Bytes that clients and servers out there write: they are read for as long as PROTOCOL_VERSION stays."""


def depth_ramp() -> NDArray[np.uint16]:
    """[8, 10] uint16 with holes, both extremes and every sign of delta; the TypeScript test has the same formula."""
    y, x = np.mgrid[0:8, 0:10]
    return np.where((x + y) % 5 == 0, 0, (x * 9001 + y * 30011) % 65536).astype(np.uint16)


def messages() -> dict[str, ClientMessage | ServerMessage]:
    """Every sample, a frame whose depth is really compressed, and one whose colour is of a video."""
    deflated = msgspec.structs.replace(CLIENT["frame"], color=COLOR, depth=encode_depth(depth_ramp(), "zdelta"))
    video = ColorImage(width=2, height=2, codec="h264", data=b"\x00\x00\x01\x65")
    filmed = msgspec.structs.replace(CLIENT["frame"], color=video)
    return {**CLIENT, **SERVER, "frame_zdelta": deflated, "frame_video": filmed}


def render_expected() -> str:
    """All messages as JSON, bytes as {"$base64": ...}."""
    plain = {name: msgspec.to_builtins(message, builtin_types=(bytes,)) for name, message in messages().items()}
    return json.dumps(plain, default=_bytes_as_base64, indent=1, ensure_ascii=False) + "\n"


def _bytes_as_base64(value: bytes) -> dict[str, str]:
    return {"$base64": base64.b64encode(value).decode()}


def main() -> None:
    """Write every vector and messages.json."""
    FOLDER.mkdir(exist_ok=True)
    for name, message in messages().items():
        (FOLDER / f"{name}.msgpack").write_bytes(encode(message))
    EXPECTED.write_text(render_expected(), encoding="utf-8")


if __name__ == "__main__":
    main()

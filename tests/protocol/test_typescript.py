"""The browser's types are the ones generated from the Python definitions now."""

from __future__ import annotations

import re
from typing import get_args

import msgspec

from protocol.limits import SUBPROTOCOL
from protocol.messages import ClientMessage, ServerMessage
from protocol.typescript import OUTPUT, render


def test_protocol_ts_is_current() -> None:
    assert OUTPUT.read_text(encoding="utf-8") == render(), "stale: run `python -m protocol.typescript`"


def _interface(name: str) -> str:
    found = re.search(rf"^export interface {name} \{{\n(.*?)^\}}", render(), re.MULTILINE | re.DOTALL)
    assert found, name
    return found[1]


def test_every_message_and_every_field_is_there_with_its_tag() -> None:
    for cls in (*get_args(ClientMessage), *get_args(ServerMessage)):
        body = _interface(cls.__name__)
        assert f'type: "{cls.__struct_config__.tag}";' in body
        for field in msgspec.structs.fields(cls):
            assert re.search(rf"^  {field.encode_name}\??: ", body, re.MULTILINE), (cls, field.name)


def test_kinds_of_fields() -> None:
    assert "  data: Uint8Array;" in _interface("ColorImage")
    assert '  codec: "raw" | "zdelta" | "zranks" | "zstd-delta" | "zstd-ranks";' in _interface("DepthImage")
    assert "  world_from_camera: Array<number> | null;" in _interface("Frame")
    assert "  sh_std: Array<[number | null, number | null, number | null]>;" in _interface("Light")
    assert "  wishes?: Wishes;" in _interface("Hello")
    assert "  notes: Array<string>;" in _interface("Composite")
    assert "/** Metres per unit of the uint16 depth. */" in _interface("CameraModel")
    assert f'export const SUBPROTOCOL = "{SUBPROTOCOL}";' in render()

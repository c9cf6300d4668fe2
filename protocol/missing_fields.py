"""Names every required field that a message lacks, since the decoder stops at the first."""

from __future__ import annotations

from typing import Any

import msgspec
from msgspec import inspect as types


def missing_fields(data: bytes | bytearray | memoryview, union: Any) -> list[str]:
    """Paths such as `$.camera.fx`, of the message of `union` that `data` says it is; empty if it says none."""
    try:
        message = msgspec.msgpack.decode(data)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, TypeError):  # TypeError: a map as a key
        return []
    if not isinstance(message, dict):
        return []
    for cls in union.__args__:
        if cls.__struct_config__.tag == message.get("type"):
            return _missing(types.type_info(cls), message, "$")
    return []


def _missing(node: types.Type, value: object, path: str) -> list[str]:
    """Fields without a value in a map, and in the maps inside it, each once; lists are not looked into."""
    match node:
        case types.Metadata(type=inner):
            return _missing(inner, value, path)
        case types.UnionType(types=several):
            return [name for one in several for name in _missing(one, value, path)]
        case types.StructType(fields=fields) if isinstance(value, dict):
            found = []
            for field in fields:
                name = f"{path}.{field.encode_name}"
                if field.encode_name in value:
                    found += _missing(field.type, value[field.encode_name], name)
                elif field.required:
                    found.append(name)
            return found
    return []

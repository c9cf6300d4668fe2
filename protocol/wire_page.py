"""Writes what the wire page says of bytes and fields: `python -m protocol.wire_page`.

The annotated messages in README.md and the tables of fields.md come from the message definitions themselves.
"""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import msgspec
from msgspec import inspect as types

from protocol.byte_listing import listing
from protocol.messages import ClientMessage, ServerMessage
from protocol.typescript import field_docs, plain, structs_of

FOLDER = Path(__file__).resolve().parent
PAGE, FIELDS = FOLDER / "README.md", FOLDER / "fields.md"
BEGIN, END = "<!-- written by protocol.wire_page: begin -->", "<!-- written by protocol.wire_page: end -->"

SIDE_PX = 16
"""Of the example: the smallest square picture from whose depth the server can choose a volume (16 samples, 4 apart)."""
EXAMPLE_HELLO: dict[str, Any] = {
    "type": "hello",
    "client": "mine",
    "camera": {"width": SIDE_PX, "height": SIDE_PX, "fx": 16.0, "fy": 16.0, "cx": 7.5, "cy": 7.5},
}
EXAMPLE_FRAME: dict[str, Any] = {
    "type": "frame",
    "frame": 0,
    "timestamp_s": 0.0,
    "world_from_camera": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
    "color": {"width": SIDE_PX, "height": SIDE_PX, "codec": "raw", "data": b"\xb4" * (3 * SIDE_PX**2)},
    "depth": {"width": SIDE_PX, "height": SIDE_PX, "codec": "raw", "data": b"\xdc\x05" * SIDE_PX**2},
}


def example_section() -> str:
    """The two annotated messages, Markdown."""
    parts = []
    for message in (EXAMPLE_HELLO, EXAMPLE_FRAME):
        data = msgspec.msgpack.encode(message)
        parts.append(f"`{message['type']}`, {len(data)} bytes:\n\n```text\n{listing(data)}\n```\n")
    return "\n".join(parts)


def page(text: str) -> str:
    """`text` of README.md with the annotated messages as they are now."""
    before, rest = text.split(BEGIN)
    return f"{before}{BEGIN}\n\n{example_section()}\n{END}{rest.split(END)[1]}"


def fields_page() -> str:
    """The whole of fields.md."""
    lines = ["# Every message and every field", ""]
    lines += [
        "Written by `python -m protocol.wire_page` from `messages.py` and `frames.py`. Spaces, units and order are in",
        "[README.md](README.md). A field with a default may be left out. `null` is nil, `bytes` are `bin`.",
    ]
    client, server = structs_of(get_args(ClientMessage)), structs_of(get_args(ServerMessage))
    shared = [cls for cls in client if cls in server and _tag(cls) is None]
    for title, classes in (
        ("Client to server", [cls for cls in client if cls not in shared]),
        ("Server to client", [cls for cls in server if cls not in client]),
        ("In both directions", shared),
    ):
        lines += ["", f"## {title}"]
        for cls in sorted(classes, key=lambda each: _tag(each) is None):
            lines += _table(cls)
    return "\n".join(lines) + "\n"


def _tag(cls: type) -> str | None:
    tag = cls.__struct_config__.tag  # type: ignore[attr-defined]
    return None if tag is None else str(tag)


def _table(cls: type) -> Iterator[str]:
    info, docs = plain(types.type_info(cls)), field_docs(cls)
    assert isinstance(info, types.StructType)
    tag = _tag(cls)
    yield from ("", f"### `{tag}`" if tag else f"### {cls.__name__}", "", _prose(inspect.getdoc(cls) or ""), "")
    yield from ("| field | type | default | meaning |", "|---|---|---|---|")
    if tag:
        yield f'| `type` | "{tag}" | required | |'
    for field in info.fields:
        default = "required" if field.required else f"`{_default(field)}`"
        meaning = _prose(docs.get(field.name, "")).replace("|", "\\|")
        yield f"| `{field.encode_name}` | {_type(field.type)} | {default} | {meaning} |"


def _default(field: types.Field) -> str:
    if isinstance(field.default, msgspec.Struct):
        return "{}"
    text = json.dumps(field.default)
    return "identity" if isinstance(field.default, tuple) and len(field.default) == 16 else text


def _prose(text: str) -> str:
    return " ".join(text.replace("None", "null").split())


def _type(node: types.Type) -> str:
    match node:
        case types.Metadata(type=inner):
            text = _type(inner)
        case types.StructType(cls=cls):
            text = f"[{cls.__name__}](#{cls.__name__.lower()})"
        case types.UnionType(types=several):
            text = " or ".join(_type(one) for one in several)
        case types.TupleType(item_types=items):
            text = f"{len(items)} x {_type(items[0])}"
        case types.VarTupleType(item_type=item, min_length=least):
            text = f"{f'{least} x' if least else 'array of'} {_type(item)}"
        case _:
            text = _scalar_type(node)
    return text


def _scalar_type(node: types.Type) -> str:
    match node:
        case types.IntType():
            return f"integer{_range(node)}"
        case types.FloatType():
            return f"number{_range(node)}"
        case types.StrType(min_length=least, max_length=most):
            return "string" if most is None else f"string, {f'{least} to ' if least else ''}{most} characters"
        case types.BytesType(max_length=most):
            return f"bytes, at most {most}"
        case types.LiteralType(values=values):
            return ", ".join(json.dumps(value) for value in values)
    return {types.BoolType: "boolean", types.NoneType: "null"}[type(node)]


def _range(node: types.IntType | types.FloatType) -> str:
    bounds = ((">=", node.ge), (">", node.gt), ("<=", node.le), ("<", node.lt))
    text = ", ".join(f"{sign} {value:.16g}" for sign, value in bounds if value is not None)
    return f" {text}" if text else ""


def main() -> None:
    """Write fields.md and the examples of README.md."""
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    FIELDS.write_text(fields_page(), encoding="utf-8")
    sys.stdout.write(f"wrote {PAGE} and {FIELDS}\n")


if __name__ == "__main__":
    main()

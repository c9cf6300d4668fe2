"""The pages of the messages, from their definitions: for reading, and as JSON Schema."""

from __future__ import annotations

import json
from typing import Any, get_args

import msgspec

from protocol import messages

HEAD = """\
# Messages

Every message of [the wire](../wire.md) with its fields, types, defaults and limits. The same is there as
[JSON Schema](messages.schema.json), and in TypeScript (`client/web/src/protocol.ts`). On the wire each is a
MessagePack map with a field `type`.
"""
_DIRECTIVE = """\
::: protocol.messages.{name}
    options:
      show_if_no_docstring: true
      inherited_members: true
"""


def message_page() -> str:
    """Markdown of all messages by direction, then of the structures in them."""
    sent = {
        "From the client": get_args(messages.ClientMessage),
        "From the server": get_args(messages.ServerMessage),
    }
    listed = {member for members in sent.values() for member in members}
    parts = [
        value
        for value in vars(messages).values()
        if isinstance(value, type) and issubclass(value, msgspec.Struct) and value not in listed
        and value.__module__ == messages.__name__ and value.__struct_fields__
    ]  # fmt: skip
    lines = [HEAD]
    for title, members in {**sent, "Structures in them": parts}.items():
        lines += [f"## {title}\n", *(_DIRECTIVE.format(name=member.__name__) for member in members)]
    return "\n".join(lines)


def message_schema() -> str:
    """JSON Schema of both directions; bytes are base64 there."""
    roots = (messages.ClientMessage, messages.ServerMessage)
    (client, server), components = msgspec.json.schema_components(roots, ref_template="#/$defs/{name}")
    schema: dict[str, Any] = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Messages of probeless",
        "$defs": {**components, "ClientMessage": client, "ServerMessage": server},
        "anyOf": [{"$ref": "#/$defs/ClientMessage"}, {"$ref": "#/$defs/ServerMessage"}],
    }
    return json.dumps(schema, indent=1)

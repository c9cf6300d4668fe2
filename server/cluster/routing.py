"""Routes a client to its room by its first message.

A room's host is an ordinary service, so its session names and keys are unique only within the room. The ingress
prefixes them with the room's id in outgoing messages and removes the prefix from incoming ones.
"""

from __future__ import annotations

import hashlib
import re
import secrets
from dataclasses import dataclass

import msgspec
from msgspec import structs

from protocol.codec import decode_server, encode
from protocol.messages import ClientMessage, Hello, Watch, Welcome
from server.service.edge.connection import GONE, POLICY, Refusal

ID_BYTES = 8
_OWN = re.compile(rf"([0-9a-f]{{{2 * ID_BYTES}}})\.(.+)")
SMALL_BYTES = 4096
"""Upper bound on the size of a welcome."""


@dataclass(frozen=True)
class Route:
    """A client's room, and the first message to send to its host."""

    room_id: str
    first: bytes
    may_open: bool
    """Whether the room may be opened. False for clients that return to a session."""
    is_private: bool = False
    """The room of this session alone: it has no name by which another client could enter."""


class _Tag(msgspec.Struct):
    type: str


def room_id_of(name: str) -> str:
    """Room id: a digest of its name."""
    return hashlib.blake2b(name.encode("utf-8", "surrogatepass"), digest_size=ID_BYTES).hexdigest()


def route_of(first: ClientMessage | None) -> Route:
    """Route of a first message. Raises Refusal if it names no room."""
    match first:
        case Hello(resume=str(key)):
            room_id, own = _split(key, Refusal(GONE, "there is no session with this key: it ended"))
            return Route(room_id, encode(structs.replace(first, resume=own)), may_open=False)
        case Hello(room=None):
            return Route(secrets.token_hex(ID_BYTES), encode(first), may_open=True, is_private=True)
        case Hello(room=str(name)):
            return Route(room_id_of(name), encode(first), may_open=True)
        case Watch(session=str(session)):
            room_id, own = _split(session, Refusal(GONE, f"there is no session {session[:80]!r}"))
            return Route(room_id, encode(structs.replace(first, session=own)), may_open=False)
        case Watch(room=str(name)):
            return Route(room_id_of(name), encode(first), may_open=True)
        case Watch():
            raise Refusal(POLICY, "this server has many rooms: say which one, or which session, you want to watch")
        case _:
            raise Refusal(POLICY, "the first message must be hello or watch")


def outgoing(data: bytes, room_id: str) -> bytes:
    """A host's message for the client: session and key in a welcome get the room's prefix; others are unchanged."""
    if len(data) > SMALL_BYTES or msgspec.msgpack.decode(data, type=_Tag).type != "welcome":
        return data
    welcome = decode_server(data)
    assert isinstance(welcome, Welcome)
    key = None if welcome.key is None else f"{room_id}.{welcome.key}"
    return encode(structs.replace(welcome, session=f"{room_id}.{welcome.session}", key=key))


def _split(name: str, refusal: Refusal) -> tuple[str, str]:
    found = _OWN.fullmatch(name)
    if found is None:
        raise refusal
    return found.group(1), found.group(2)

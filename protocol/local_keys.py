"""What a server leaves for programs of its user on its machine, so that they get in without being told its token.

One file a port, readable by the user alone, in the user's state directory; PROBELESS_KEYS names another folder.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import msgspec
from msgspec import Struct
from platformdirs import user_state_path


class LocalKey(Struct, frozen=True, kw_only=True):
    """How to get into the server that listens on a port of this machine."""

    token: str | None
    fingerprint: str | None = None
    """SHA-256 of its certificate, where it speaks TLS."""
    pid: int


def key_path(port: int) -> Path:
    """Where the key of a port is left."""
    folder = os.environ.get("PROBELESS_KEYS")
    return (Path(folder) if folder else user_state_path("probeless") / "keys") / f"{port}.json"


@contextlib.contextmanager
def key_left(port: int, key: LocalKey) -> Iterator[None]:
    """Leave the key while the context lasts. Raises OSError where it cannot be written."""
    path = key_path(port)
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    beside = path.with_suffix(f".{os.getpid()}")
    beside.unlink(missing_ok=True)
    # Made for the user alone from the first byte on; a link that somebody laid there is not followed.
    with open(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(msgspec.json.encode(key))
    beside.replace(path)
    try:
        yield
    finally:
        if find_key(port) == key:  # not one that a later server left
            path.unlink(missing_ok=True)


def find_key(port: int) -> LocalKey | None:
    """The key of the server on a port of this machine; None where this user was left none, or its server is dead."""
    try:
        with key_path(port).open("rb") as file:
            if not _is_private(os.fstat(file.fileno())):
                return None
            key = msgspec.json.decode(file.read(), type=LocalKey)
    except (OSError, msgspec.MsgspecError):
        return None
    return key if _lives(key.pid) else None


def _is_private(status: os.stat_result) -> bool:
    return os.name != "posix" or (status.st_uid == os.getuid() and not status.st_mode & 0o077)


def _lives(pid: int) -> bool:
    if os.name != "posix":  # elsewhere os.kill would end it
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's by now
        return False
    return True

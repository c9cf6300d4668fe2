"""Key files through which programs of the same user on the same machine find a server's token.

One file per port, readable by the user only, in the user's state directory. PROBELESS_KEYS sets another folder.
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
    """Credentials for the server that listens on a port of this machine."""

    token: str | None
    fingerprint: str | None = None
    """SHA-256 fingerprint of its certificate, if it uses TLS."""
    pid: int


def key_path(port: int) -> Path:
    """Path of the key file of a port."""
    folder = os.environ.get("PROBELESS_KEYS")
    return (Path(folder) if folder else user_state_path("probeless") / "keys") / f"{port}.json"


@contextlib.contextmanager
def key_left(port: int, key: LocalKey) -> Iterator[None]:
    """Context in which the key file exists. Raises OSError if it cannot be written."""
    path = key_path(port)
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    beside = path.with_suffix(f".{os.getpid()}")
    beside.unlink(missing_ok=True)
    # Created with the final permissions; symbolic links are not followed.
    with open(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(msgspec.json.encode(key))
    beside.replace(path)
    try:
        yield
    finally:
        if find_key(port) == key:  # do not delete the file of a later server
            path.unlink(missing_ok=True)


def find_key(port: int) -> LocalKey | None:
    """The key of the server on a port of this machine; None if there is none or the server is dead."""
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
    if os.name != "posix":  # on Windows os.kill would end the process
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # the process id now belongs to another user
        return False
    return True

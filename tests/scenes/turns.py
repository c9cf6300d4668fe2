"""Turns of sessions, as the server's scheduler gives them."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext


class Alone:
    """Of a session that shares the device with nobody: its frames are those of a live camera."""

    def is_due(self) -> bool:
        """As of FrameTurn; so are the others."""
        return False

    def give_way(self, *, may_end: bool) -> None:
        """Nobody is due."""
        raise AssertionError(may_end)

    def released(self) -> AbstractContextManager[None]:
        """Of no consequence."""
        return nullcontext()

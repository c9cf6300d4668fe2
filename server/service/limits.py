"""How much of the service one client may have: every limit that is no fact of the wire, in one place.

Of the wire: `protocol.limits`. Of virtual objects: `server.scene.limits`.
"""

from __future__ import annotations

from dataclasses import dataclass

from server.service.saving.upkeep import DAY_S, KeptLimits

MIB, GIB = 1 << 20, 1 << 30
KEPT = KeptLimits(space_bytes=16 * GIB, age_s=180 * DAY_S)


@dataclass(frozen=True)
class Limits:
    """Of one service."""

    sessions: int = 16
    """That capture."""
    sessions_per_address: int = 8
    """Of them from one address (IPv6: one network of 64 bits)."""
    watchers: int = 64
    connections_per_address: int = 64
    """Of any kind."""
    first_message_s: float = 30.0
    """Until hello or watch has come."""
    messages_per_s: float = 500.0
    """Of one connection, over the long run."""
    messages_at_once: float = 2000.0
    """What may be saved up."""
    bytes_per_s: float = 128.0 * MIB
    bytes_at_once: float = 512.0 * MIB
    wanted_period_s: float = 0.25
    """Between two frames of sessions that share the device: when it is longer, they sample more cheaply."""
    longest_period_s: float = 3.0
    """The same at which nobody new is taken in."""
    volume_bytes: int = 512 * MIB
    """Device memory of one session's volume."""
    kept: KeptLimits = KEPT
    """Of the rooms on disk."""


DEFAULT_LIMITS = Limits()

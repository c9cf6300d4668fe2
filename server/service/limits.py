"""Limits of the service. Limits of the wire format: `protocol.limits`; of virtual objects: `server.scene.limits`."""

from __future__ import annotations

from dataclasses import dataclass

from server.service.saving.retention import DAY_S, RetentionLimits

MIB, GIB = 1 << 20, 1 << 30
ROOM_RETENTION = RetentionLimits(space_bytes=16 * GIB, age_s=180 * DAY_S)


@dataclass(frozen=True)
class Limits:
    """Limits of one service."""

    sessions: int = 16
    """Capturing sessions at a time."""
    sessions_per_address: int = 8
    """Capturing sessions from one address (IPv6: one /64 network)."""
    watchers: int = 64
    connections: int = 1024
    """Connections of any kind in all; fewer where the limit on open files is low (`gate.max_connections`)."""
    connections_per_address: int = 64
    """WebSockets from one address. Twice as many connections are accepted, so that it can still ask for health."""
    header_s: float = 10.0
    """Timeout for a TLS handshake, and for a request's header."""
    first_message_s: float = 10.0
    """Timeout for hello or watch."""
    messages_per_s: float = 500.0
    """Sustained message rate of one connection."""
    messages_burst: float = 2000.0
    """Token bucket size: messages that may arrive in one burst."""
    bytes_per_s: float = 128.0 * MIB
    bytes_burst: float = 512.0 * MIB
    target_period_s: float = 0.25
    """Time between two frames of a session. If it is longer, sessions that share the device sample more cheaply."""
    max_period_s: float = 3.0
    """Time between two frames above which new sessions are refused."""
    volume_bytes: int = 512 * MIB
    """Device memory for one session's volume."""
    room_retention: RetentionLimits = ROOM_RETENTION
    """Limits for rooms on disk."""


DEFAULT_LIMITS = Limits()

"""The plain model of light, for tests and benchmarks whose subject is another: plain harmonics for the whole room."""

from __future__ import annotations

from typing import Any

PLAIN_LIGHT: dict[str, Any] = {"albedo": "constant", "indirect": "none"}
"""Wishes: one albedo and no indirect light."""

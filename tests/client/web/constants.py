"""What tests of the page share: time limits, and where pictures are kept."""

from pathlib import Path

PICTURES = Path(__file__).parents[3] / "out" / "web"
PATIENCE_MS = 60_000
"""Bounds only a test that hangs: a busy machine takes seconds for what a free one does at once."""

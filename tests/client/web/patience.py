"""How long tests of the page wait for what never takes long."""

PATIENCE_MS = 60_000
"""Bounds only a test that hangs: a busy machine takes seconds for what a free one does at once."""

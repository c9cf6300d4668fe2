"""Distant lights, lamps, and precomputed shadows."""

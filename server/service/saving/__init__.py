"""Rooms on disk: which state is saved, and how, so that a crash at any moment leaves the last complete save."""

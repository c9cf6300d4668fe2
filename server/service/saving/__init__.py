"""Rooms on disk: what of a room is kept, how it is written so that a crash at any moment leaves the last whole save."""

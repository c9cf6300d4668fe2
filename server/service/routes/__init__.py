"""The HTTP routes: objects, panoramas, health."""

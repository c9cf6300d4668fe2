"""Decoding of untrusted meshes and images in child processes (server/children)."""

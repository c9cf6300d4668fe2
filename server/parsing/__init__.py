"""Decoding of untrusted meshes and images in child processes, whose crash does not affect the server."""

"""The scenes: solids, textures and camera paths."""

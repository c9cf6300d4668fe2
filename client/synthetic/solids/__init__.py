"""Solids with closed-form ray intersections, their surface coordinates, and their triangle meshes."""

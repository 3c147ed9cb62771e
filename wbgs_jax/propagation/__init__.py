"""Rays from a mesh, and what arrives over them: facets -> edges -> image_method -> paths -> slab, utd -> transport."""

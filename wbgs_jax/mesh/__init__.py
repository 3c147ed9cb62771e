"""Meshes: readers, cleaning, simplification, facets and edges."""

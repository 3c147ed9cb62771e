"""Meshes: readers, cleaning, facets and edges."""

"""All entries of the suite, by writer."""

from builders.conformance import (
    by_blender,
    by_deepmimo,
    by_gltf_writers,
    by_mesh_libraries,
    by_mitsuba,
    by_other_programs,
    by_pictures,
    by_ply_writers,
    by_sionna,
    by_tables,
    by_trimesh,
)
from builders.conformance.entries import Entry

MODULES = (
    by_trimesh,
    by_ply_writers,
    by_mesh_libraries,
    by_gltf_writers,
    by_mitsuba,
    by_blender,
    by_other_programs,
    by_tables,
    by_pictures,
    by_sionna,
    by_deepmimo,
)


def catalogue() -> list[Entry]:
    """Returns every entry; names differ."""
    return [entry for module in MODULES for entry in module.ENTRIES]

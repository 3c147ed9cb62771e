"""All entries of the suite, by writer."""

import by_blender
import by_deepmimo
import by_gltf_writers
import by_mesh_libraries
import by_mitsuba
import by_other_programs
import by_pictures
import by_ply_writers
import by_sionna
import by_tables
import by_trimesh
from entries import Entry

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

"""Which object of a room is of which material: by its name in a .toml, by a pattern there, or as the room's file records it."""

import fnmatch
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from wbgs_jax._util.errors import UserError
from wbgs_jax.interchange.building_materials import ITU, THICKNESS, Law, own_material
from wbgs_jax.interchange.room_files import FileObject

MAX_THICKNESS = 2.0
"""Metres: a thicker slab is one given in millimetres."""
HELP = "see docs/own_scene.md"


class Slab(NamedTuple):
    """A material by name and its thickness in metres; the name of an own material carries its law (`own_material`)."""

    material: str
    thickness: float
    given: bool = False
    """Whether the thickness is given for the object itself, rather than for its material."""


def slabs_of(file: Path, objects: Sequence[FileObject], materials: Path | None) -> list[Slab]:
    """Returns the slab of every object.

    Args:
        file: that the objects are from, for messages.
        objects: of a room (`read_objects`).
        materials: the .toml (docs/own_scene.md); None only where the room's file itself records all materials.

    Raises:
        UserError: the .toml cannot be read or holds something else, it names an object that is not there, or an object has no
            material.
    """
    tables = _read_toml(materials) if materials is not None else {}
    own = {name: _own_slab(name, table, f"{materials}") for name, table in tables.get("materials", {}).items()}
    chosen = {pattern: _slab(value, own, f"{materials}: {pattern!r}") for pattern, value in tables.get("objects", {}).items()}
    names = [o.name for o in objects]
    for pattern in chosen:
        if pattern not in names and not fnmatch.filter(names, pattern):
            raise UserError(f"{materials}: {pattern!r} is no object of {file}; there are {listed(names)}")
    found = [_choose(o, chosen, f"{file}: {o.name!r}") for o in objects]
    without = [o.name for o, slab in zip(objects, found, strict=True) if slab is None]
    if without:
        where = f"{materials}" if materials is not None else "a .toml file given with --materials"
        raise UserError(f"no material for {listed(without)} of {file}; name them under [objects] in {where} ({HELP})")
    return [slab for slab in found if slab is not None]


def listed(names: Sequence[str], most: int = 12) -> str:
    """Returns names as text for people, the first of very many."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(repr(name) for name in names[:most]) + more


def _choose(found: FileObject, chosen: dict[str, Slab], where: str) -> Slab | None:
    if found.name in chosen:
        return chosen[found.name]
    for pattern, slab in chosen.items():
        if fnmatch.fnmatchcase(found.name, pattern):
            return slab
    if found.material is None:
        return None
    name, thickness, properties = found.material
    if properties is not None:
        permittivity, conductivity = properties
        return Slab(own_material(name, Law(permittivity, 0.0, conductivity, 0.0)), _thickness(thickness, where))
    return _slab({"material": name, "thickness": thickness}, {}, where)


def _read_toml(file: Path) -> dict[str, dict[str, Any]]:
    try:
        tables = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"cannot read {file}: {error.strerror}; give the .toml with the materials") from error
    except ValueError as error:  # TOMLDecodeError, UnicodeDecodeError
        raise UserError(f"{file} is not valid TOML: {error}") from error
    if not set(tables) <= {"objects", "materials"} or not all(isinstance(table, dict) for table in tables.values()):
        raise UserError(f"{file} may hold the tables [objects] and [materials.<name>] and nothing else; {HELP}")
    return tables


def _own_slab(name: str, table: Any, where: str) -> Slab:
    """Returns a user's own material.

    Its relative permittivity and conductivity (S/m) are each a number, or [a, b] for a f^b with f in GHz.
    """
    keys = ("relative_permittivity", "conductivity", "thickness")
    if not isinstance(table, dict) or set(table) != set(keys):
        raise UserError(f"{where}: [materials.{name}] needs {', '.join(keys)} and nothing else; {HELP}")
    laws = [table[key] if isinstance(table[key], list) else [table[key], 0] for key in keys[:2]]
    if not all(len(law) == 2 and all(isinstance(value, int | float) for value in law) for law in laws):
        raise UserError(f"{where}: [materials.{name}] is described by numbers, or [a, b] for a f^b with f in GHz")
    return Slab(own_material(name, Law(*laws[0], *laws[1])), _thickness(table["thickness"], f"{where}: {name!r}"))


def _slab(value: Any, own: dict[str, Slab], where: str) -> Slab:
    """Returns the slab that `"name"` or `{material = "name", thickness = metres}` stands for."""
    table = {"material": value} if isinstance(value, str) else value
    if not isinstance(table, dict) or not isinstance(table.get("material"), str) or not set(table) <= {"material", "thickness"}:
        raise UserError(f'{where} needs "material" or {{material = "...", thickness = metres}}; quote names that have a dot')
    name = table["material"]
    if name not in own and name not in ITU:
        known = ", ".join(sorted({*own, *THICKNESS}))
        raise UserError(f"{where} is of unknown material {name!r}; choose among {known} (more in {HELP.removeprefix('see ')})")
    slab = own.get(name) or Slab(name, ITU[name].thickness)
    return Slab(slab.material, _thickness(table.get("thickness", slab.thickness), where), "thickness" in table)


def _thickness(value: Any, where: str) -> float:
    if not isinstance(value, int | float) or not 0 < value <= MAX_THICKNESS:
        raise UserError(f"{where} has a thickness of {value}; give metres, more than 0 and at most {MAX_THICKNESS:g}")
    return float(value)

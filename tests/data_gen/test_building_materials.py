"""The table of materials agrees with the simulator, and materials are checked against frequencies before a run."""

import math

import pytest

from wbgs_jax._util.errors import UserError
from wbgs_jax.interchange import rooms
from wbgs_jax.interchange.rooms import Law, check_material_frequencies, own_law, own_material


def test_materials_of_the_released_scenes_cover_the_whole_band():
    assert set(rooms.THICKNESS) == {"concrete", "plasterboard", "wood", "glass", "ceiling_board", "chipboard", "metal"}
    check_material_frequencies(rooms.THICKNESS, rooms.VALID_HZ)


def test_thicknesses_are_those_of_slabs():
    assert all(0.001 < material.thickness <= 0.5 for material in rooms.ITU.values())


@pytest.mark.usefixtures("simulator_backend")
def test_the_table_is_the_simulators():
    from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES

    assert set(rooms.ITU) == set(ITU_MATERIALS_PROPERTIES) - {"vacuum"}
    for name, (_, low, high) in rooms.ITU.items():
        first, last = next(iter(ITU_MATERIALS_PROPERTIES[name]))  # the lowest band is listed first
        assert low == first and math.isclose(high, last, rel_tol=1e-4), name


@pytest.mark.usefixtures("simulator_backend")
@pytest.mark.parametrize("name", sorted(rooms.ITU))
def test_the_simulator_takes_a_material_at_both_ends_of_its_band(name):
    import mitsuba as mi
    from sionna.rt.radio_materials.itu import itu_material

    _, low, high = rooms.ITU[name]
    for ghz in (low, high):
        permittivity, conductivity = itu_material(name, mi.Float(ghz * 1e9))
        assert permittivity[0] >= 1 and conductivity[0] >= 0


@pytest.mark.parametrize(
    ("name", "ghz", "message"),
    [
        ("brick", (2.4, 60.0, 94.0), "brick is defined for 1-40 GHz, not at 60, 94 GHz"),
        ("marble", (60.0,), "marble is defined for 1-59.999 GHz"),
        ("floorboard", (24.25,), "floorboard is defined for 50-100 GHz"),
        ("clear_acrylic", (94.0,), "clear_acrylic is defined for 110-330 GHz"),
        ("wet_ground", (10.1,), "wet_ground is defined for 1-10 GHz"),
        ("wood", (0.5,), "0.5 GHz is outside 1-100 GHz"),
        ("clear_acrylic", (140.0,), "140 GHz is outside 1-100 GHz"),
    ],
)
def test_a_material_outside_its_band_is_refused(name, ghz, message):
    with pytest.raises(UserError, match=message) as caught:
        check_material_frequencies(["concrete", name], [f * 1e9 for f in ghz])
    assert "\n" not in str(caught.value)


def test_materials_inside_their_bands_pass():
    check_material_frequencies(["brick", "plywood", "carpet_tile", "concrete"], [1e9, 40e9])
    check_material_frequencies(["floorboard", "clay(4, 0, 0.02, 1)"], [50e9, 100e9])


def test_a_material_of_ones_own_carries_its_law():
    law = Law(3.91, 0.0, 0.0238, 0.16)
    name = own_material("clay-2", law)
    assert name == "clay-2(3.91, 0, 0.0238, 0.16)" and own_law(name) == law
    assert own_law("brick") is None and own_law("clay(1, 2)") is None


@pytest.mark.parametrize(
    ("name", "law"),
    [
        ("brick", Law(4, 0, 0.02, 0)),  # a name of P.2040
        ("my clay", Law(4, 0, 0.02, 0)),
        ("clay(1)", Law(4, 0, 0.02, 0)),
        ("clay", Law(0.9, 0, 0.02, 0)),
        ("clay", Law(2, -0.5, 0.02, 0)),  # 0.2 at 100 GHz
        ("clay", Law(4, 0, -0.02, 0)),
        ("clay", Law(math.nan, 0, 0.02, 0)),
        ("clay", Law(4, 0, math.inf, 0)),
        ("clay", Law(4, 400, 0.02, 0)),
    ],
)
def test_an_impossible_material_is_refused(name, law):
    with pytest.raises(UserError, match="needs"):
        own_material(name, law)

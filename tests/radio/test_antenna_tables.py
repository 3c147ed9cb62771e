"""Tabulated antennas against parametric ones in closed form, and their files."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.antenna_file import read_antenna
from wbgs_jax.radio.antenna import (
    Antenna,
    dipole_gain,
    element_gain,
    pattern_exponents,
    tabulated,
    zenith_vector,
    zenith_weights,
)
from wbgs_jax.radio.geometry import angles_to_direction

STEP = 2
ZENITH, AZIMUTH = np.radians(np.arange(0, 181, STEP)), np.radians(np.arange(0, 360, STEP))


def grid():
    azimuth, zenith = np.meshgrid(AZIMUTH, ZENITH)
    return angles_to_direction(jnp.asarray(azimuth, jnp.float32), jnp.asarray(zenith, jnp.float32))


def mean_gain(antenna, rows=361):
    """The mean over the sphere of an antenna's power gain: its efficiency, 1 without losses."""
    zenith = np.linspace(0, np.pi, rows)
    azimuth = np.arange(2 * (rows - 1)) * (np.pi / (rows - 1))
    azimuths, zeniths = (jnp.asarray(angle, jnp.float32) for angle in np.meshgrid(azimuth, zenith))
    field = antenna.field(angles_to_direction(azimuths, zeniths))
    gain = np.sum(np.abs(np.asarray(field, np.complex128)) ** 2, -1).mean(1)
    return float(np.sum(gain * zenith_weights(rows)))


def named(pattern):
    return Antenna(None, jnp.array(pattern_exponents(pattern), jnp.float32))


def amplitudes(pattern):
    return np.asarray((element_gain if pattern == "tr38901" else dipole_gain)(grid()))


def crossed():
    """Horizontal and vertical dipoles fed with a quarter of a period between them: (e_theta, e_phi), smooth at the poles."""
    azimuth, zenith = np.meshgrid(AZIMUTH, ZENITH)
    x_theta, x_phi = np.cos(zenith) * np.cos(azimuth), -np.sin(azimuth)
    return np.sqrt(0.75) * (x_theta - 1j * np.sin(zenith)), np.sqrt(0.75) * (x_phi + 0j)


def crossed_field(k):
    """The same without a table: the part of a constant vector across the direction."""
    vector = np.sqrt(0.75) * np.array([1, 0, 1j])
    return vector - np.sum(vector * k, -1, keepdims=True) * k


def directions(rng, n=400):
    k = rng.normal(size=(n, 3))
    return (k / np.linalg.norm(k, axis=-1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("pattern", ["tr38901", "dipole"])
def test_a_table_of_gains_agrees_with_the_parametric_antenna(pattern, rng):
    k = jnp.asarray(directions(rng, 1000))
    exact, found = (np.asarray(a.field(k)) for a in (named(pattern), tabulated(amplitudes(pattern), None)))
    level = np.linalg.norm(exact, axis=-1)
    strong = level > 0.1 * level.max()
    error_db = 20 * np.log10(np.linalg.norm(found, axis=-1)[strong] / level[strong])
    assert strong.sum() > 300 and np.abs(error_db).max() < 0.05
    assert np.abs(found - exact)[strong].max() < 6e-3 * level.max()


@pytest.mark.parametrize("pole", [1.0, -1.0])
def test_an_isotropic_antenna_radiates_straight_up_and_down(pole):
    directions = jnp.array([[0.0, 0.0, pole], [1e-3, 0.0, pole]])
    field = Antenna(None, jnp.zeros(2)).field(directions)
    np.testing.assert_allclose(field, [[pole, 0, 0]] * 2, atol=2e-3)


def test_a_table_of_fields_is_smooth_at_both_poles(rng):
    antenna = tabulated(*crossed())
    k = np.concatenate([directions(rng), [[0, 0, 1], [0, 0, -1], [1e-7, 0, 1], [0, -3e-3, -1], [2e-3, 1e-3, 1]]]).astype(
        np.float32
    )
    k /= np.linalg.norm(k, axis=-1, keepdims=True)
    np.testing.assert_allclose(antenna.field(jnp.asarray(k)), crossed_field(k), atol=1e-4)


def test_gains_at_the_poles_are_those_of_the_table():
    gain = np.ones((len(ZENITH), len(AZIMUTH)))
    gain[0], gain[-1] = 3, np.linspace(1, 2, len(AZIMUTH))
    k = jnp.array([[0.0, 0, 1], [0, 0, -1], [1, 0, 0]])
    np.testing.assert_allclose(np.linalg.norm(tabulated(gain, None).field(k), axis=-1), [3, 1.5, 1], rtol=1e-5)


def test_a_rotated_table_seen_from_a_rotated_direction_is_rotated(rng):
    first, second = Rotation.from_quat(rng.normal(size=4)), Rotation.from_quat(rng.normal(size=4))
    antenna, k = tabulated(*crossed()), directions(rng, 50)
    wxyz = [jnp.asarray(np.roll(one.as_quat(), 1), jnp.float32) for one in (first, second)]
    rotated = antenna.rotated(wxyz[0]).rotated(wxyz[1])
    both = second * first
    found = np.asarray(rotated.field(jnp.asarray(both.apply(k), jnp.float32)))
    expected = np.asarray(antenna.field(jnp.asarray(k)))
    np.testing.assert_allclose(found, both.apply(expected.real) + 1j * both.apply(expected.imag), atol=2e-3)
    np.testing.assert_allclose(np.sum(found * both.apply(k), -1), 0, atol=1e-4)


@pytest.mark.parametrize("place", [(0.3, -0.5, 0.4), (1e-3, 2e-3, 1.0), (-2e-3, 1e-3, -1.0), (-0.7, 1e-4, 0.1)])
def test_gradients_of_a_table_agree_with_finite_differences(place, x64):
    antenna = jax.tree.map(
        lambda a: jnp.asarray(a, jnp.complex128 if jnp.iscomplexobj(a) else jnp.float64), tabulated(*crossed())
    )

    def strength(v):
        field = antenna.field(v / jnp.linalg.norm(v))
        return jnp.sum((field * jnp.array([0.3 + 0.1j, -0.2, 0.7j])).real)

    v, step = jnp.array(place, jnp.float64), 1e-6
    differences = [(strength(v + step * e) - strength(v - step * e)) / (2 * step) for e in np.eye(3)]
    np.testing.assert_allclose(jax.grad(strength)(v), differences, atol=1e-6)
    for pole in (1.0, -1.0):
        assert np.isfinite(jax.grad(strength)(jnp.array([0.0, 0.0, pole]))).all()


def test_the_directivity_of_an_antenna_without_losses_integrates_to_the_whole_sphere():
    assert mean_gain(named("dipole")) == pytest.approx(1, abs=1e-4)
    assert mean_gain(tabulated(amplitudes("dipole"), None)) == pytest.approx(1, abs=2e-3)
    assert mean_gain(tabulated(*crossed())) == pytest.approx(1, abs=1e-3)


def write_csv(path, head, columns):
    azimuth, zenith = np.meshgrid(np.arange(0, 361, STEP) - 180, np.degrees(ZENITH))
    rows = np.column_stack([azimuth.ravel(), zenith.ravel(), *columns(np.radians(azimuth), np.radians(zenith))])
    rows = np.random.default_rng(0).permutation(rows)  # in any order
    path.write_text(head + "\n" + "\n".join(",".join(map(repr, map(float, row))) for row in rows))


def test_a_csv_file_of_gains(tmp_path, rng):
    def gain(azimuth, zenith):
        k = angles_to_direction(jnp.asarray(azimuth, jnp.float32), jnp.asarray(zenith, jnp.float32))
        level = 20 * np.log10(np.linalg.norm(named("tr38901").field(k), axis=-1))
        return [level.ravel()]

    write_csv(tmp_path / "a.csv", "Azimuth_deg, zenith_deg, gain_dbi", gain)
    k = jnp.asarray(directions(rng, 100))
    np.testing.assert_allclose(read_antenna(tmp_path / "a.csv").field(k), named("tr38901").field(k), atol=0.02)


def test_fields_of_any_unit_are_scaled_to_an_antenna_without_losses(tmp_path, rng):
    """From an archive and from a table; both are the crossed dipoles."""
    theta, phi = crossed()
    np.savez(tmp_path / "a.npz", e_theta=37 * theta, e_phi=37 * phi, zenith=ZENITH, azimuth=AZIMUTH)

    def components(azimuth, zenith):
        theta = np.cos(zenith) * np.cos(azimuth) - 1j * np.sin(zenith)
        return [part.ravel() for part in (theta.real, theta.imag, -np.sin(azimuth), 0 * azimuth)]

    write_csv(tmp_path / "b.csv", "azimuth_deg,zenith_deg,theta_re,theta_im,phi_re,phi_im", components)
    k = directions(rng, 100)
    for name in ("a.npz", "b.csv"):
        np.testing.assert_allclose(read_antenna(tmp_path / name).field(jnp.asarray(k)), crossed_field(k), atol=1e-3)


def msi(gain="17.85 dBi", tilt=6):
    """A beam of 65 degrees, 10 degrees high, tilted downwards; the azimuth of the file is clockwise."""
    angle = (np.arange(360) + 180) % 360 - 180
    horizontal = np.minimum(12 * ((angle - 20) / 65) ** 2, 30)  # 20 degrees clockwise
    vertical = np.minimum(12 * ((angle - tilt) / 10) ** 2, 20)
    cuts = [f"{i} {a:.6f}" for cut in (horizontal, vertical) for i, a in enumerate(cut)]
    return "\n".join(["NAME x", f"GAIN {gain}", "HORIZONTAL 360", *cuts[:360], "VERTICAL 360", *cuts[360:]])


@pytest.mark.parametrize(
    ("gain", "dbi"),
    [
        *[("17.85 dBi", 17.85), ("15.70 dBd", 17.85), ("15.7", 17.85)],
        *[("15.7 dBd (17.85 dBi)", 17.85), ("17.85 (dBi) 15.7 (dBd)", 17.85), ("17.85dBi", 17.85), ("15,7 dBd", 17.85)],
        *[("18. dBi", 18.0), ("1.785E+01 dBi", 17.85), ("+1.57e1", 17.85)],
    ],
)
@pytest.mark.parametrize("end", ["\n", "\r\r\n"])
def test_an_msi_file_adds_the_attenuations_of_its_cuts(tmp_path, gain, dbi, end):
    text = msi(gain).replace("NAME x", "NAME München 6°").replace("GAIN", "GAIN:" if end == "\n" else "GAIN")
    (tmp_path / "a.msi").write_bytes(text.replace("\n", end).encode("latin-1"))
    antenna = read_antenna(tmp_path / "a.msi")
    azimuth, elevation = np.radians([-20, 12.5, -20, -20]), np.radians([-6, -6, -11, -1])
    k = angles_to_direction(jnp.asarray(azimuth, jnp.float32), jnp.asarray(np.pi / 2 - elevation, jnp.float32))
    found = antenna.field(k)
    np.testing.assert_allclose(20 * np.log10(np.linalg.norm(found, axis=-1)), dbi - np.array([0, 3, 3, 3]), atol=0.02)
    along = np.sum(np.asarray(found) * np.asarray(zenith_vector(k)), -1)
    np.testing.assert_allclose(along, np.linalg.norm(found, axis=-1), rtol=1e-5)  # vertically polarised


@pytest.mark.parametrize(
    ("line", "degrees"),
    [("V", 0), ("vertical", 0), ("H", 90), ("HORIZONTAL", 90), ("+45", 45), ("45", 45), ("-45", -45), ("DUAL SLANT 45", None)],
)
def test_an_msi_file_has_the_polarisation_that_it_names(tmp_path, line, degrees, recwarn):
    (tmp_path / "a.msi").write_text(msi().replace("NAME x", f"NAME x\nPOLARIZATION {line}"))
    (tmp_path / "b.msi").write_text(msi())
    k = angles_to_direction(jnp.array([0.1, -0.4]), jnp.array([1.7, 1.6]))
    own, upright = (np.asarray(read_antenna(tmp_path / f"{name}.msi").field(k)) for name in "ab")
    angle = np.radians(degrees or 0)
    expected = np.cos(angle) * upright + np.sin(angle) * np.cross(np.asarray(k), upright)
    np.testing.assert_allclose(own, expected, atol=1e-5 * np.abs(upright).max())
    notes = [str(note.message) for note in recwarn]
    assert len(notes) == (degrees is None) and all(
        "a.msi: the polarisation 'DUAL SLANT 45' is taken to be" in note for note in notes
    )


def test_columns_that_describe_an_antenna_only_in_other_programs(tmp_path):
    """A frequency and a running number are no part of the pattern."""
    rows = table(lambda a, z: 2).splitlines()
    numbered = [f"{number},{row},{28}" for number, row in enumerate(rows[1:])]
    (tmp_path / "a.csv").write_text("\n".join([f",{rows[0]},frequency_ghz", *numbered]))
    assert read_antenna(tmp_path / "a.csv")
    numbered[-1] = numbered[-1][:-2] + "29"
    (tmp_path / "a.csv").write_text("\n".join([f",{rows[0]},frequency_ghz", *numbered]))
    with pytest.raises(UserError, match=r"a\.csv is for 29, other lines for 28; give one frequency per file"):
        read_antenna(tmp_path / "a.csv")


def test_gains_relative_to_the_largest_are_noted(tmp_path, recwarn):
    """Of a beam, whose mean would be far below that of a passive antenna; an isotropic antenna has 0 dB everywhere."""
    (tmp_path / "a.csv").write_text(table(lambda a, z: 0))
    (tmp_path / "b.csv").write_text(table(lambda a, z: 8 - z / 10 - a / 20))
    read_antenna(tmp_path / "a.csv"), read_antenna(tmp_path / "b.csv")
    assert not recwarn
    (tmp_path / "c.csv").write_text(table(lambda a, z: -z / 10 - a / 20))
    with pytest.warns(UserWarning, match=r"c\.csv: the largest gain is 0 dB, and the mean .* add it to all of them"):
        read_antenna(tmp_path / "c.csv")


def test_fields_in_decibels_are_refused(tmp_path):
    decibels = -20 * np.abs(np.cos(ZENITH))[:, None] * np.ones(len(AZIMUTH))
    np.savez(tmp_path / "a.npz", e_theta=decibels, e_phi=decibels - 40, zenith=ZENITH, azimuth=AZIMUTH)
    with pytest.raises(UserError, match=r"e_theta of .*a\.npz is real; give the complex field, neither"):
        read_antenna(tmp_path / "a.npz")


def table(gain, azimuths=range(0, 360, 30)):
    rows = [f"{a},{z},{gain(a, z)}" for z in range(0, 181, 30) for a in azimuths]
    return "\n".join(["azimuth_deg,zenith_deg,gain_dbi", *rows])


def test_repeated_directions_have_one_value(tmp_path):
    """Azimuths of 0 and 360 degrees may both be measured, but two frequencies have no common table."""
    azimuths = range(0, 361, 30)
    for name, last, fits in (("a.csv", 2.2, True), ("b.csv", -3, False), ("c.csv", "nan", False)):
        (tmp_path / name).write_text(table(lambda a, z, last=last: last if a == 360 else 2, azimuths))
        if fits:
            assert read_antenna(tmp_path / name)
        else:
            with pytest.raises(UserError, match=r"different values for one direction|gains beyond 80 dBi"):
                read_antenna(tmp_path / name)
    parts = (f"{a},{z},1,0,{1e-17 * (a == 360)},0" for z in range(0, 181, 30) for a in azimuths)
    (tmp_path / "d.csv").write_text("\n".join(["azimuth_deg,zenith_deg,theta_re,theta_im,phi_re,phi_im", *parts]))
    assert read_antenna(tmp_path / "d.csv")


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.txt", "", "does not end in"),
        ("a.csv", "azimuth_deg,gain_dbi\n", "no column zenith_deg"),
        ("a.csv", "azimuth_deg,zenith_deg,gain_dbi,gain_phi_dbi\n", "column 'gain_phi_dbi', which is not read beside gain_dbi"),
        ("a.csv", "azimuth_deg,zenith_deg,gain_dbi,phase_rad\n", "column 'phase_rad', which"),
        ("a.csv", "azimuth_deg,zenith_deg,gain_dbi,theta_re,theta_im,phi_re,phi_im\n", "column 'theta_re', which is not read"),
        ("a.csv", "azimuth_deg,zenith_deg,gain_dbi\n0,0,x\n", "line 2"),
        ("a.csv", "azimuth_deg,zenith_deg,gain_dbi\n0,0,1\n90,90,1\n", "no regular grid"),
        ("a.csv", "azimuth_deg,zenith_deg,gain_dbi\n0,0,-3,5\n", "line 2 of .* has 4 cells, but the header has 3"),
        ("a.csv", "azimuth_deg,zenith_deg,gain_dbi,gain_dbi\n0,0,1,2\n", "two columns 'gain_dbi'"),
        ("a.csv", 'azimuth_deg,zenith_deg,gain_dbi\n0,0,"1\n' + "0,0,1\n" * 30_000, "check its quotation marks"),
        ("a.csv", table(lambda a, z: 40 if a < 60 else 30), "gains of 34 dB on average over the sphere"),
        ("a.msi", re.sub(r"(?m)^(\d+) ", r"\1 -", msi()), "attenuations down to -30 dB; give positive"),
        ("a.csv", "azimuth_deg,zenith_deg,gain_dbi\n0,0,100\n", "beyond 80 dBi"),
        ("a.pln", "NAME x\nGAIN 3\n", "not an MSI Planet file"),
        ("a.msi", msi().replace("\n90 ", "\n91 "), "not an MSI Planet file"),
        ("a.msi", msi("17.85 dB"), "needs GAIN in dBd or dBi"),
    ],
)
def test_a_wrong_file_is_one_line(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match=words) as error:
        read_antenna(tmp_path / name)
    assert "\n" not in str(error.value) and name in str(error.value)

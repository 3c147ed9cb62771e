"""Tables of paths, responses and matrices against closed forms, and against each other."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import tiny_settings
from builders.toys import as_trained
from builders.wave_runs import PARTS, RX, places, run_in

from wbgs_jax._util.files import write_csv
from wbgs_jax.data.tables import read_table
from wbgs_jax.inference.evaluate_quantities import SIGHT, LoadedField, mimo_matrices, predict_gains, predict_paths
from wbgs_jax.inference.predictor import observe_queries
from wbgs_jax.inference.quantities import Options
from wbgs_jax.inference.results_file import Answers, table_rows
from wbgs_jax.interchange.sionna_arrays import cir_of_paths
from wbgs_jax.radio.array import SPEED_OF_LIGHT, pas_directions, planar_array, steering_vector
from wbgs_jax.types import make_query

SETTINGS = tiny_settings(
    "wave",
    field={"specular_tried": 64, "specular_kept": 32, "diffracted_tried": 32, "diffracted_kept": 16, "mirror_areas": (0.0,)},
)
TX, GHZ = np.array([[4.5, 3.0, 1.6]]), np.array([6e9])
NOTHING = np.zeros(3)


@pytest.fixture(scope="module")
def asked(tmp_path_factory):
    run = run_in(PARTS, SETTINGS, tmp_path_factory.mktemp("room"), places(2), np.array([6e9]))
    trained = as_trained(run.field, run.state.params)
    return LoadedField(trained, run.dataset, run.dataset.receiver())


def paths(asked, tx=TX, tx_velocity=NOTHING, rx_velocity=NOTHING, ghz=GHZ):
    moving = dataclasses.replace(asked, options=Options(tx_velocity, rx_velocity))
    return moving.evaluate("paths", tx, ghz)


def amplitudes(table, name="element"):
    return table[f"{name}_re"] + 1j * table[f"{name}_im"]


def directions(table, end):
    zenith, azimuth = (np.radians(table[f"{end}_{angle}_deg"]) for angle in ("zenith", "azimuth"))
    return np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], -1)


def steering(asked, table):
    towards = jnp.asarray(directions(table, "arrival"), jnp.float32)
    return np.asarray(steering_vector(jnp.asarray(asked.receiver.element_positions), towards))


def snapshot(asked, tx=TX, hz=GHZ):
    query = make_query(np.repeat(tx, len(hz), 0), np.tile(hz, len(tx)))
    return np.asarray(observe_queries(asked.trained, asked.receiver, query, "snapshots"))


@pytest.mark.heavy
def test_the_line_of_sight_is_that_of_free_space(asked):
    table = paths(asked)
    (sight,) = np.flatnonzero(table["interactions"] == SIGHT)
    separation = TX[0] - RX
    length = np.linalg.norm(separation)
    np.testing.assert_allclose(table["length_m"][sight], length, rtol=1e-6)
    np.testing.assert_allclose(table["delay_ns"][sight], length / SPEED_OF_LIGHT * 1e9, rtol=1e-6)
    np.testing.assert_allclose(directions(table, "departure")[sight], -separation / length, atol=1e-5)
    np.testing.assert_allclose(directions(table, "arrival")[sight], separation / length, atol=1e-5)
    wave = SPEED_OF_LIGHT / GHZ[0]
    np.testing.assert_allclose(np.abs(amplitudes(table, "theta"))[sight], wave / (4 * np.pi * length), rtol=1e-5)
    assert np.abs(amplitudes(table, "phi"))[sight] < 1e-6 * wave
    np.testing.assert_allclose(table["power_db"], 20 * np.log10(np.abs(amplitudes(table))), atol=1e-3)
    assert (np.diff(table["power_db"]) <= 1e-6).all() and len(table["interactions"]) > 8


def test_walls_mirror_the_transmitter(asked):
    """Every path with one reflection is as long as the way to the transmitter's image in one of the planes."""
    table = paths(asked)
    words = np.char.startswith(table["interactions"].astype(str), "off ") & (
        np.char.find(table["interactions"].astype(str), ",") < 0
    )
    facets = asked.trained.field.facets
    height = TX[0] @ np.asarray(facets.normal).T - np.asarray(facets.offset)
    images = TX[0] - 2 * height[:, None] * np.asarray(facets.normal)
    lengths = np.linalg.norm(images - np.asarray(RX), axis=-1)
    assert words.sum() >= 4
    for length in table["length_m"][words]:
        assert np.abs(lengths - length).min() < 1e-4
    assert {word.removeprefix("off ") for word in table["interactions"][words]} <= set(asked.dataset.materials.names)


def test_points_of_a_path_span_its_length(asked):
    """Also in an archive, not in a table of text, whose cells are single numbers."""
    table = paths(asked)
    points = table["points_m"]
    lengths = np.linalg.norm(np.diff(points, axis=1), axis=-1).sum(-1)
    np.testing.assert_allclose(lengths, table["length_m"], rtol=1e-4)
    np.testing.assert_allclose(points[:, 0], np.broadcast_to(TX[0], (len(points), 3)), atol=1e-5)
    np.testing.assert_allclose(points[:, -1], np.broadcast_to(RX, (len(points), 3)), atol=1e-5)
    assert "points_m" not in next(table_rows(Answers([table])))


@pytest.mark.heavy
def test_paths_add_up_to_the_snapshot(asked):
    table = paths(asked)
    total = amplitudes(table) @ steering(asked, table)
    truth = snapshot(asked)[0]
    np.testing.assert_allclose(total, truth, atol=2e-4 * np.abs(truth).max())


@pytest.mark.heavy
def test_doppler_shifts_are_rates_of_lengths(asked, rng):
    tx_velocity, rx_velocity, moment = rng.normal(size=3), np.zeros(3), 1e-3
    now = paths(asked, tx_velocity=tx_velocity, rx_velocity=rx_velocity)
    later = paths(asked, tx=TX + moment * tx_velocity)
    compared = 0
    for i, met in enumerate(now["interactions"]):
        alike = np.flatnonzero(later["interactions"] == met)
        near = alike[np.abs(later["length_m"][alike] - now["length_m"][i]) < 2 * moment * np.linalg.norm(tx_velocity)]
        if len(near) != 1:
            continue
        rate = (later["length_m"][near[0]] - now["length_m"][i]) / moment
        expected = -GHZ[0] / SPEED_OF_LIGHT * rate
        np.testing.assert_allclose(now["doppler_hz"][i], expected, atol=0.03 * 20 * np.linalg.norm(tx_velocity))
        compared += 1
    assert compared >= 5
    together = paths(asked, tx_velocity=tx_velocity, rx_velocity=tx_velocity)
    (sight,) = np.flatnonzero(together["interactions"] == SIGHT)
    assert abs(together["doppler_hz"][sight]) < 1e-3  # both ends move alike


@pytest.mark.heavy
def test_a_response_is_that_of_the_paths(asked):
    band, points = 40e6, 16
    answer = dataclasses.replace(asked, options=Options(band_hz=band, points=points)).evaluate("frequency-response", TX, GHZ)
    response, table = answer["frequency_response"][0, 0], paths(asked)
    assert response.shape == (points, 16) and answer["offsets_hz"][points // 2] == 0
    turns = np.exp(-2j * np.pi * answer["offsets_hz"][:, None] * table["delay_ns"] * 1e-9)
    expected = (turns * amplitudes(table)) @ steering(
        asked, table
    )  # materials and spreading hardly change over so narrow a band
    np.testing.assert_allclose(response, expected, atol=0.05 * np.abs(expected).max())
    np.testing.assert_allclose(
        np.sum(np.abs(answer["impulse_response"]) ** 2), np.sum(np.abs(response) ** 2) / points, rtol=1e-4
    )  # Parseval
    kernel = np.exp(2j * np.pi * np.outer(answer["delays_s"], answer["offsets_hz"])) / points
    np.testing.assert_allclose(answer["impulse_response"][0, 0], kernel @ response, atol=1e-4 * np.abs(response).max())


@pytest.mark.heavy
def test_a_matrix_is_what_elements_elsewhere_would_send(asked):
    elements = planar_array(2, 2)
    matrix = dataclasses.replace(asked, options=Options(tx_array=(2, 2))).evaluate("mimo", TX, GHZ)["mimo"][0, 0]
    assert matrix.shape == (16, 4)
    for curved in (0.0, 1.0):
        params = dataclasses.replace(asked.trained.params, curved=jnp.asarray(curved))
        own = dataclasses.replace(asked, trained=dataclasses.replace(asked.trained, params=params))
        centre = mimo_matrices(own, TX, GHZ, np.zeros((1, 3)))[0, 0]
        np.testing.assert_allclose(centre[:, 0], snapshot(own)[0], rtol=1e-3, atol=1e-7)
    small = elements * 0.02  # plane waves hold for small arrays
    found = mimo_matrices(asked, TX, GHZ, small)[0, 0]
    for column, place in zip(found.T, small, strict=True):
        truth = snapshot(asked, TX + place * SPEED_OF_LIGHT / GHZ[0])[0]
        np.testing.assert_allclose(column, truth, atol=0.01 * np.abs(truth).max())
    assert np.linalg.norm(found - found[:, :1]) > 0.01 * np.linalg.norm(found)


def test_an_array_out_of_tune_is_so_in_every_quantity(asked, rng):
    """A matrix of one transmit element and the sum of an impulse response are the snapshot; the gain is of its best beam."""
    gains = np.exp(rng.normal(0, 0.2, 16) + 1j * rng.normal(0, 0.5, 16))
    field = asked.trained.field.with_gains(gains[None])
    own = dataclasses.replace(asked, trained=dataclasses.replace(asked.trained, field=field))
    expected = snapshot(own)[0]
    near = {"rtol": 1e-3, "atol": 1e-3 * np.abs(expected).max()}
    np.testing.assert_allclose(expected, gains * snapshot(asked)[0], **near)
    np.testing.assert_allclose(mimo_matrices(own, TX, GHZ, np.zeros((1, 3)))[0, 0, :, 0], expected, **near)
    found = predict_gains(own.trained, own.receiver)
    np.testing.assert_allclose(found, gains, rtol=1e-5)
    a, _ = cir_of_paths(predict_paths(own.trained, own.receiver, TX, GHZ[0]), own.receiver, GHZ[0], found)
    alone = predict_paths(own.trained, own.receiver, TX[0], GHZ[0])
    assert alone.length.shape == predict_paths(own.trained, own.receiver, TX, GHZ[0]).length.shape, "one position is one row"
    np.testing.assert_allclose(a[0, 0, :, 0, 0, :, 0].sum(-1), expected, **near)
    elements = jnp.asarray(own.receiver.element_positions)
    strongest = np.abs(np.asarray(steering_vector(elements, jnp.float32(pas_directions()))).conj() @ expected).max()
    best = 10 * np.log10(strongest**2 / 16 / np.mean(np.abs(expected) ** 2))
    np.testing.assert_allclose(own.evaluate("beamforming-gain", TX, GHZ)["beamforming_gain_db"][0, 0], best, atol=0.01)
    assert (predict_gains(asked.trained, asked.receiver) == 1).all()


def test_a_table_becomes_a_file(asked, tmp_path):
    table = paths(asked, tx=np.concatenate([TX, TX + 0.5]))
    write_csv(tmp_path / "paths.csv", table_rows(Answers([table])))
    header, rows = read_table(tmp_path / "paths.csv")
    assert (
        header == [name for name in table if name != "points_m"]
        and len(rows) == len(table["tx"])
        and set(table["tx"]) == {0, 1}
    )
    powers = np.array([float(row[header.index("power_db")]) for row in rows])
    np.testing.assert_allclose(powers, table["power_db"], atol=1e-3)
    assert [row[header.index("interactions")] for row in rows] == table["interactions"].tolist()

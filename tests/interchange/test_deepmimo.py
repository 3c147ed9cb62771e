"""DeepMIMO scenarios: folders and single files, round trips, and the channel that they stand for."""

import numpy as np
import pytest
from builders.drawn_paths import draw_paths
from scipy.io import savemat

from wbgs_jax._util.errors import UserError
from wbgs_jax.interchange.deepmimo import as_deepmimo, from_deepmimo, load_deepmimo, read_deepmimo, write_deepmimo
from wbgs_jax.interchange.ray_paths import DIFFRACTION, REFRACTION, SPECULAR, RayPaths
from wbgs_jax.radio.array import SPEED_OF_LIGHT


@pytest.fixture
def paths(rng):
    return draw_paths(rng, receivers=5, transmitters=2)


def test_there_and_back(paths, tmp_path):
    for transmitter in (0, 1):
        write_deepmimo(tmp_path, as_deepmimo(paths, transmitter), paths.frequency_hz, tx=transmitter)
    both = load_deepmimo(tmp_path)
    np.testing.assert_allclose(both.channel(), paths.channel(), rtol=1e-4)
    assert both.frequency_hz == paths.frequency_hz and both.interactions.shape[1:3] == (5, 2)
    for transmitter in (0, 1):
        back = from_deepmimo(read_deepmimo(tmp_path, tx=transmitter), paths.frequency_hz)
        # Stored phases hold the propagation: the channel at the carrier is exact, that without it as exact as single delays.
        np.testing.assert_allclose(back.channel()[:, 0], paths.channel()[:, transmitter], rtol=1e-4)
        np.testing.assert_allclose(back.channel(0.0)[:, 0], paths.channel(0.0)[:, transmitter], rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(back.targets, paths.targets, rtol=1e-6)
        np.testing.assert_allclose(back.sources, paths.sources[[transmitter]], rtol=1e-6)
        assert back.valid.sum() == paths.valid[:, transmitter].sum()
        again = as_deepmimo(back)
        for name, values in as_deepmimo(paths, transmitter).items():
            own = again[name]
            if name == "inter_pos":  # as many places as the longest path that was drawn has
                most = min(own.shape[-2], values.shape[-2])
                assert np.isnan(values[..., most:, :]).all()
                own, values = own[..., :most, :], values[..., :most, :]
            np.testing.assert_allclose(own, values, rtol=1e-4, atol=1e-4)


def test_interactions_are_digits(paths):
    met, valid = np.zeros((3, 1, 1, 3), int), np.array([[[True, True, False]]])
    met[:, 0, 0, 0] = [SPECULAR, REFRACTION, DIFFRACTION]
    one = draw_paths(np.random.default_rng(0), 1, 1, 3)
    a = np.array([[[3.0, 2.0, 1.0]]]) + 0j
    codes = as_deepmimo(type(one)(**{**vars(one), "interactions": met, "valid": valid, "a": a}))["inter"]
    np.testing.assert_array_equal(codes, [[142, 0, np.nan]])


def test_a_file_of_matlab(paths, tmp_path):
    arrays = as_deepmimo(paths)
    savemat(tmp_path / "scenario.mat", arrays)
    np.testing.assert_array_equal(read_deepmimo(tmp_path / "scenario.mat")["power"], arrays["power"])


def test_what_is_no_scenario(paths, tmp_path):
    with pytest.raises(UserError, match="power_t001_tx000_r000"):
        read_deepmimo(tmp_path)
    with pytest.raises(UserError, match="cannot read"):
        read_deepmimo(tmp_path / "gone.npz")
    arrays = as_deepmimo(paths)
    write_deepmimo(tmp_path, {name: values for name, values in arrays.items() if name != "delay"}, 2e9)
    with pytest.raises(UserError, match="has no delay"):
        read_deepmimo(tmp_path)
    np.savez(tmp_path / "delay_t001_tx000_r000.npz", delay=arrays["delay"][:2])
    with pytest.raises(UserError, match=r"delay in .* has shape \(2, 4\); expected \(5, 4\): users"):
        read_deepmimo(tmp_path)


@pytest.mark.parametrize("name", ["power", "phase", "aoa_el"])
def test_arrays_of_other_units(rng, tmp_path, name):
    arrays = as_deepmimo(two_rays(rng)[0])
    other = 10 ** (arrays[name] / 10) if name == "power" else np.radians(arrays[name])
    write_deepmimo(tmp_path, {**arrays, name: other}, 3.5e9)
    with pytest.raises(UserError, match=rf"{name} in .* is .* to .*; give (decibels|degrees)"):
        load_deepmimo(tmp_path)
    with pytest.raises(UserError, match=r"cannot read .*nowhere: the scenario does not exist; check the path"):
        load_deepmimo(tmp_path / "nowhere", 3.5e9)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [("power", np.inf, "is infinite"), *((name, np.nan, "is not finite") for name in ("phase", "delay", "aod_az", "aoa_el"))],
)
def test_paths_with_a_power_have_all_values(rng, tmp_path, name, value, words):
    arrays = as_deepmimo(two_rays(rng)[0])
    arrays[name][3, 0] = value
    write_deepmimo(tmp_path, arrays, 3.5e9)
    with pytest.raises(UserError, match=f"{name} in .* {words}"):
        load_deepmimo(tmp_path)
    arrays["power"][3, 0] = np.nan
    write_deepmimo(tmp_path, arrays, 3.5e9)
    assert load_deepmimo(tmp_path).valid.sum() == arrays["power"].size - 1


def two_rays(rng, n=30):
    """Line of sight and an image below a metal floor, isotropic antennas."""
    tx, users = np.array([[0.0, 0, 2]]), np.column_stack([rng.uniform(3, 40, n), rng.uniform(-5, 5, n), np.full(n, 1.5)])
    ends = np.stack([users - tx, users - tx * [1, 1, -1]], 1)
    length = np.linalg.norm(ends, axis=-1)
    wave = SPEED_OF_LIGHT / 3.5e9
    a = wave / (4 * np.pi * length) * np.array([1, -1])
    channel = (a * np.exp(-2j * np.pi * length / wave)).sum(1)
    direction = ends / length[..., None]
    theta, phi = np.arccos(direction[..., 2]), np.arctan2(direction[..., 1], direction[..., 0])
    met = np.zeros((1, n, 1, 2), int)
    met[..., 1] = SPECULAR
    one = {"theta_t": theta, "phi_t": phi, "theta_r": np.pi - theta, "phi_r": phi, "tau": length / SPEED_OF_LIGHT}
    places = np.full((1, n, 1, 2, 3), np.nan)
    shaped = {name: values[:, None] for name, values in one.items()}
    rays = RayPaths(a[:, None] + 0j, **shaped, interactions=met, vertices=places, valid=np.ones((n, 1, 2), bool),
                    sources=tx, targets=users, frequency_hz=3.5e9)  # fmt: skip
    return rays, channel


def test_phases_hold_the_propagation(rng):
    """What is written sums to the channel, as DeepMIMO itself sums it."""
    rays, channel = two_rays(rng)
    arrays = as_deepmimo(rays)
    summed = np.nansum(10 ** (arrays["power"] / 20) * np.exp(1j * np.radians(arrays["phase"])), 1)
    np.testing.assert_allclose(summed, channel, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(from_deepmimo(arrays, 3.5e9).channel()[:, 0], channel, rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize("holds", [True, False])
def test_lines_of_sight_show_whether_phases_hold_it(rng, holds):
    """Another writer's phases, and whatever the ray tracer is named."""
    rays, channel = two_rays(rng)
    arrays = as_deepmimo(rays)
    if not holds:
        arrays["phase"] = arrays["phase"] + np.degrees(2 * np.pi * 3.5e9 * arrays["delay"].astype(np.float64))
    for otherwise in (True, False):
        np.testing.assert_allclose(from_deepmimo(arrays, 3.5e9, otherwise).channel()[:, 0], channel, rtol=2e-3, atol=1e-5)


def test_phases_of_the_opposite_sign_are_refused_and_others_noted(rng):
    arrays = as_deepmimo(two_rays(rng)[0])
    for otherwise in (True, False):
        with pytest.raises(UserError, match="lines of sight grow with their delays; give the opposite sign"):
            from_deepmimo(arrays | {"phase": -arrays["phase"]}, 3.5e9, otherwise)
        with pytest.warns(
            UserWarning, match=f"neither agree nor follow .* {'include' if otherwise else 'exclude'} the propagation"
        ):
            from_deepmimo(arrays, 3.4e9, otherwise)


def test_the_frequency_and_the_users_are_those_of_the_parameters(rng, tmp_path):
    rays, channel = two_rays(rng)
    write_deepmimo(tmp_path, as_deepmimo(rays), 3.5e9)
    np.testing.assert_allclose(load_deepmimo(tmp_path).channel()[:, 0], channel, rtol=2e-3, atol=1e-5)
    with pytest.raises(UserError, match=r"is for 3\.5 GHz, not 28; leave out --ghz"):
        load_deepmimo(tmp_path, 28e9)
    stations = {name: values[:3] if name != "tx_pos" else values for name, values in as_deepmimo(rays).items()}
    for name, values in stations.items():  # base stations among themselves, the same set as the transmitter's
        np.savez(tmp_path / f"{name}_t001_tx000_r001.npz", **{name: values})
    with pytest.warns(UserWarning, match="users of set 0, transmitters of set 1; others: --rx-set 1"):
        assert len(load_deepmimo(tmp_path).targets) == 30
    assert len(load_deepmimo(tmp_path, rx_set=1).targets) == 3
    with pytest.raises(UserError, match="has no such transmitter and users; it has t001_tx000_r000, t001_tx000_r001"):
        load_deepmimo(tmp_path, tx=4)
    (tmp_path / "params.json").unlink()
    with pytest.raises(UserError, match="does not record its frequency"):
        load_deepmimo(tmp_path)


def test_a_scenario_has_one_frequency(rng, tmp_path):
    arrays = as_deepmimo(two_rays(rng)[0])
    write_deepmimo(tmp_path, arrays, 3.5e9)
    write_deepmimo(tmp_path, arrays, 28e9)  # instead of the one before
    with pytest.raises(UserError, match="has other transmitters or users at 28 GHz, not 60; choose another folder"):
        write_deepmimo(tmp_path, arrays, 60e9, tx=1)
    write_deepmimo(tmp_path, arrays, 28e9, tx=1)
    assert load_deepmimo(tmp_path).frequency_hz == 28e9 and load_deepmimo(tmp_path).a.shape[1] == 2


@pytest.mark.parametrize(
    "content",
    [
        "{broken",
        '{"txrx_sets": [{"id": 1}]}',
        '{"txrx_sets": {"txrx_set_1": 7}}',
        '{"txrx_sets": {"txrx_set_1": {"num_points": "x"}}}',
    ],
)
def test_damaged_parameters_are_refused_before_anything_is_written(rng, tmp_path, content):
    (tmp_path / "params.json").write_text(content)
    with pytest.raises(UserError, match=r"params\.json"):
        write_deepmimo(tmp_path, as_deepmimo(two_rays(rng)[0]), 3.5e9)
    assert [path.name for path in tmp_path.iterdir()] == ["params.json"]


def test_transmitters_of_different_users_are_a_choice(rng, tmp_path):
    for number in (0, 1):
        write_deepmimo(tmp_path, as_deepmimo(two_rays(rng)[0]), 3.5e9, tx=number)
    with pytest.raises(UserError, match="2 transmitters have different users; choose one, --tx-index 0, 1"):
        load_deepmimo(tmp_path)
    assert load_deepmimo(tmp_path, tx=1).a.shape == (30, 1, 2)


def test_the_package_loads_it_and_computes_the_same_channel(rng, tmp_path, monkeypatch):
    deepmimo = pytest.importorskip("deepmimo", reason="DeepMIMO is not installed")
    rays, channel = two_rays(rng)
    write_deepmimo(tmp_path / "deepmimo_scenarios" / "street", as_deepmimo(rays), 3.5e9)
    monkeypatch.chdir(tmp_path)
    loaded = deepmimo.load("street")
    how = deepmimo.ChannelParameters()
    how.bs_antenna.shape = how.ue_antenna.shape = np.array([1, 1])
    how.ofdm.subcarriers, how.ofdm.selected_subcarriers = 1, np.array([0])
    how.ofdm.bandwidth = 1e5  # longer delays than a symbol are left out
    theirs = loaded.compute_channels(how).reshape(-1)
    assert np.abs(20 * np.log10(np.abs(theirs) / np.abs(channel))).max() < 0.01
    assert abs(np.vdot(theirs, channel)) > 0.9999 * np.linalg.norm(theirs) * np.linalg.norm(channel)

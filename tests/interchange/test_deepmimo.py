"""DeepMIMO scenarios: folders and single files, round trips, and the channel that they stand for."""

import numpy as np
import pytest
from drawn_paths import draw_paths
from scipy.io import savemat

from wbgs_jax._util.errors import UserError
from wbgs_jax.interchange.deepmimo import as_deepmimo, from_deepmimo, read_deepmimo, write_deepmimo
from wbgs_jax.interchange.ray_paths import DIFFRACTION, REFRACTION, SPECULAR


@pytest.fixture
def paths(rng):
    return draw_paths(rng, receivers=5, transmitters=2)


def test_there_and_back(paths, tmp_path):
    for transmitter in (0, 1):
        write_deepmimo(tmp_path, as_deepmimo(paths, transmitter), tx=transmitter)
    for transmitter in (0, 1):
        back = from_deepmimo(read_deepmimo(tmp_path, tx=transmitter), paths.frequency_hz)
        np.testing.assert_allclose(back.channel(0.0)[:, 0], paths.channel(0.0)[:, transmitter], rtol=1e-4)
        np.testing.assert_allclose(back.channel()[:, 0], paths.channel()[:, transmitter], rtol=1e-3, atol=1e-3)
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
    write_deepmimo(tmp_path, {name: values for name, values in arrays.items() if name != "delay"})
    with pytest.raises(UserError, match="has no delay"):
        read_deepmimo(tmp_path)
    write_deepmimo(tmp_path, {"delay": arrays["delay"][:2]})
    with pytest.raises(UserError, match=r"delay in .* has shape \(2, 4\); expected \(5, 4\): users"):
        read_deepmimo(tmp_path)

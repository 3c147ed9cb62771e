"""SINR, received power and noise against the radio maps of Sionna RT."""

import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax.radio.channel import noise_dbm, sinr_db

pytestmark = pytest.mark.usefixtures("simulator_backend")

POWERS_DBM = (23.0, 30.0, 17.0)
BANDWIDTH_HZ, TEMPERATURE_K = 400e6, 310.0


@pytest.fixture(scope="module")
def radio_map(simulator_backend):
    import mitsuba as mi
    import sionna.rt as rt

    scene = rt.load_scene(rt.scene.simple_wedge)
    scene.frequency, scene.bandwidth, scene.temperature = 3.5e9, BANDWIDTH_HZ, TEMPERATURE_K
    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    for number, power in enumerate(POWERS_DBM):
        place = mi.Point3f(20.0 + 15 * number, -10.0 + 12 * number, 8.0)
        scene.add(rt.Transmitter(f"tx-{number}", position=place, power_dbm=power))
    return rt.RadioMapSolver()(scene, cell_size=mi.Point2f(10, 10), samples_per_tx=20_000, max_depth=2, seed=1)


def test_sinr_is_that_of_a_radio_map(radio_map):
    gain, rss, sinr = (np.array(getattr(radio_map, name)) for name in ("path_gain", "rss", "sinr"))
    received = 10 * np.log10(np.maximum(gain, 1e-30)) + np.array(POWERS_DBM)[:, None, None]
    some = rss > 0
    assert some.sum() > 20
    np.testing.assert_allclose(received[some], 10 * np.log10(rss[some]) + 30, atol=0.01)
    noise = noise_dbm(BANDWIDTH_HZ, 0.0, TEMPERATURE_K)
    found = np.moveaxis(np.asarray(sinr_db(jnp.moveaxis(jnp.asarray(received, jnp.float32), 0, -1), noise)), -1, 0)
    # Sionna subtracts the signal from the sum of all: its interference is exact where the signal is not most of the sum.
    exact = some & (rss < 0.999 * rss.sum(0)) | some & (rss.sum(0) == rss)
    assert exact.sum() > 20
    np.testing.assert_allclose(found[exact], 10 * np.log10(sinr[exact]), atol=0.1)

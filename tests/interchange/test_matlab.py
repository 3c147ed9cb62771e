"""MATLAB's files: the arrays that SciPy writes, of all kinds, and damaged sizes that are told instead of followed."""

import numpy as np
import pytest
from scipy.io import savemat

from wbgs_jax._util.errors import UserError
from wbgs_jax.interchange.matlab import read_mat


@pytest.mark.parametrize("compressed", [True, False])
def test_arrays_come_back(rng, tmp_path, compressed):
    arrays = {
        "double": rng.normal(size=(4, 3, 2)),
        "single": rng.normal(size=(1, 7)).astype(np.float32),
        "complex": rng.normal(size=(2, 5)) + 1j * rng.normal(size=(2, 5)),
        "small": np.array([[3]], np.uint8),
        "long_name_of_an_array": rng.integers(-9, 9, (3, 3)),
        "empty": np.zeros((0, 3)),
    }
    savemat(tmp_path / "a.mat", arrays | {"text": "words", "cell": {"a": 1}}, do_compression=compressed)
    found = read_mat(tmp_path / "a.mat")
    assert found.keys() == arrays.keys()
    for name, values in arrays.items():
        np.testing.assert_array_equal(found[name], values)
        assert found[name].dtype == values.dtype


def test_damaged_ones_are_told_and_never_followed(rng, tmp_path):
    """SciPy's reader ends the process here."""
    path = tmp_path / "a.mat"
    savemat(path, {"a": rng.normal(size=(6, 5))})
    whole, refused = path.read_bytes(), 0
    for place in range(112, len(whole)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        try:
            read_mat(path)
        except UserError as error:
            refused += "\n" not in str(error)
    assert refused > 30
    for wrong in (b"", b"MATLAB 7.3", whole[:100], whole[:-9]):
        path.write_bytes(wrong)
        with pytest.raises(UserError, match="version 5"):
            read_mat(path)

"""Files of other programs are refused by what they are, with the way from there."""

import pytest
from builders.commands import assert_error_for_people, call

from wbgs_jax._util.errors import UserError
from wbgs_jax.commands import convert as convert_command
from wbgs_jax.data import load_dataset
from wbgs_jax.data.load import KINDS


@pytest.mark.parametrize("suffix", KINDS)
def test_a_file_is_refused_by_its_kind(tmp_path, suffix):
    path = tmp_path / f"data{suffix}"
    path.write_text("anything")
    with pytest.raises(UserError, match=f"is {KINDS[suffix][0]}, not a scene file; .+"):
        load_dataset(path)
    if suffix not in (".mat", ".npz"):
        assert_error_for_people(
            call(convert_command.main, "--paths", path, "--ghz", "28", "--out", tmp_path / "o.npz"), KINDS[suffix][0]
        )
    assert not (tmp_path / "o.npz").exists()


def test_folders_of_others_are_refused_by_what_they_lack(tmp_path):
    (tmp_path / "rf" / "sparse" / "0").mkdir(parents=True)
    with pytest.raises(UserError, match=r"RF-3DGS.* without positions of transmitters"):
        load_dataset(tmp_path / "rf")
    (tmp_path / "arrays").mkdir()
    (tmp_path / "arrays" / "spectra.npy").write_bytes(b"")
    with pytest.raises(UserError, match=r"NumPy arrays; create a folder of images"):
        load_dataset(tmp_path / "arrays")


def test_an_unknown_file_of_paths(tmp_path):
    (tmp_path / "paths.dat").write_text("anything")
    arguments = ["--paths", tmp_path / "paths.dat", "--ghz", "28", "--out", tmp_path / "o.npz"]
    assert_error_for_people(
        call(convert_command.main, *arguments), "of an unknown kind; give an .npz file with Sionna's arrays"
    )

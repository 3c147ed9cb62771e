"""Gaussians as a splatting PLY: the layout to the byte, and back."""

import jax.numpy as jnp
import numpy as np
import pytest
from plyfile import PlyData

from wbgs_jax._util.errors import UserError
from wbgs_jax.interchange.gaussian_ply import NAMES, read_gaussians, write_gaussians
from wbgs_jax.mesh.ply import write_ply
from wbgs_jax.radio.geometry import covariance_factor, rotation_matrix
from wbgs_jax.types import Gaussians


@pytest.fixture
def gaussians(rng):
    def some(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    logits = some(7).at[3].set(-jnp.inf)  # a slot without a Gaussian
    return Gaussians(some(7, 3), some(7, 3), some(7, 4), logits, some(7, 2))


def test_there_and_back(gaussians, rng, tmp_path):
    colours = rng.uniform(size=(7, 3))
    assert write_gaussians(tmp_path / "a.ply", gaussians, colours) == 6
    read, back = read_gaussians(tmp_path / "a.ply")
    alive = np.arange(7) != 3
    for name in ("means", "log_scales", "opacity_logits"):
        np.testing.assert_array_equal(getattr(read, name), np.asarray(getattr(gaussians, name))[alive])
    np.testing.assert_allclose(rotation_matrix(read.quats), rotation_matrix(gaussians.quats[alive]), atol=1e-6)
    np.testing.assert_allclose(back, colours[alive], atol=1e-6)


def test_the_layout_is_that_of_splat_viewers(gaussians, tmp_path):
    """62 float32 a Gaussian, little endian, in the order that viewers read them."""
    write_gaussians(tmp_path / "a.ply", gaussians, opacity=np.full(7, 0.5))
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 6"]
    assert lines[3:] == [f"property float {name}" for name in NAMES] and len(NAMES) == 62
    rows = np.frombuffer(body, "<f4").reshape(6, 62)
    np.testing.assert_array_equal(rows[:, :3], np.asarray(gaussians.means)[np.arange(7) != 3])
    np.testing.assert_array_equal(rows[:, 3:54], 0)  # normals, grey, no further harmonics
    np.testing.assert_allclose(rows[:, 54], 0, atol=1e-6)  # half transparent
    np.testing.assert_allclose(np.linalg.norm(rows[:, 58:], axis=1), 1, atol=1e-6)


def test_a_viewer_that_follows_the_papers_conventions_draws_the_same_gaussians(gaussians, rng, tmp_path):
    """Its steps, written out: exp of scales, sigmoid of opacity, w x y z quaternions as they stand, the SH constant."""
    colours, share = rng.uniform(size=(7, 3)), rng.uniform(0.1, 0.9, 7)
    write_gaussians(tmp_path / "a.ply", gaussians, colours, share)
    rows, alive = PlyData.read(tmp_path / "a.ply")["vertex"], np.arange(7) != 3

    def columns(*names):
        return np.stack([np.asarray(rows[name], float) for name in names], -1)

    np.testing.assert_allclose(1 / (1 + np.exp(-columns("opacity")[:, 0])), share[alive], atol=1e-6)
    np.testing.assert_allclose(0.5 + 0.28209479177387814 * columns("f_dc_0", "f_dc_1", "f_dc_2"), colours[alive], atol=1e-6)
    w, x, y, z = columns("rot_0", "rot_1", "rot_2", "rot_3").T
    first = np.stack([w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)], -1)  # where x goes
    second = np.stack([2 * (x * y - w * z), w * w - x * x + y * y - z * z, 2 * (y * z + w * x)], -1)
    axes = np.stack([first, second, np.cross(first, second)], -1) * np.exp(columns("scale_0", "scale_1", "scale_2"))[:, None]
    ours = covariance_factor(gaussians.log_scales, gaussians.quats)[alive]
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), ours @ ours.transpose(0, 2, 1), rtol=1e-4, atol=1e-5)


def test_what_holds_no_gaussians(gaussians, tmp_path):
    with pytest.raises(UserError, match="cannot read"):
        read_gaussians(tmp_path / "gone.ply")
    write_ply(tmp_path / "points.ply", np.eye(3), np.zeros((0, 3), int))
    with pytest.raises(UserError, match="has no f_dc_0"):
        read_gaussians(tmp_path / "points.ply")
    write_gaussians(tmp_path / "a.ply", gaussians)
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-9])
    with pytest.raises(UserError, match="truncated"):
        read_gaussians(tmp_path / "a.ply")

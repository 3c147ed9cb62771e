"""PLY files in and out, whole and damaged."""

import time

import numpy as np
import pytest

from wbgs_jax._util.errors import UserError
from wbgs_jax.mesh.ply import read_ply, write_ply

HEADER = """ply
format ascii 1.0
element vertex {n}
property float x
property float y
property float z
element face {m}
property list uchar int {name}
end_header
"""


def ascii_ply(path, vertices, polygons, name="vertex_indices"):
    rows = [" ".join(map(str, v)) for v in vertices] + [" ".join(map(str, [len(p), *p])) for p in polygons]
    path.write_text(HEADER.format(n=len(vertices), m=len(polygons), name=name) + "\n".join(rows) + "\n")


@pytest.fixture
def polygon_file(tmp_path):
    circle = [(np.cos(a), np.sin(a), 0.0) for a in np.linspace(0, 2 * np.pi, 6, endpoint=False)]
    ascii_ply(tmp_path / "mixed.ply", circle, [(0, 1, 2), (5, 4, 3, 2), (0, 1, 2, 3, 4, 5), (0, 1)])
    return tmp_path / "mixed.ply"


@pytest.mark.parametrize("n_faces", [0, 1, 40])
def test_round_trip_is_exact(tmp_path, rng, n_faces):
    vertices = rng.normal(size=(9, 3)).astype(np.float32)
    faces = rng.integers(0, 9, (n_faces, 3)).astype(np.int32)
    write_ply(tmp_path / "mesh.ply", vertices, faces)
    again, triangles = read_ply(tmp_path / "mesh.ply")
    assert (again.dtype, triangles.dtype) == (np.float32, np.int32)
    np.testing.assert_array_equal(again, vertices)
    np.testing.assert_array_equal(triangles, faces)


def test_polygons_become_fans(polygon_file):
    _, faces = read_ply(polygon_file)
    assert faces.tolist() == [[0, 1, 2], [5, 4, 3], [5, 3, 2], [0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]


def test_a_fan_keeps_the_polygon_s_area(tmp_path):
    n = 17
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    ascii_ply(tmp_path / "p.ply", [(np.cos(a), np.sin(a), 0) for a in angle], [range(n)], name="vertex_index")
    vertices, faces = read_ply(tmp_path / "p.ply")
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.cross(b - a, c - a)[:, 2].sum() / 2
    assert area == pytest.approx(n / 2 * np.sin(2 * np.pi / n), rel=1e-5)


def test_a_cloud_has_no_faces(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\nend_header\n"
    (tmp_path / "cloud.ply").write_text(header + "1 2 3\n4 5 6\n")
    vertices, faces = read_ply(tmp_path / "cloud.ply")
    assert vertices.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert faces.shape == (0, 3)
    assert faces.dtype == np.int32


def test_a_large_mixed_mesh_loads_in_about_a_second(shared_data):
    path = shared_data("wideband3dgs_example1") / "point_cloud.ply"
    start = time.process_time()  # whatever else the machine does
    vertices, faces = read_ply(path)
    assert time.process_time() - start < 5  # 0.3 s of processor time
    assert vertices.shape == (71_102, 3)
    assert faces.shape == (107_717 + 2 * 12, 3)  # triangles, and quads as two each


def bad(path, message):
    with pytest.raises(UserError) as error:
        read_ply(path)
    text = str(error.value)
    assert path.name in text and "\n" not in text and message in text, text


def test_a_missing_file(tmp_path):
    bad(tmp_path / "no.ply", "No such file")


def test_a_folder(tmp_path):
    bad(tmp_path, "cannot read")


@pytest.mark.parametrize("content", [b"", b"hello\n", b"\x89PNG\r\n\x1a\n\x00\xff", b"ply\nformat ascii 1.0\nend_header"])
def test_not_a_ply(tmp_path, content):
    (tmp_path / "x.ply").write_bytes(content)
    with pytest.raises(UserError, match=r"x\.ply"):
        read_ply(tmp_path / "x.ply")


def test_without_points(tmp_path):
    ascii_ply(tmp_path / "none.ply", [], [])
    bad(tmp_path / "none.ply", "no points")


def test_truncated_anywhere(tmp_path, rng):
    whole = tmp_path / "whole.ply"
    write_ply(whole, rng.normal(size=(20, 3)).astype(np.float32), rng.integers(0, 20, (30, 3)).astype(np.int32))
    content = whole.read_bytes()
    for length in rng.integers(0, len(content), 40):
        (tmp_path / "cut.ply").write_bytes(content[:length])
        with pytest.raises(UserError, match=r"cut\.ply"):
            read_ply(tmp_path / "cut.ply")


def test_truncated_text(polygon_file):
    polygon_file.write_text(polygon_file.read_text()[:-20])
    bad(polygon_file, "truncated")


@pytest.mark.parametrize("text", ["0 0 0 9\n1 0 0 9\n0 1 0 9\n", "0 0 0\n1 0 0\n0 1 0\n1 1 0\n"], ids=["columns", "rows"])
def test_text_with_more_numbers_than_declared(tmp_path, text):
    (tmp_path / "x.ply").write_text(HEADER.format(n=3, m=0, name="vertex_indices") + text)
    bad(tmp_path / "x.ply", "3 numbers more than its header declares")


@pytest.mark.parametrize("corner", [-1, 3])
def test_faces_that_point_nowhere(tmp_path, corner):
    ascii_ply(tmp_path / "x.ply", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, corner)])
    bad(tmp_path / "x.ply", "do not exist")


def test_nan_vertices(tmp_path):
    ascii_ply(tmp_path / "x.ply", [(0, 0, "nan")], [])
    bad(tmp_path / "x.ply", "NaN")


def test_an_absurd_header(tmp_path):
    (tmp_path / "x.ply").write_bytes(
        HEADER.format(n=10**15, m=0, name="vertex_indices").replace("ascii", "binary_little_endian").encode()
    )
    bad(tmp_path / "x.ply", "truncated")

"""PLY elements as an independent library writes and reads them: any types, byte orders, lists of any length."""

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from wbgs_jax._util.errors import UserError
from wbgs_jax.mesh.ply import Ragged, read_elements, write_elements

KINDS = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]


def drawn(rng, kind, size):
    return rng.integers(0, 100, size).astype(kind) if kind[0] != "f" else rng.normal(size=size).astype(kind)


def made_up(rng, rows, alike):
    """Two elements: numbers of all types, and lists among numbers."""
    numbers = np.zeros(rows, [(f"n_{kind}", kind) for kind in KINDS])
    for kind in KINDS:
        numbers[f"n_{kind}"] = drawn(rng, kind, rows)
    lists = np.zeros(rows, [("before", "f4"), ("corners", object), ("between", "u2"), ("weights", object)])
    lists["before"], lists["between"] = drawn(rng, "f4", rows), drawn(rng, "u2", rows)
    for name, kind in (("corners", "i4"), ("weights", "f8")):
        sizes = np.full(rows, 3) if alike else rng.integers(0, 6, rows)
        for row, size in enumerate(sizes):
            lists[name][row] = drawn(rng, kind, size)
    return numbers, lists


@pytest.mark.parametrize("order", ["=", "<", ">"], ids=["text", "little", "big"])
@pytest.mark.parametrize("alike", [True, False])
@pytest.mark.parametrize("rows", [1, 40])
def test_what_another_library_has_written(tmp_path, rng, order, alike, rows):
    numbers, lists = made_up(rng, rows, alike)
    kinds = {"len_types": {"corners": "u1", "weights": "i4"}, "val_types": {"corners": "i4", "weights": "f8"}}
    elements = [PlyElement.describe(numbers, "point"), PlyElement.describe(lists, "face", **kinds)]
    PlyData(elements, text=order == "=", byte_order=order, comments=["made up"]).write(tmp_path / "x.ply")
    found = read_elements(tmp_path / "x.ply")
    assert list(found) == ["point", "face"]
    for name in numbers.dtype.names:
        np.testing.assert_allclose(found["point"][name], numbers[name], rtol=1e-6)
        assert found["point"][name].dtype == numbers[name].dtype
    if order == ">":  # of elements with lists that library swaps no bytes, and cannot read them itself
        return
    for name in ("before", "between"):
        np.testing.assert_allclose(found["face"][name], lists[name], rtol=1e-6)
    for name in ("corners", "weights"):
        assert isinstance(found["face"][name], Ragged)
        assert found["face"][name].sizes.tolist() == [len(row) for row in lists[name]]
        np.testing.assert_allclose(found["face"][name].values, np.concatenate(lists[name]), rtol=1e-6)


@pytest.mark.parametrize("first", [b"\n", b"\r", b"a"])
@pytest.mark.parametrize("ends", [b"\n", b"\r\n", b"\r"])
def test_headers_with_any_ends_of_lines(tmp_path, ends, first):
    """Whatever byte the content begins with."""
    header = [b"ply", b"format binary_little_endian 1.0", b"element point 2", b"property uchar x", b"end_header", b""]
    (tmp_path / "x.ply").write_bytes(ends.join(header) + first + b"\n")
    assert read_elements(tmp_path / "x.ply")["point"]["x"].tolist() == [first[0], 10]


def test_what_another_library_reads(tmp_path, rng):
    rows = np.zeros(7, [("x", "<f4"), ("count", "u1"), ("list", "<i4", (4,)), ("y", ">f8")])
    for name in rows.dtype.names:
        rows[name] = rng.integers(0, 100, rows[name].shape)
    write_elements(tmp_path / "x.ply", {"thing": rows, "nothing": rows[:0]})
    found = PlyData.read(tmp_path / "x.ply")
    assert [element.name for element in found.elements] == ["thing", "nothing"]
    for name in ("x", "count", "y"):
        np.testing.assert_array_equal(found["thing"][name], rows[name])
    np.testing.assert_array_equal(np.stack(found["thing"]["list"]), rows["list"])
    again = read_elements(tmp_path / "x.ply")
    np.testing.assert_array_equal(again["thing"]["list"].values.reshape(7, 4), rows["list"])
    assert len(again["nothing"]["x"]) == 0 and len(again["nothing"]["list"].sizes) == 0


@pytest.mark.parametrize("alike", [True, False])
def test_what_is_cut_or_changed_is_read_or_refused(tmp_path, rng, alike):
    numbers, lists = made_up(rng, 9, alike)
    kinds = {"len_types": {"corners": "i4", "weights": "f4"}, "val_types": {"corners": "i4", "weights": "f8"}}
    whole = tmp_path / "whole.ply"
    PlyData([PlyElement.describe(numbers, "point"), PlyElement.describe(lists, "face", **kinds)]).write(whole)
    content = whole.read_bytes()
    for place in rng.integers(0, len(content), 60):
        changed = bytearray(content)
        changed[place] ^= 1 << rng.integers(8)
        for damaged in (content[:place], bytes(changed)):
            (tmp_path / "x.ply").write_bytes(damaged)
            try:
                read_elements(tmp_path / "x.ply")
            except UserError as error:
                assert "x.ply" in str(error) and "\n" not in str(error)

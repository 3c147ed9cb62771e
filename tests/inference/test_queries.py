"""What is asked: lines, grids, sweeps and files of queries; and how queries fall into blocks."""

import numpy as np
import pytest

from wbgs_jax._util.errors import UserError
from wbgs_jax.inference.queries import Queries, parse_grid, parse_line, parse_sweep, read_queries, shown_rows


def test_a_line_has_both_ends_and_equal_steps():
    np.testing.assert_allclose(parse_line("0,0,1.5:4,2,1.5:5"), [[i, i / 2, 1.5] for i in range(5)])


def test_a_grid_runs_along_x_first():
    places = parse_grid("0,0,1:2,1,1:3x2x1")
    np.testing.assert_allclose(places, [[0, 0, 1], [1, 0, 1], [2, 0, 1], [0, 1, 1], [1, 1, 1], [2, 1, 1]])


def test_a_sweep_is_logarithmic_and_stays_in_its_band():
    np.testing.assert_allclose(parse_sweep("1:100:3"), [1, 10, 100], rtol=1e-12)
    assert min(parse_sweep("0.3:100:77")) == 0.3 and max(parse_sweep("0.3:100:77")) == 100


def test_a_file_of_queries(tmp_path):
    path = tmp_path / "queries.csv"
    path.write_text("name, GHz,x,y,z\nfirst,28,1,2,1.5\n\nsecond,2.4,-1,0,1\n")
    positions, ghz = read_queries(path)
    np.testing.assert_array_equal(positions, [[1, 2, 1.5], [-1, 0, 1]])
    assert ghz == (28.0, 2.4)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["no column x, y, z, ghz"]),
        ("x,y,z\n1,2,3\n", ["no column ghz"]),
        ("x,y,z,ghz\n", ["no queries"]),
        ("x,y,z,ghz\n1,2,3,28\n1,2,up,28\n", ["line 3"]),
        ("x,y,z,ghz\n1,2,3\n", ["line 2"]),
        ("x,y,z,ghz\n1,2,3,28\n\n1,5,0,5,1,5,28\n", ["line 4", "has 7 cells, but the header has 4"]),
        ("x,y,z,ghz,GHz\n1,2,3,28,60\n", ["two columns 'ghz'"]),
        ('x,y,z,ghz\n"1,2,3,28\n' + "1,2,3,28\n" * 20_000, ["is not CSV", "check its quotation marks"]),
        ("x,y,z,ghz\n1,2,nan,28\n", ["line 2"]),
        ("x,y,z,ghz\n1,2,3e9,28\n", ["is not a position"]),
        ("x,y,z,ghz\n1,2,2001,28\n", ["is not a position", "at most 2000"]),
        ("x,y,z,ghz\n1_0,2,3,28\n", ["line 2", "lacks a number"]),
        ("x;y;z;ghz\n1,0;2,0;3,0;28,0\n", ["separated by semicolons; write commas", "decimal points"]),
        ("x\ty\tz\tghz\n1\t2\t3\t28\n", ["separated by tabs"]),
    ],
)
def test_files_that_are_refused(tmp_path, text, words):
    path = tmp_path / "queries.csv"
    path.write_text(text)
    with pytest.raises(UserError) as error:
        read_queries(path)
    for word in [str(path), *words]:
        assert word in str(error.value)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-be"])
def test_a_file_in_utf_16_is_named(tmp_path, encoding):
    path = tmp_path / "queries.csv"
    path.write_bytes(("\ufeff" * (encoding == "utf-16-be") + "x,y,z,ghz\n1,2,3,28\n").encode(encoding))
    with pytest.raises(UserError, match="is in UTF-16; save it as text in UTF-8"):
        read_queries(path)


@pytest.mark.parametrize(
    ("parse", "word"),
    [
        (parse_line, "0,0,1:4,0,1"),
        (parse_line, "0,0,1:4,0,1:0"),
        (parse_line, "0,0:4,0,1:5"),
        (parse_line, "0,0,1:4,0,1:9999999"),
        (parse_line, "0,0,1:2001,0,1:5"),
        (parse_line, "0,0,1:4_0,0,1:5"),
        (parse_grid, "0,0,1:2001,0,1:5x5x1"),
        (parse_grid, "0,0,1:4,0,1:5"),
        (parse_grid, "0,0,1:4,0,1:5x5xtwo"),
        (parse_grid, "0,0,1:4,0,1:5000x5000x1"),
        (parse_sweep, "1:100"),
        (parse_sweep, "0:100:5"),
        (parse_sweep, "a:b:5"),
        (parse_sweep, "nan:100:5"),
        (parse_sweep, "1:1_0:5"),
    ],
)
def test_words_that_are_refused(parse, word):
    with pytest.raises(UserError) as error:
        parse(word)
    assert str(error.value).startswith("--") and "\n" not in str(error.value)


@pytest.mark.parametrize("size", [1, 4, 7, 100])
@pytest.mark.parametrize("shape", [(5, 3), (1, 9), (9, 1)])
def test_blocks_hold_every_query_once_and_in_order(rng, shape, size):
    queries = Queries(rng.normal(size=(shape[0], 3)), rng.uniform(1e9, 1e11, shape[1]))
    check_blocks(queries, size)


@pytest.mark.parametrize("size", [1, 4, 100])
def test_blocks_of_pairs(rng, size):
    check_blocks(Queries(rng.normal(size=(11, 3)), rng.choice([1e9, 2e9, 3e9], 11), paired=True), size)


def check_blocks(queries, size):
    positions, frequencies = queries.flat()
    done = 0
    for block in queries.blocks(size):
        rows = np.sort(np.concatenate([product.rows for product in block]))
        np.testing.assert_array_equal(rows, np.arange(done, done + len(rows)))
        assert len(rows) <= size
        done += len(rows)
        for product in block:
            tx, freq = len(product.tx_positions), len(product.frequencies_hz)
            np.testing.assert_array_equal(positions[product.rows], np.repeat(product.tx_positions, freq, 0))
            np.testing.assert_array_equal(frequencies[product.rows], np.tile(product.frequencies_hz, tx))
            np.testing.assert_array_equal(queries.tx_positions[product.tx_numbers], product.tx_positions)
    assert done == len(queries)


def test_what_is_drawn_is_spread_over_the_queries():
    assert shown_rows(5).tolist() == [0, 1, 2, 3, 4]
    assert len(shown_rows(1000)) == 12 and shown_rows(1000)[[0, -1]].tolist() == [0, 999]

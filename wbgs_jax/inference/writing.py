"""Answers as files, and as lines for people."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from wbgs_jax._util.files import atomic_write, write_csv
from wbgs_jax.inference.parts import Answers, write_archive
from wbgs_jax.inference.queries import COLUMNS, Queries, shown_rows

PATHS = "paths"
TWO = ("azimuth", "zenith")
"""What pairs of numbers are of."""
DIGITS = ".7g"


def write(path: Path, what: str, answers: Answers, queries: Queries, source: dict[str, Any]) -> None:
    """Writes all answers: to a .csv file a row a query, or a path; to an .npz file arrays (tx, freq, ...), or (queries, ...)
    where queries are paired."""
    if path.suffix == ".csv":
        write_csv(path, table_rows(answers) if what == PATHS else query_rows(answers, queries))
        return
    known: dict[str, Any] = {}
    if what != PATHS:
        known = {"tx_positions": queries.tx_positions, "frequencies_hz": queries.frequencies_hz}
    write_archive(path, answers, None if what == PATHS else queries.shape, known, source)


def write_picture(path: Path, what: str, answers: Answers, queries: Queries) -> None:
    """Draws spectra, or curves of the quantity."""
    from wbgs_jax.inference.pictures import draw_curves, draw_spectra  # here: Matplotlib takes a while to load

    name = answers.names()[0]
    if what == "spectra":
        shown = shown_rows(len(queries))
        positions, frequencies = queries.flat()
        figure = draw_spectra(answers.rows(name, shown), positions[shown], frequencies[shown])
    else:
        figure = draw_curves(name, answers.whole(name), queries)
    with atomic_write(path) as stream:
        figure.savefig(stream, format="png", dpi=110)


def query_rows(answers: Answers, queries: Queries) -> Iterator[list[Any]]:
    """Gives a header, and a row a query: its columns x, y, z, ghz, and the numbers that answer it."""
    names = answers.names()
    columns = []
    for name in names:
        values = answers.whole(name)
        if values.ndim == 1:
            columns.append((name, values))
        else:
            columns += [(f"{TWO[i]}_{name}", values[:, i]) for i in range(values.shape[1])]
    yield [*COLUMNS, *(name for name, _ in columns)]
    positions, frequencies = queries.flat()
    for i, (position, frequency) in enumerate(zip(positions, frequencies, strict=True)):
        numbers = [*position, frequency / 1e9, *(values[i] for _, values in columns)]
        yield [format(float(number), DIGITS) for number in numbers]


def table_rows(answers: Answers) -> Iterator[list[Any]]:
    """Gives a header, and the rows of a table."""
    names = answers.names()
    yield names
    for number in range(len(answers)):
        with answers.opened(number) as block:
            for row in zip(*(block[name] for name in names), strict=True):
                yield [format(value, DIGITS) if isinstance(value, np.floating) else value for value in row]


NO_CONFIDENCE = "no confidence: it lies outside of what was trained, or where no antenna can stand"


def lines(what: str, answers: Answers, queries: Queries, source: dict[str, Any]) -> list[str]:
    """Returns how good some of the answers are expected to be, where that is known: one line each. `source` holds the level of
    their intervals (`answers.source_of`)."""
    from wbgs_jax.inference.bounds import link_words

    if what == PATHS or not {"expected", "within_db"} & set(answers.names()):
        return []
    shown = shown_rows(len(queries))
    positions, frequencies = (part[shown] for part in queries.flat())
    where = [link_words(position, float(frequency)) for position, frequency in zip(positions, frequencies, strict=True)]
    sure = f"{100 * source['interval_level' if what == 'spectra' else 'power_interval_level']:.0f} %"
    if what == "spectra":
        expected = zip(where, answers.rows("expected", shown), strict=True)
        return [
            f"{link}: {NO_CONFIDENCE}"
            if np.isnan(ssim)
            else f"{link}: expected SSIM {ssim:.2f}, {sure} between {low:.2f} and {min(high, 1):.2f}"
            for link, (ssim, low, high) in expected
        ]
    columns = (answers.rows(name, shown) for name in ("power_db", "expected_error_db", "within_db"))
    return [
        f"{link}: {power:.1f} dB of the transmitted power; "
        + (NO_CONFIDENCE if np.isnan(error) else f"expected {error:.1f} dB off, {sure} within {within:.1f} dB")
        for link, power, error, within in zip(where, *columns, strict=True)
    ]

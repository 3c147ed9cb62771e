"""Tables of readings as people's programs write them: powers at their receivers and places by a closed form, or refused."""

import csv
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from builders.conformance.entries import entries
from wbgs_jax.data.rssi_folder import load_readings

HEIGHT = 1.3
RECEIVERS = {"AP-03": (0.5, 0.5, 2.4), "AP-01": (9.0, 1.0, 2.0), "AP-12": (4.0, 6.5, 2.2)}
"""Not in the order of their numbers."""
PLACES = np.round(np.stack(np.meshgrid(np.linspace(0.5, 9, 6), np.linspace(0.5, 6, 5)), -1).reshape(-1, 2), 2)


def powers(names: list[str]) -> np.ndarray:
    """Returns -40 - 22 log10(d) dBm for receivers by name, NaN where it is below -59: not received."""
    tx = np.column_stack([PLACES, np.full(len(PLACES), HEIGHT)])
    distance = np.stack([np.linalg.norm(tx - RECEIVERS[name], axis=1) for name in names], 1)
    found = np.round(-40 - 22 * np.log10(distance), 2)
    return np.where(found < -59, np.nan, found)


@dataclass
class Powers:
    """A folder of readings."""

    path: Path
    measure: str = field(default="powers", init=False)
    tolerance: float = 1e-6

    def difference(self) -> float:
        """Returns the largest difference of powers, places and receivers."""
        found = load_readings(self.path, HEIGHT)
        names = list(RECEIVERS)
        truth = powers(names)
        order = [int(np.linalg.norm(found.receivers - RECEIVERS[name], axis=1).argmin()) for name in names]
        own = found.powers[:, order]
        if own.shape != truth.shape or not np.array_equal(np.isnan(own), np.isnan(truth)):
            return float("inf")
        places = np.abs(found.places[:, :2] - PLACES).max() + np.abs(found.receivers[order] - list(RECEIVERS.values())).max()
        return float(max(np.nanmax(np.abs(own / truth - 1)), places / 10))


def columns(order: list[str], prefix: str = "rssi_", suffix: str = "") -> dict[str, np.ndarray]:
    """Returns a table: places, then receivers in an order of its own."""
    values = powers(order)
    own = {f"{prefix}{name}{suffix}": values[:, number] for number, name in enumerate(order)}
    return {"x": PLACES[:, 0], "y": PLACES[:, 1], **own}


ORDER = ["AP-12", "AP-03", "AP-01"]


def receivers(folder: Path) -> None:
    """Writes the list of receivers."""
    with (folder / "receivers.csv").open("w", newline="") as stream:
        table = csv.writer(stream)
        table.writerows([["id", "x", "y", "z"], *([name, *place] for name, place in RECEIVERS.items())])


def by_csv(names: dict[str, str] | None = None, encoding: str = "utf-8", missing: Any = "", **how: Any) -> Callable:
    """Returns a maker by Python's own module."""

    def make(folder: Path) -> Powers:
        receivers(folder)
        table = columns(ORDER)
        rows = [[missing if np.isnan(value) else value for value in row] for row in zip(*table.values(), strict=True)]
        head = [(names or {}).get(name, name) for name in table]
        with (folder / "readings.csv").open("w", newline="", encoding=encoding) as stream:
            csv.writer(stream, **how).writerows([head, *rows])
        return Powers(folder)

    return make


def by_pandas(prefix: str = "rssi_", suffix: str = "", change: Callable[[Any], Any] | None = None, **how: Any) -> Callable:
    """Returns a maker by pandas."""

    def make(folder: Path) -> Powers:
        import pandas

        receivers(folder)
        frame = pandas.DataFrame(columns(ORDER, prefix, suffix))
        (change or (lambda one: one))(frame).to_csv(folder / "readings.csv", **{"index": False, **how})
        return Powers(folder)

    return make


def by_numpy(**how: Any) -> Callable:
    """Returns a maker by `numpy.savetxt`, which writes NaN where nothing was received."""

    def make(folder: Path) -> Powers:
        receivers(folder)
        table = columns(ORDER)
        head = how.get("delimiter", " ").join(table)
        np.savetxt(folder / "readings.csv", np.column_stack(list(table.values())), **{"header": head, **how})
        return Powers(folder)

    return make


def by_pyarrow(folder: Path) -> Powers:
    """By Arrow, which puts words in quotes."""
    import pyarrow
    import pyarrow.csv

    receivers(folder)
    table = {name: [None if np.isnan(value) else value for value in column] for name, column in columns(ORDER).items()}
    pyarrow.csv.write_csv(pyarrow.table(table), folder / "readings.csv")
    return Powers(folder)


def by_workbook(folder: Path) -> Powers:
    """By openpyxl: a workbook in the place of a table."""
    import openpyxl

    receivers(folder)
    book = openpyxl.Workbook()
    book.active.append(list(columns(ORDER)))
    book.save(folder / "readings.xlsx")
    return Powers(folder)


def nerf2(rename: dict[str, str] | None = None, order: list[str] = ORDER) -> Callable:
    """Returns a maker of NeRF2's layout for gateways."""

    def make(folder: Path) -> Powers:
        import yaml

        listed = {(rename or {}).get(name, name): list(place) for name, place in RECEIVERS.items()}
        (folder / "gateway_position.yml").write_text(yaml.safe_dump(listed, sort_keys=False))
        np.savetxt(folder / "tx_pos.csv", np.c_[PLACES, np.full(len(PLACES), HEIGHT)], "%.3f", ",", header="x,y,z", comments="")
        values = np.nan_to_num(powers(order), nan=-100)
        head = ",".join((rename or {}).get(name, name) for name in order)
        np.savetxt(folder / "gateway_rssi.csv", values, "%.2f", ",", header=head, comments="")
        return Powers(folder)

    return make


def melted(frame: Any) -> Any:
    """Returns a row for every power, as databases have it."""
    return frame.melt(["x", "y"])


def milliwatts(frame: Any) -> Any:
    """Returns powers that are no decibels."""
    own = [name for name in frame if name not in ("x", "y")]
    return frame.assign(**{name: 10 ** (frame[name] / 10) for name in own})


def without_sign(frame: Any) -> Any:
    """Returns the powers of one receiver without their sign."""
    return frame.assign(**{"rssi_AP-03": -frame["rssi_AP-03"]})


def in_degrees(frame: Any) -> Any:
    """Returns places as longitudes and latitudes."""
    return frame.assign(x=8.54 + frame.x / 75e3, y=47.37 + frame.y / 111e3)


CSV = {
    ("csv", "commas"): by_csv(),
    ("csv", "all in quotes"): by_csv(quoting=csv.QUOTE_ALL),
    ("csv", "lines of Unix"): by_csv(lineterminator="\n"),
    ("csv", "byte order mark"): by_csv(encoding="utf-8-sig"),
    ("csv", "-100 where nothing was received"): by_csv(missing=-100),
    ("csv", "0 where nothing was received"): by_csv(missing=0),
    ("csv", "100 where nothing was received"): by_csv(missing=100),
    ("csv", "names glued, in capitals"): by_csv({f"rssi_{name}": name.replace("-", "") for name in ORDER}),
    ("csv", "names without zeros"): by_csv({f"rssi_{name}": name.replace("-0", "") for name in ORDER}),
    ("csv", "headers in capitals"): by_csv({name: name.upper() for name in columns(ORDER)}),
    ("csv", "semicolons"): (by_csv(delimiter=";"), "refused"),
    ("csv", "tabs"): (by_csv(delimiter="\t"), "refused"),
    ("csv", "UTF-16"): (by_csv(encoding="utf-16"), "refused"),
    ("csv", "NA where nothing was received"): (by_csv(missing="NA"), "refused"),
    ("csv", "columns that are places' names"): (
        by_csv({"rssi_AP-12": "kitchen", "rssi_AP-03": "hall", "rssi_AP-01": "office"}), "refused"
    ),
    ("csv", "two columns of one receiver"): (by_csv({"rssi_AP-12": "rssi_AP-01 (2)"}), "refused"),
}  # fmt: skip
PANDAS = {
    ("csv", "as it comes, without index"): by_pandas(),
    ("csv", "names behind, with a unit"): by_pandas("", " [dBm]"),
    ("csv", "a time beside"): by_pandas(change=lambda frame: frame.assign(timestamp="2025-03-01 12:00")),
    ("csv", "columns in another order"): by_pandas(change=lambda frame: frame[sorted(frame, reverse=True)]),
    ("csv", "nan in words"): by_pandas(na_rep="nan"),
    ("csv", "many digits"): by_pandas(float_format="%.12e"),
    ("csv", "with its index"): (by_pandas(index=True), "refused"),
    ("csv", "decimal commas"): (by_pandas(sep=";", decimal=","), "refused"),
    ("csv", "decimal commas in quotes"): (by_pandas(decimal=",", quoting=csv.QUOTE_ALL), "refused"),
    ("csv", "a row for every power"): (by_pandas(change=melted), "refused"),
    ("csv", "milliwatts"): (by_pandas(change=milliwatts), "refused"),
    ("csv", "magnitudes of one receiver"): (by_pandas(change=without_sign), "refused"),
    ("csv", "places in degrees"): (by_pandas(change=in_degrees), "refused"),
    ("csv", "a column of battery levels"): (by_pandas(change=lambda frame: frame.assign(battery=-3)), "refused"),
}
NUMPY = {
    ("csv", "commas, header without sign"): by_numpy(delimiter=",", comments=""),
    ("csv", "commas, header behind #"): (by_numpy(delimiter=","), "refused"),
    ("csv", "blanks"): (by_numpy(comments=""), "refused"),
}
YAML = {
    ("NeRF2's gateways", "columns in another order"): nerf2(),
    ("NeRF2's gateways", "numbers alone"): nerf2({"AP-03": "gateway3", "AP-01": "gateway1", "AP-12": "gateway12"}),
    ("NeRF2's gateways", "in the order of the list"): nerf2(order=list(RECEIVERS)),
}
ENTRIES = [
    *entries("Python's csv", CSV),
    *entries("pandas", PANDAS, ("pandas",), "pandas"),
    *entries("NumPy", NUMPY, ("numpy",), "numpy"),
    *entries("PyYAML", YAML, ("yaml",), "pyyaml"),
    *entries("PyArrow", {("csv", "words in quotes"): by_pyarrow}, ("pyarrow",), "pyarrow"),
    *entries("openpyxl", {("xlsx", "in the place of readings.csv"): (by_workbook, "refused")}, ("openpyxl",), "openpyxl"),
]

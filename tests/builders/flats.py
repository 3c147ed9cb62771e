"""A made-up flat of two rooms, and readings that follow a known law of distance and walls."""

import csv
from pathlib import Path

import numpy as np

RECEIVERS = np.array([[0.5, 0.5, 2.2], [7.5, 3.5, 2.2], [4.5, 0.4, 1.8]])
WALL = np.array([[[4.0, 0.0], [4.0, 3.0]]])
LAW = np.array([-45.0, 1.8, 7.0])
HEIGHT = 1.3


def places(rng, n):
    """In a flat of 8 m x 4 m, with a wall at x = 4 m and a door at its end; nobody stands in the wall."""
    x = np.where(rng.random(n) < 0.5, rng.uniform(0.2, 3.95, n), rng.uniform(4.05, 7.8, n))
    return np.column_stack([x, rng.uniform(0.2, 3.8, n), np.full(n, HEIGHT)])


def walls_between(tx):
    """By the height at which the ray passes x = 4 m."""
    tx, rx = tx[:, None], RECEIVERS[None]
    share = (4 - tx[..., 0]) / (rx[..., 0] - tx[..., 0])
    y = tx[..., 1] + share * (rx[..., 1] - tx[..., 1])
    return ((share > 0) & (share < 1) & (y >= 0) & (y < 3)).astype(float)


def powers(tx, noise=0.0, rng=None):
    """dBm."""
    distance = np.linalg.norm(tx[:, None] - RECEIVERS, axis=-1)
    mean = LAW[0] - 10 * LAW[1] * np.log10(distance) - LAW[2] * walls_between(tx)
    return mean if rng is None else mean + rng.normal(0, noise, mean.shape)


def write_table(path: Path, header, rows) -> None:
    with path.open("w", newline="") as stream:
        csv.writer(stream).writerows([header, *rows])


def folder(path: Path, rng, n=300, noise=3.0, rooms=True) -> Path:
    """A folder of readings, of which one in ten was not received."""
    tx = places(rng, n)
    heard = powers(tx, noise, rng)
    lost = rng.random(heard.shape) < 0.1
    cells = np.where(lost, "", np.round(heard, 2).astype(str))
    names = [["west" if x < 4 else "east"] for x in tx[:, 0]] if rooms else [[] for _ in tx]
    header = ["x", "y", *(["room"] if rooms else []), "rssi_1", "rssi_2", "rssi_3"]
    write_table(path / "readings.csv", header, [[*p[:2], *r, *c] for p, r, c in zip(tx, names, cells, strict=True)])
    write_table(path / "receivers.csv", ["id", "x", "y", "z"], [[i + 1, *p] for i, p in enumerate(RECEIVERS)])
    write_table(path / "walls.csv", ["x1", "y1", "x2", "y2"], WALL.reshape(-1, 4))
    return path

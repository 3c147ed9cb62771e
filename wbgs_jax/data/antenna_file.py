"""Antenna patterns from files: CSV tables of the whole sphere, MSI Planet files with two cuts, and NumPy archives.

Frame: boresight +x, zenith angles from +z, azimuths counter-clockwise about +z. Gains are absolute (dBi). Fields (NumPy
archives, columns `theta_re` and so on) have an arbitrary unit: they are scaled to a lossless antenna, whose directivity
integrates to 4 pi; losses belong to the transmitted power. A file without polarisation describes a vertically polarised
antenna.
"""

import dataclasses
import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Inexact

from wbgs_jax._util.cli import parse_number
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import read_arrays, read_csv, read_text
from wbgs_jax.radio.antenna import Antenna, tabulated, zenith_weights

CUT = 360
"""Angles of a cut in an MSI file, one per degree."""


def read_antenna(path: Path) -> Antenna:
    """Returns the antenna of a pattern file (host).

    Args:
        path: a file that ends in `.csv`, `.msi`, `.pln` or `.npz`:

            * CSV: columns `azimuth_deg`, `zenith_deg` or `elevation_deg`, and `gain_dbi` with an optional `phase_deg`, or the
              four `theta_re`, `theta_im`, `phi_re` and `phi_im`; every direction of a regular grid over the sphere.
            * MSI Planet: `GAIN` (dBd, or dBi if the line says so), `POLARIZATION` (V, H, +45 or -45) and the cuts
              `HORIZONTAL 360` and `VERTICAL 360`, whose attenuations (dB) are added in every direction. Its azimuths are
              clockwise, its elevations positive downwards.
            * NumPy archive: complex `e_theta` and `e_phi` (zenith, azimuth), and the angles `zenith` and `azimuth` in radians.

    Returns:
        A tabulated antenna, unrotated: its gain is interpolated between the directions of the file.

    Raises:
        UserError: the file cannot be read, or does not describe the whole sphere.
    """
    readers = {".csv": _read_csv, ".msi": _read_msi, ".pln": _read_msi, ".npz": _read_archive}
    if path.suffix.lower() not in readers:
        raise UserError(f"{path} does not end in {', '.join(readers)}; convert the antenna pattern to one of these formats")
    return readers[path.suffix.lower()](path)


def _read_csv(path: Path) -> Antenna:
    names, rows = read_csv(path)
    vertical = next((name for name in ("zenith_deg", "elevation_deg", "elevation") if name in names), "zenith_deg")
    components = ("theta_re", "theta_im", "phi_re", "phi_im")  # columns of a CSV file with fields instead of gains
    values = ("gain_dbi",) if "gain_dbi" in names else components
    phase = ("phase_deg",) if "gain_dbi" in names else ()
    known = {"", "azimuth_deg", "zenith_deg", "elevation_deg", "elevation", *values, *phase}
    if unknown := [name for name in names if name not in known and not name.startswith("frequency")]:
        raise UserError(
            f"{path} has the column {unknown[0]!r}, which is not read beside {values[0]}; remove it, or give azimuth_deg, "
            f"zenith_deg, and either gain_dbi with an optional phase_deg, or {', '.join(components)}"
        )
    needed = ("azimuth_deg", vertical, *values)
    if missing := [name for name in needed if name not in names]:
        raise UserError(
            f"{path} has no column {', '.join(missing)}; its first line must name azimuth_deg, zenith_deg and gain_dbi, or "
            f"{', '.join(components)} instead of the gain"
        )
    optional = tuple(name for name in phase if name in names)
    rows = _of_one_frequency(path, names, rows)
    columns = [names.index(name) for name in (*needed, *optional)]
    table = []
    most_rows = 1_000_000  # largest number of directions: finer than half a degree
    for line, row in rows:
        try:
            table.append([parse_number(row[column]) for column in columns])
        except ValueError:
            raise UserError(f"line {line} of {path} lacks a number; fill {', '.join(needed)}") from None
        if len(table) > most_rows:
            raise UserError(f"{path} has more than {most_rows:,} directions; give a coarser grid")
    found = np.array(table, np.float64).reshape(-1, len(columns))
    zenith = found[:, 1] if vertical == "zenith_deg" else 90 - found[:, 1]
    if "gain_dbi" in names:
        _check_decibels(path, found[:, 2])
        amplitude: Inexact[np.ndarray, " n"] = 10 ** (found[:, 2] / 20)
        if optional:
            amplitude = amplitude * np.exp(1j * np.radians(found[:, 3]))
        return _antenna(path, on_grid(path, zenith, found[:, 0], amplitude[:, None])[..., 0], None)
    fields = on_grid(path, zenith, found[:, 0], found[:, [2, 4]] + 1j * found[:, [3, 5]])
    return _antenna(path, fields[..., 0], fields[..., 1])


def _of_one_frequency(path: Path, names: list[str], rows: Iterator[tuple[int, list[str]]]) -> Iterator[tuple[int, list[str]]]:
    """Yields the rows of a table, all of which must be for one frequency."""
    columns = [number for number, name in enumerate(names) if name.startswith("frequency")]
    first: list[str] | None = None
    for line, row in rows:
        own = [row[number] for number in columns]
        first = own if first is None else first
        if own != first:
            raise UserError(f"line {line} of {path} is for {own[0]}, other lines for {first[0]}; give one frequency per file")
        yield line, row


def _read_archive(path: Path) -> Antenna:
    arrays = read_arrays(path, "an antenna pattern", "export it again", ("e_theta", "e_phi", "zenith", "azimuth"))
    if missing := [name for name in ("e_theta", "e_phi", "zenith", "azimuth") if name not in arrays]:
        raise UserError(f"{path} has no array {', '.join(missing)}; it needs e_theta, e_phi, zenith and azimuth (radians)")
    angles = [np.degrees(np.asarray(arrays[name], np.float64).reshape(-1)) for name in ("zenith", "azimuth")]
    shape = tuple(map(len, angles))
    zenith, azimuth = (angle.reshape(-1) for angle in np.meshgrid(*angles, indexing="ij"))
    fields = []
    for name in ("e_theta", "e_phi"):
        if arrays[name].shape != shape or arrays[name].dtype.kind not in "fc":
            raise UserError(f"{name} of {path} has shape {arrays[name].shape}; give numbers of shape {shape}, like the angles")
        if arrays[name].dtype.kind == "f":
            raise UserError(f"{name} of {path} is real; give the complex field, neither its magnitude nor decibels")
        fields.append(np.asarray(arrays[name], np.complex128).reshape(-1))
    found = on_grid(path, zenith, azimuth, np.stack(fields, -1))
    return _antenna(path, found[..., 0], found[..., 1])


def _read_msi(path: Path) -> Antenna:
    lines = [words for line in read_text(path, "latin-1").splitlines() if (words := line.split())]
    head = {words[0].upper().rstrip(":="): words[1:] for words in lines if re.match("[A-Za-z]", words[0])}
    try:
        gain = _gain_dbi(" ".join(head["GAIN"]))
        horizontal, vertical = (_cut(lines, name) for name in ("HORIZONTAL", "VERTICAL"))
    except (KeyError, IndexError, ValueError):
        raise UserError(
            f"{path} is not an MSI Planet file; it needs GAIN in dBd or dBi, and below HORIZONTAL 360 and VERTICAL 360 360 "
            "lines each of an angle and an attenuation"
        ) from None
    least_db = -0.5  # smallest attenuation, for rounding and a maximum between two degrees
    if (lowest := min(horizontal.min(), vertical.min())) < least_db:
        raise UserError(f"{path} has attenuations down to {lowest:g} dB; give positive decibels below the largest gain")
    _check_decibels(path, np.concatenate([gain - horizontal, gain - vertical]))
    zenith, azimuth = np.arange(181), np.arange(CUT)
    attenuation = vertical[(zenith[:, None] - 90) % CUT] + horizontal[-azimuth % CUT]
    antenna = tabulated(10 ** ((gain - attenuation) / 20), None)
    polarisation = " ".join(head.get("POLARIZATION", ["V"])).upper()
    slants = {"V": 0, "VERTICAL": 0, "H": 90, "HORIZONTAL": 90, "+45": 45, "45": 45, "-45": -45}  # degrees
    if polarisation not in slants:
        warnings.warn(
            f"{path}: the polarisation {polarisation!r} is taken to be vertical; write that of one port: V, H, +45 or -45",
            stacklevel=2,
        )
    slant = np.float32(np.radians(slants.get(polarisation, 0)))
    return dataclasses.replace(antenna, slant=jnp.asarray(slant)) if slant else antenna


def _gain_dbi(text: str) -> float:
    """Returns the first gain in a text (dBi), which may have a decimal comma; a number alone is in dBd. Other units, and a
    text without a number, raise a `ValueError`."""
    dipole_dbi = 2.15  # gain of a half-wave dipole, the reference of dBd
    found = re.match(r"([-+\d.,e]+)(?:[\s([]*(dB[id])\b|$)", text, re.IGNORECASE)
    if found is None:
        raise ValueError("a gain that is not a number in dBd or dBi")
    return float(found[1].replace(",", ".")) + (0.0 if (found[2] or "").lower() == "dbi" else dipole_dbi)


def _cut(lines: list[list[str]], name: str) -> Float[np.ndarray, "360"]:
    """Returns the attenuations (dB) of a cut, by degree; raises a `ValueError` unless there is one for every degree."""
    start = next(i for i, words in enumerate([*lines, [name, ""]]) if words and words[0].upper() == name) + 1
    found = np.full(CUT, np.nan)
    for angle, value, *_ in lines[start : start + CUT]:
        degrees, attenuation = (float(word.replace(",", ".")) for word in (angle, value))
        if degrees % 1:
            raise ValueError("an angle between two degrees")
        found[int(degrees) % CUT] = attenuation
    if not np.isfinite(found).all():
        raise ValueError("an angle without a value")
    return found


def _check_decibels(path: Path, values: Float[np.ndarray, " n"]) -> None:
    largest_dbi = 80.0  # larger gains (dBi) are mistakes, such as powers instead of decibels
    if not (values < largest_dbi).all():
        raise UserError(f"{path} has gains beyond {largest_dbi:g} dBi; give decibels relative to an isotropic antenna")


def on_grid(
    path: Path, zenith_deg: Float[np.ndarray, " n"], azimuth_deg: Float[np.ndarray, " n"], values: Inexact[np.ndarray, "n k"]
) -> Inexact[np.ndarray, "zenith azimuth k"]:
    """Returns values of directions in any order on their regular grid: zenith angles 0..180 degrees, azimuths from 0 without
    360.

    Raises:
        UserError: the directions are not such a grid, values are not finite, or those of one direction differ.
    """
    azimuth_deg = np.round(azimuth_deg, 6) % 360
    zeniths, azimuths = np.unique(np.round(zenith_deg, 6)), np.unique(azimuth_deg)
    regular = len(zeniths) > 1 and len(azimuths) > 1
    tolerance = 1e-3  # largest deviation of an angle from its regular grid, degrees
    for angles, last in ((zeniths, 180), (azimuths, 360 - 360 / max(len(azimuths), 1))):
        regular = regular and bool(np.abs(angles - np.linspace(0, last, len(angles))).max() < tolerance)
    if not regular:
        raise UserError(
            f"{path} has no regular grid over the whole sphere; give zenith angles from 0 to 180 and azimuths from 0 to 360 "
            "degrees, at equal distances"
        )
    row, column = np.searchsorted(zeniths, np.round(zenith_deg, 6)), np.searchsorted(azimuths, azimuth_deg)
    table = np.full((len(zeniths), len(azimuths), values.shape[1]), np.nan, values.dtype)
    table[row, column] = values
    if not (np.isfinite(values).all() and np.isfinite(table).all()):
        raise UserError(f"{path} lacks a finite value in some directions of its grid; give one for every direction")
    same = 0.05  # maximum difference of repeated values (azimuths 0 and 360), relative to the largest: noise of a measurement
    if np.abs(table[row, column] - values).max() > same * np.abs(values).max():
        raise UserError(f"{path} has different values for one direction; give a single frequency and polarisation per file")
    return table


def _antenna(
    path: Path, theta: Inexact[np.ndarray, "zenith azimuth"], phi: Inexact[np.ndarray, "zenith azimuth"] | None
) -> Antenna:
    """Returns the antenna of amplitude gains (without `phi`), or of fields in any unit, which are scaled."""
    power = np.abs(theta) ** 2 + (0 if phi is None else np.abs(phi) ** 2)
    mean = float(np.sum(power.mean(1) * zenith_weights(len(power))))
    largest_mean = 2.0  # maximum mean power gain: 1 for a passive antenna, and an error of two cuts that were combined
    if phi is None and mean > largest_mean:
        raise UserError(
            f"{path} has gains of {10 * np.log10(mean):.3g} dB on average over the sphere, more than a passive antenna; give "
            "decibels relative to an isotropic antenna, not powers or attenuations"
        )
    largest, lost = float(power.max()), 0.5  # power gains: of the strongest direction, and mean of an antenna of 50 % losses
    if phi is None and mean < lost and abs(10 * np.log10(max(largest, 1e-30))) < 0.05:
        warnings.warn(
            f"{path}: the largest gain is 0 dB, and the mean over the sphere {10 * np.log10(mean):.3g} dB; if gains are "
            "relative to the largest one, add it to all of them",
            stacklevel=2,
        )
    if phi is not None:
        if not mean > 0:
            raise UserError(f"{path} has no field in any direction; export it again")
        theta, phi = theta / np.sqrt(mean), phi / np.sqrt(mean)
    try:
        return tabulated(theta, phi if phi is not None and np.any(phi) else None)
    except ValueError as error:
        raise UserError(f"{path} has {error}") from error

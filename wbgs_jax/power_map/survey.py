"""A survey: readings of a folder as means over small cells, with the walls of the floor plan and the measured domain."""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.floor_plan import FILES, NO_WALLS, Walls, load_walls
from wbgs_jax.data.rssi_folder import Readings, cell_means, load_readings
from wbgs_jax.inference.domain import Domain
from wbgs_jax.power_map.model import MAX_PLACES, find_ceilings, storeys_of

HEIGHT_M = 1.3
"""Height of the transmitters above the floor if the readings have no z."""
CELL_M = 0.25
"""Side of the cells over which readings are averaged."""


@dataclass(frozen=True)
class Survey:
    """Measured powers of one building."""

    cells: Readings
    """Means over cells."""
    cell_m: float
    """Side of the cells, metres."""
    walls: Walls
    """Walls of the floor plan; none without one."""

    @property
    def measured(self) -> Float[np.ndarray, "m 3"]:
        """The positions of the cells in which something was received, metres."""
        return self.cells.places[np.isfinite(self.cells.powers).any(1)]

    @property
    def domain(self) -> Domain:
        """The measured domain: the box around readings, receivers and walls, of which those of unmeasured wings extend it by at
        most 10 m."""
        points = np.concatenate([self.measured, self.cells.receivers])
        low, high = points.min(0), points.max(0)
        ends = np.asarray(self.walls.ends).reshape(-1, 2)
        if len(ends):
            most = 10.0  # metres by which walls extend the box
            low[:2] = np.clip(ends.min(0), low[:2] - most, low[:2])
            high[:2] = np.clip(ends.max(0), high[:2], high[:2] + most)
        # Distance (metres) from readings, receivers and walls up to which predictions have an interval: it includes the next
        # room, not the next building
        beyond_m = 2.0
        return Domain("the readings", np.stack([low, high]), (0.0, np.inf), beyond_m)


def load_survey(folder: Path, height_m: float = HEIGHT_M, cell_m: float = CELL_M, floor_plan: Path | None = None) -> Survey:
    """Returns the survey of a folder with readings.csv, receivers.csv and, optionally, a floor plan.

    Args:
        folder: the folder.
        height_m: height of the transmitters above the floor if the readings have no z.
        cell_m: side of the cells. It is doubled until their number is within the limit of a map (`MAX_PLACES`), but in height
            not beyond one metre, so that storeys are not averaged.
        floor_plan: the file of the walls; by default the one in the folder.

    Raises:
        UserError: a file is missing or cannot be read, there are too many rooms or heights, or the floor plan is of another
            place or unit.
    """
    readings = load_readings(folder, height_m)
    largest_m = 1e5  # side of cells that hold everything but other rooms and other signs of coordinates
    if (fewest := len(cell_means(readings, largest_m).places)) > MAX_PLACES:
        raise UserError(
            f"{folder}: readings of {len(set(readings.rooms))} rooms give at least {fewest} cells, but a map has at most "
            f"{MAX_PLACES}; name the room, not the reading, in the columns of rooms and floors, or leave them out"
        )
    storey_m = 1.0  # maximum height of enlarged cells: higher ones average storeys, metres
    if (fewest := len(cell_means(readings, largest_m, storey_m).places)) > MAX_PLACES:
        raise UserError(
            f"{folder}: heights z give at least {fewest} cells of {storey_m:g} m, but a map has at most {MAX_PLACES}; divide "
            "the readings by storey or by part of the building"
        )
    cells = cell_means(readings, cell_m)
    _note_spacing(folder, cells.places, cell_m)
    while len(cells.places) > MAX_PLACES:
        cell_m *= 2
        cells = cell_means(readings, cell_m, storey_m)
    walls = find_walls(folder, floor_plan)
    _check_plan(f"floor plan of {folder}" if floor_plan is None else f"floor plan {floor_plan}", walls, cells)
    _note_storeys(folder, cells)
    return Survey(cells, cell_m, walls)


def _note_spacing(folder: Path, places: Float[np.ndarray, "n 3"], cell_m: float) -> None:
    """Warns of places so far from each other that they are probably not in metres."""
    far = max(20.0, 50 * cell_m)  # metres: median distance of neighbouring places that is noted
    apart = float(np.median(cKDTree(places).query(places, 2)[0][:, 1]))
    if far < apart < np.inf:
        warnings.warn(
            f"{folder}: neighbouring places are {apart:.3g} m apart: are these metres? Otherwise convert the positions of "
            "readings, receivers and walls",
            stacklevel=3,
        )


def _note_storeys(folder: Path, cells: Readings) -> None:
    """Notes the ceilings that a map takes to lie between the readings, and receivers above or below all readings."""
    heights, ceilings = cells.places[:, 2], find_ceilings(cells.places[:, 2])
    if len(ceilings):
        listed = ", ".join(f"{height:.3g}" for height in ceilings)
        warnings.warn(
            f"{folder}: readings lie on {len(ceilings) + 1} storeys; ceilings at z = {listed} m attenuate in the map",
            stacklevel=3,
        )
    of_storey = storeys_of(cells.places, ceilings)
    high = max(float(np.ptp(heights[of_storey == one])) for one in np.unique(of_storey))
    one_storey_m = 2.5  # largest difference of heights of readings, or of readings and a receiver, within one storey, metres
    if high > one_storey_m:
        warnings.warn(
            f"{folder}: heights z of readings range over {high:.2g} m without a gap, and no ceiling attenuates among them; "
            "leave out readings between storeys",
            stacklevel=3,
        )
    away = np.maximum(cells.receivers[:, 2] - heights.max(), heights.min() - cells.receivers[:, 2])
    if away.max() > one_storey_m:
        warnings.warn(
            f"{folder}: receiver {away.argmax() + 1} is {away.max():.2g} m above or below all readings; the loss of a ceiling "
            "in between is not known, and corrected only near the readings",
            stacklevel=3,
        )


def _check_plan(what: str, walls: Walls, cells: Readings) -> None:
    """Raises a `UserError` if a floor plan neither surrounds the readings nor lies among them, as one in centimetres or in
    another frame."""
    if not len(walls.ends):
        return
    ends, places = np.asarray(walls.ends, float).reshape(-1, 2), cells.places[:, :2]
    points = np.concatenate([places, cells.receivers[:, :2]])
    margin, largest_ratio = 2.0, 5.0  # metres around a box; and largest ratio of the plan's diagonal to that of the readings
    inside = np.all((places >= ends.min(0) - margin) & (places <= ends.max(0) + margin), 1).mean()
    among = np.all((ends >= points.min(0) - margin) & (ends <= points.max(0) + margin))
    plan, site = np.ptp(ends, axis=0), np.ptp(points, axis=0)
    elsewhere = inside < 0.5 and not among
    if elsewhere or np.linalg.norm(plan) > largest_ratio * max(float(np.linalg.norm(site)), margin):
        raise UserError(
            f"{what}: {100 * inside:.0f} % of the readings lie in its {plan[0]:.3g} x {plan[1]:.3g} m, and readings and "
            f"receivers span {site[0]:.3g} x {site[1]:.3g} m; give the plan in metres, in their frame, without distant parts"
        )


def find_walls(folder: Path | None, floor_plan: Path | None) -> Walls:
    """Returns the walls of a floor plan, otherwise those of the folder; none if there is no floor plan.

    Raises:
        UserError: the floor plan does not exist or cannot be read.
    """
    named = [floor_plan] if floor_plan else [folder / name for name in FILES if folder]
    path = next((path for path in named if path.exists()), None)
    if path is None and floor_plan:
        raise UserError(f"floor plan {floor_plan} does not exist")
    return NO_WALLS if path is None else load_walls(path)

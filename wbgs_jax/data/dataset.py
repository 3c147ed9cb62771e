"""The dataset, the common form of all data for training, evaluation and experiments: links, observations, receivers, surfaces,
split.

A run stores a checksum of its dataset, so that it cannot be continued with other data of the same name.

Splits divide links into training, validation (choice of settings) and test. The links of one transmitter are never divided,
since those at other receivers and frequencies would reveal the held-out ones.
"""

import dataclasses
import hashlib
import itertools
import warnings
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.conventions import ConventionName
from wbgs_jax.observation_kinds import KINDS, HostObservations, Kind, Observed, only_kind
from wbgs_jax.radio.array import PAS_SHAPE
from wbgs_jax.types import Links, Query, Receiver, make_query

AT_ONCE = 1024
"""Number of spectra computed from snapshots at a time."""


@dataclass(frozen=True)
class Materials:
    """Assignment of triangles to materials. Their electrical properties are not included: a field has to learn them."""

    material: Int[np.ndarray, " faces"]
    """int32: index of the material of every triangle."""
    names: tuple[str, ...]
    """Label of every material."""
    thickness: Float[np.ndarray, " materials"]
    """Metres; 0 if unknown."""


@dataclass(frozen=True)
class Dataset(Observed):
    """Observations of the links of one scene: observation i belongs to link (transmitter position, receiver, frequency) i."""

    name: str
    receivers: Receiver
    """All receivers: every array has a leading axis R."""
    tx_positions: Float[np.ndarray, "n 3"]
    """World frame, metres, float64."""
    frequencies_hz: Float[np.ndarray, " n"]
    receiver_index: Int[np.ndarray, " n"]
    """Index of the receiver."""
    tx_index: Int[np.ndarray, " n"]
    """Index of the transmitter, shared by links with the same TX position; 0, 1, ... without gaps. Splits never divide these
    links."""
    train: Int[np.ndarray, " n_train"]
    """Indices of the training links."""
    validation: Int[np.ndarray, " n_validation"]
    """Indices of the links used to choose between settings; may be empty."""
    test: Int[np.ndarray, " n_test"]
    observations: HostObservations
    """Observations of exactly one kind, such as `{"snapshots": ...}`, `{"pas": ...}` or `{"power_db": ...}`."""
    vertices: Float[np.ndarray, "vertices 3"] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    """The scene's surfaces in the world frame, metres, float32; empty without a mesh."""
    faces: Int[np.ndarray, "faces 3"] = field(default_factory=lambda: np.zeros((0, 3), np.int32))
    """int32 triangles; empty if only points are available."""
    face_part: Int[np.ndarray, " faces"] | None = None
    """int32: the part (scene object) of every triangle; None if unknown."""
    materials: Materials | None = None
    """Materials of the triangles; None if unknown. Parts of one material share it."""
    convention: ConventionName | None = None
    """Convention by which the images of a folder were read; None for scene files, which have only one."""

    def __post_init__(self) -> None:
        only_kind(self.observations, self.name)
        if unknown := self.observations.keys() - KINDS.keys():
            raise ValueError(f"{self.name}: unknown kind of observation {min(unknown)!r}; register it in observation_kinds")
        columns = (self.tx_positions, self.receiver_index, self.tx_index, *self.observations.values())
        if any(len(column) != len(self) for column in columns):
            raise ValueError(f"{self.name}: arrays of links have lengths {[*map(len, columns)]}; all must be {len(self)}")
        if len(self) and not 0 <= self.receiver_index.min() <= self.receiver_index.max() < self.n_receivers:
            raise ValueError(f"{self.name}: receiver_index must lie between 0 and {self.n_receivers - 1}")

    def __len__(self) -> int:
        return len(self.frequencies_hz)

    @property
    def observed(self) -> Kind:
        """Kind of the observations."""
        return only_kind(self.observations, self.name)

    @property
    def n_receivers(self) -> int:
        """Number of receivers."""
        return len(self.receivers.position)

    def receiver(self, i: int = 0) -> Receiver:
        """Returns one of the receivers, without the leading axis.

        Args:
            i: index of the receiver, 0 for the first.

        Returns:
            Position (metres, world frame), orientation, element positions and antenna of its array.

        Raises:
            UserError: there is no such receiver.
        """
        if not 0 <= i < self.n_receivers:
            raise UserError(f"{self.name} has no receiver {i}; choose 0 to {self.n_receivers - 1}")
        return jax.tree.map(lambda leaf: leaf[i], self.receivers)

    def query(self, index: Int[np.ndarray, " b"]) -> Query:
        """Returns the queries of links.

        Args:
            index: of links, such as `train`, `validation` or `test`; a part of them, such as `test[:6]`, is an index too.

        Returns:
            Transmitter positions (b, 3), metres in the world frame, and frequencies (b,), hertz; float32.
        """
        return make_query(self.tx_positions[index], self.frequencies_hz[index])

    def links(self, index: Int[np.ndarray, " b"]) -> Links:
        """Returns links as float32 and int32 arrays on the device."""
        receiver, tx = (jnp.asarray(which[index], jnp.int32) for which in (self.receiver_index, self.tx_index))
        return self.query(index).with_indices(receiver, tx)

    def pas(self, index: Int[np.ndarray, " b"]) -> Float[Array, "b 90 360"]:
        """Returns the observed power angular spectra of links; of snapshots they are computed.

        Args:
            index: of links, such as `train`, `validation` or `test`.

        Returns:
            Normalised amplitudes (b, 90, 360), float32, with a maximum of 1: rows are zenith angles 0 to 90 degrees, columns
            azimuths -180 to 180 degrees in the receiver's frame. 1,000 spectra take 130 MB.

        Raises:
            UserError: the observations have no spectrum, such as received powers.
        """
        kind = self.observed
        if kind.to_spectra is None:
            raise UserError(
                f"{self.name} contains {kind.words}, which have no angular spectrum; give a scene with spectra or snapshots"
            )
        values = self.observations[kind.name][index]
        if not kind.needs_array:
            return kind.to_spectra(values, None, None)
        arrays, which = self._arrays(index)
        if len(arrays) == 1:
            return kind.to_spectra(values, arrays[0], None)
        spectra = np.zeros((len(values), *PAS_SHAPE), np.float32)
        for number, element_positions in enumerate(arrays):
            chosen = which == number
            spectra[chosen] = kind.to_spectra(values[chosen], element_positions, None)
        return jnp.asarray(spectra)

    def eight_bit(self, index: Int[np.ndarray, " b"]) -> UInt8[np.ndarray, "b 90 360"]:
        """Returns the observed spectra of links as bytes, as in published data; raises the same errors as `pas`."""
        if self.has("pas"):
            return self.observations["pas"][index]
        blocks = [index[start : start + AT_ONCE] for start in range(0, len(index), AT_ONCE)]
        made = [np.asarray(255 * self.pas(block)).round().astype(np.uint8) for block in blocks]
        return np.concatenate(made) if made else np.zeros((0, *PAS_SHAPE), np.uint8)

    def rx_positions(self, index: Int[np.ndarray, " b"]) -> Float[np.ndarray, "b 3"]:
        """Returns the positions of the receivers of links (float64, world frame, metres)."""
        return np.asarray(self.receivers.position, np.float64)[self.receiver_index[index]]

    def received_db(self, index: Int[np.ndarray, " b"]) -> Float[np.ndarray, " b"] | None:
        """Returns the received power of links, observed or computed from snapshots.

        Args:
            index: of links, such as `train`, `validation` or `test`.

        Returns:
            Decibels relative to the transmitted power (b,), or None for spectra, which have no scale.
        """
        kind = self.observed
        return None if kind.to_power is None else np.asarray(kind.to_power(self.observations[kind.name][index]))

    def _arrays(self, index: Int[np.ndarray, " b"]) -> tuple[Float[Array, "arrays elements 3"], Int[np.ndarray, " b"]]:
        """Returns the distinct arrays of links (element positions in wavelengths) and the index of each link's array."""
        own = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[self.receiver_index[index]]), self.receivers)
        positions = own.element_wavelengths(jnp.asarray(self.frequencies_hz[index], jnp.float32))
        _, first, which = np.unique(np.asarray(positions), axis=0, return_index=True, return_inverse=True)
        return positions[first], which.reshape(-1)


def checksum(dataset: Dataset) -> str:
    """Returns a checksum (SHA-256) of all numbers of a dataset, including its split but not names."""
    found = hashlib.sha256()
    numbers = (field.name for field in dataclasses.fields(dataset) if field.name not in ("name", "convention"))
    parts = {name: getattr(dataset, name) for name in numbers}
    # Kinds of observation with another name in checksums, so that those of old run folders remain valid.
    renamed = {"pas": "images"}
    parts |= {renamed.get(name, name): values for name, values in parts.pop("observations").items()}
    parts["materials"] = None if dataset.materials is None else dataclasses.asdict(dataset.materials) | {"names": ()}
    for path, leaf in jax.tree_util.tree_leaves_with_path(parts):
        array = np.ascontiguousarray(leaf)
        found.update(f"{jax.tree_util.keystr(path)} {array.dtype.str} {array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()


def check_checksum(actual: str, expected: str, where: str) -> None:
    """Checks that the data of a run are those it was trained on.

    Raises:
        UserError: the checksums differ.
    """
    if actual != expected:
        raise UserError(f"the data of {where} have changed since it was trained; restore them, or train again")


def check_data(dataset: Dataset, expected: str, where: str) -> Dataset:
    """Returns the dataset, its checksum compared with the expected one (unless that is empty).

    Raises:
        UserError: the checksum differs.
    """
    if expected:
        check_checksum(checksum(dataset), expected, where)
    return dataset


VALIDATION = 0.1
"""Fraction of the training transmitters used for validation, unless the data specify a validation part."""
FEWEST = 4
"""Minimum number of training transmitters of which some are held out for validation."""


def group_transmitters(positions: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Returns the index of the transmitter (0, 1, ... by first appearance) of every link; equal positions agree to a
    micrometre."""
    _, first, group = np.unique(np.round(positions, 6), axis=0, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[group.reshape(-1)]


def group_places(positions: Float[np.ndarray, "n 3"], tx_index: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Returns the place of every link: the lowest index of the transmitters there. A place that was measured again, up to a
    centimetre or two, is one place; links of such repeats are no independent samples, and would reveal each other if a split
    divided them.

    Places have to be well apart: those of dense tracks and grids are different places. Neither are transmitters joined if only
    a few happen to lie that close.
    """
    transmitters, first = np.unique(tx_index, return_index=True)
    points = positions[first]
    apart_m, most_m, often = 5e-2, 2e-2, 0.1  # least distance between places, extent of a place, and fraction of repeats
    pairs = cKDTree(points).query_pairs(apart_m, output_type="ndarray")
    if len(np.unique(pairs)) <= often * len(points):
        return tx_index
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    count, group = connected_components(links, directed=False)
    lowest, low, high = np.full(count, len(points)), np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(lowest, group, np.arange(len(points)))
    np.minimum.at(low, group, points)
    np.maximum.at(high, group, points)
    small = (high - low).max(1) <= most_m
    repeated = small[group] & (np.bincount(group)[group] > 1)
    joined = np.where(small[group], lowest[group], np.arange(len(points)))
    if repeated.mean() <= often or len(np.unique(joined)) < FEWEST:
        return tx_index
    places: Int[np.ndarray, " n"] = transmitters[joined][np.searchsorted(transmitters, tx_index)]
    return places


def places_of(dataset: Dataset) -> Int[np.ndarray, " n"]:
    """Returns the place of every link of a dataset (`group_places`): the independent samples of all statistics."""
    return group_places(dataset.tx_positions, dataset.tx_index)


def note_shared_transmitters(
    name: str,
    tx_index: Int[np.ndarray, " n"],
    split: Mapping[str, Int[np.ndarray, " k"]],
    positions: Float[np.ndarray, "n 3"],
) -> None:
    """Warns of transmitters with links in two parts of a split, and of test positions (metres) almost at training positions."""
    for first, second in itertools.combinations(split, 2):
        if shared := len(np.intersect1d(tx_index[split[first]], tx_index[split[second]])):
            text = f"{name}: {shared} TX positions are both in {first} and in {second}; scores will be too high"
            warnings.warn(text, stacklevel=4)
    own, others = (np.unique(positions[split[part]], axis=0) for part in ("test", "train"))
    # Distance of a repeated position, and fraction and number of test positions that may be repeated.
    apart_m, few, fewest = 1e-2, 0.1, 4
    if len(own) > fewest and len(others):
        away, _ = cKDTree(others).query(own)
        # Positions that agree to a micrometre belong to one transmitter (the first warning).
        repeated = (away < apart_m) & (away > 1e-6)
        if repeated.sum() > fewest and repeated.mean() > few:
            text = f"{name}: {100 * repeated.mean():.0f} % of the test's TX positions lie within 1 cm of one in train"
            warnings.warn(f"{text}; scores will be too high: give all of them the same position", stacklevel=4)


def tx_disjoint_split(
    tx_index: Int[np.ndarray, " n"], test_fraction: float = 0.2, seed: int = 0
) -> tuple[Int[np.ndarray, " n_train"], Int[np.ndarray, " n_test"]]:
    """Returns ascending indices of training and test links, with `test_fraction` of the transmitters (drawn with `seed`) in the
    test.

    Raises:
        UserError: the fraction is not between 0 and 1, or there are fewer than two transmitters.
    """
    if len(np.unique(tx_index)) < 2:
        raise UserError("a split needs spectra of at least two TX positions; give train_index.txt and test_index.txt instead")
    in_test = _draw(tx_index, test_fraction, np.random.default_rng(seed), "test")
    return np.flatnonzero(~in_test), np.flatnonzero(in_test)


def hold_out_validation(dataset: Dataset, fraction: float = VALIDATION) -> Dataset:
    """Returns the dataset with `fraction` of its training transmitters moved to the validation part. If these are fewer than
    eight, eight are moved, but no more than about a quarter, since fewer would decide nothing. Of fewer than `FEWEST` none is
    moved unless `fraction` is at least one of them: calibration needs them all, and a single one decides nothing. Transmitters
    at one place (`group_places`) count as one.

    The choice depends only on the split, not on a run's seed or on what is trained. Data with a validation part of their own
    are unchanged.

    Raises:
        UserError: the fraction is not between 0 and 1.
    """
    tx_index = group_places(dataset.tx_positions[dataset.train], dataset.tx_index[dataset.train])
    transmitters = np.unique(tx_index)
    if len(dataset.validation) or len(transmitters) < 2:
        return dataset
    few, largest_share = 8, 0.25  # desired minimum number of validation transmitters, and maximum fraction used to reach it
    if 0 < fraction < 1:  # other values are rejected below
        if len(transmitters) >= FEWEST:
            fraction = max(fraction, min(few / len(transmitters), largest_share))
        elif fraction * len(transmitters) < 1:
            return dataset
    seed = zlib.crc32(transmitters.astype("<i8").tobytes())
    moved = _draw(tx_index, fraction, np.random.default_rng(seed), "validation")
    return dataclasses.replace(dataset, train=dataset.train[~moved], validation=dataset.train[moved])


def select_frequencies(
    dataset: Dataset, train_ghz: Sequence[float] | None = None, test_ghz: Sequence[float] | None = None
) -> Dataset:
    """Returns the same links with training, validation and test restricted to some frequencies (GHz); None keeps all of them.

    Validation has the training frequencies, since settings must not be chosen by the frequencies to be predicted.

    Raises:
        UserError: a frequency does not occur in the dataset, or a selection leaves no links.
    """
    train = _keep(dataset, dataset.train, train_ghz, "training")
    validation = _keep(dataset, dataset.validation, train_ghz, "validation") if len(dataset.validation) else dataset.validation
    test = _keep(dataset, dataset.test, test_ghz, "test")
    return dataclasses.replace(dataset, train=train, validation=validation, test=test)


def unseen_frequencies(dataset: Dataset, train_ghz: Sequence[float]) -> Dataset:
    """Returns a dataset that trains only at some frequencies (GHz) and tests at all others, at held-out transmitters; its name
    records this."""
    available = np.unique(dataset.frequencies_hz) / 1e9
    others = [float(f) for f in available if not np.isclose(f, train_ghz, rtol=1e-6, atol=0).any()]
    name = f"{dataset.name}_f" + "-".join(f"{f:g}" for f in train_ghz)
    return dataclasses.replace(select_frequencies(dataset, train_ghz, others), name=name)


def fewer_transmitters(dataset: Dataset, count: int, seed: int) -> Dataset:
    """Returns a dataset with `count` of the training transmitters; larger counts include the smaller ones. Its name records
    this.

    Raises:
        UserError: there are fewer transmitters.
    """
    transmitters = np.unique(dataset.tx_index[dataset.train])
    if not 0 < count <= len(transmitters):
        raise UserError(
            f"{dataset.name} has {len(transmitters)} training transmitters, not {count}; choose 1 to {len(transmitters)}"
        )
    chosen = np.random.default_rng([seed, 4]).permutation(transmitters)[:count]
    train = dataset.train[np.isin(dataset.tx_index[dataset.train], chosen)]
    return dataclasses.replace(dataset, train=train, name=f"{dataset.name}_tx{count}")


def hold_out_box(dataset: Dataset, low: Sequence[float | int], high: Sequence[float | int]) -> Dataset:
    """Returns a dataset that tests at all transmitters in a box (corners in metres), such as a room, and trains at none of
    them. Test transmitters elsewhere are omitted. Its name records this.

    Raises:
        UserError: the box is empty, or nothing remains for training or test.
    """
    lowest, highest = np.asarray(low, float), np.asarray(high, float)
    if not (lowest < highest).all():
        raise UserError(f"the box from {list(low)} to {list(high)} is empty; give its lowest corner first, then its highest")
    inside = np.all((dataset.tx_positions >= lowest) & (dataset.tx_positions <= highest), axis=1)
    train, validation = (part[~np.take(inside, part)] for part in (dataset.train, dataset.validation))
    if not inside.any() or not len(train):
        where = "no" if not inside.any() else "every training"
        raise UserError(
            f"{where} transmitter of {dataset.name} lies in the box from {list(low)} to {list(high)}; choose another"
        )
    name = f"{dataset.name}_box" + "_".join(f"{x:g}" for x in (*low, *high))
    return dataclasses.replace(dataset, train=train, validation=validation, test=np.flatnonzero(inside), name=name)


def select_receivers(dataset: Dataset, which: Sequence[int]) -> Dataset:
    """Returns a dataset of the links of some receivers, which are renumbered 0, 1, ... in the given order. Its name records
    this.

    Transmitters without any such link are removed, and the others renumbered.

    Raises:
        UserError: there is no such receiver, one is named twice, or none is named.
    """
    if not which or len(set(which)) < len(which) or not all(0 <= i < dataset.n_receivers for i in which):
        raise UserError(f"{dataset.name} has receivers 0 to {dataset.n_receivers - 1}; choose each once, not {list(which)}")
    number = np.full(dataset.n_receivers, -1)
    number[list(which)] = np.arange(len(which))
    chosen = keep_links(dataset, np.flatnonzero(number[dataset.receiver_index] >= 0))
    return dataclasses.replace(
        chosen,
        name=f"{dataset.name}_rx" + "-".join(map(str, which)),
        receivers=jax.tree.map(lambda leaf: leaf[np.array(which)], dataset.receivers),
        receiver_index=number[chosen.receiver_index],
    )


def training_links(dataset: Dataset) -> Int[np.ndarray, " n"]:
    """Returns the indices of all links that training may use, including validation, ascending."""
    return np.sort(np.concatenate([dataset.train, dataset.validation]))


def with_validation_trained(dataset: Dataset) -> Dataset:
    """Returns the dataset with its validation part used for training as well, for methods that choose nothing by validation."""
    return dataclasses.replace(dataset, train=training_links(dataset), validation=dataset.validation[:0])


def without_test(dataset: Dataset) -> Dataset:
    """Returns the dataset with only its `training_links`."""
    return keep_links(dataset, training_links(dataset))


def keep_links(dataset: Dataset, kept: Int[np.ndarray, " n"]) -> Dataset:
    """Returns a dataset of some links in order; the remaining transmitters are renumbered."""
    place = np.full(len(dataset), -1)  # new index of every link that is kept
    place[kept] = np.arange(len(kept))

    def remaining(index: np.ndarray) -> np.ndarray:
        return place[index][place[index] >= 0]

    return dataclasses.replace(
        dataset,
        tx_positions=dataset.tx_positions[kept],
        frequencies_hz=dataset.frequencies_hz[kept],
        receiver_index=dataset.receiver_index[kept],
        tx_index=np.unique(dataset.tx_index[kept], return_inverse=True)[1],
        train=remaining(dataset.train),
        validation=remaining(dataset.validation),
        test=remaining(dataset.test),
        observations={name: values[kept] for name, values in dataset.observations.items()},
    )


def _draw(tx_index: Int[np.ndarray, " n"], fraction: float, rng: np.random.Generator, role: str) -> Bool[np.ndarray, " n"]:
    """Returns which links belong to a random part of the transmitters: at least one of them, and never all."""
    if not 0 < fraction < 1:
        raise UserError(f"the {role} fraction is {fraction}; choose a number between 0 and 1, 0.2 for example")
    transmitters = np.unique(tx_index)
    count = int(np.clip(round(fraction * len(transmitters)), 1, len(transmitters) - 1))
    return np.isin(tx_index, rng.permutation(transmitters)[:count])


def _keep(dataset: Dataset, index: np.ndarray, wanted_ghz: Sequence[float] | None, role: str) -> np.ndarray:
    if wanted_ghz is None:
        return index
    available_ghz = np.unique(dataset.frequencies_hz) / 1e9
    for frequency in wanted_ghz:
        if not np.isclose(available_ghz, frequency, rtol=1e-6, atol=0).any():
            have = ", ".join(f"{f:g}" for f in available_ghz)
            raise UserError(f"{dataset.name} has no spectra at {frequency:g} GHz; choose {role} frequencies among {have} GHz")
    ghz = dataset.frequencies_hz[index] / 1e9
    kept = index[np.isclose(ghz[:, None], np.asarray(wanted_ghz, np.float64).reshape(1, -1), rtol=1e-6, atol=0).any(1)]
    if len(kept) == 0:
        raise UserError(f"the chosen {role} frequencies leave no {role} spectrum of {dataset.name}; choose others")
    return kept

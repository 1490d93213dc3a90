"""The unknowns of a fit, each declared once and found by its key; a state of them, and what it leaves.

Every unknown declares its numbers' names, how far each may be off at all, and what is known of it beforehand.
What each unknown's step does to a state, and how residuals depend on it, is `calib.adjust.adjustment`'s.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import JOINTS_NAMES, MAST_NAMES, JointErrors, Mast, joints_of, mast_of
from calib.geometry.rigid import FloatArray, Rigid

Key = tuple[Hashable, ...]
"""An unknown's kind and which one of it: ``("camera", "navcam_left")``, ``("board", ("level", "p1"))``."""
MAST: Key = ("mast",)
JOINT_ERRORS: Key = ("joints",)


@dataclass(frozen=True, eq=False)
class Unknown:
    """One thing that a fit moves, its numbers named as a calibration names them (k,).

    Attributes
    ----------
    step
        (k,) how far each may be off at all: one that the data leave open stays where it is.
    prior, sigma
        (k,) what is known of the numbers beforehand, and how well; None where nothing is.
    kind
        Of the measurement that gives the prior (``calib.adjust.terms``); None for a usual value.
    usual
        (k,) which numbers are held by what lenses are usually like, however little the data show of them.
    """

    key: Key
    names: tuple[str, ...]
    step: FloatArray
    prior: FloatArray | None = None
    sigma: FloatArray | None = None
    kind: str | None = None
    usual: np.ndarray | None = None

    @cached_property
    def rates(self) -> FloatArray:
        """(k, k) how residuals against the prior, in its sigmas, change with the numbers."""
        assert self.sigma is not None
        return np.diag(1.0 / self.sigma)


class Unknowns(Mapping[Key, Unknown]):
    """The unknowns of a fit by key, and where the numbers of each stand among all of them."""

    def __init__(self, declared: Iterable[Unknown]) -> None:
        self._by_key = {unknown.key: unknown for unknown in declared}
        self.names = tuple(name for unknown in self.values() for name in unknown.names)
        ends = np.cumsum([len(unknown.names) for unknown in self.values()], dtype=int).tolist()
        self._parts = {
            key: slice(end - len(one.names), end) for (key, one), end in zip(self.items(), ends, strict=True)
        }
        self._places = {key: np.arange(part.start, part.stop) for key, part in self._parts.items()}

    def __getitem__(self, key: Key) -> Unknown:
        return self._by_key[key]

    def __iter__(self) -> Iterator[Key]:
        return iter(self._by_key)

    def __len__(self) -> int:
        return len(self._by_key)

    @cached_property
    def weak(self) -> FloatArray:
        """(p,) one over the square of each number's ``step``; see ``calib.adjust.solver.minimise``."""
        steps = [unknown.step for unknown in self.values()]
        return np.concatenate([np.zeros(0), *steps]) ** -2.0

    @cached_property
    def usual(self) -> np.ndarray:
        """(p,) which numbers are ``usual``."""
        every = [
            np.zeros(len(one.names), dtype=bool) if one.usual is None else one.usual for one in self.values()
        ]
        return np.concatenate([np.zeros(0, dtype=bool), *every])

    def owner(self, name: str) -> Key:
        """Return the key of the unknown that has a number of this name."""
        return next(key for key, unknown in self.items() if name in unknown.names)

    def part(self, key: Key) -> slice:
        """Return where an unknown's numbers stand."""
        return self._parts[key]

    def at(self, key: Key) -> np.ndarray:
        """Return the indices of an unknown's numbers."""
        return self._places[key]

    def of_kinds(self, *kinds: str) -> np.ndarray:
        """Return the indices of all unknowns of some kinds, the kinds in this order."""
        found = [self.at(key) for kind in kinds for key in self if key[0] == kind]
        return np.concatenate([np.zeros(0, dtype=int), *found])

    def with_sigmas(self, factors: Mapping[str, float]) -> Unknowns:
        """Return the same with priors' sigmas times ``factors``, by the kind of their measurement."""
        return Unknowns(
            unknown
            if unknown.sigma is None or unknown.kind is None
            else replace(unknown, sigma=unknown.sigma * factors.get(unknown.kind, 1.0))
            for unknown in self.values()
        )


class Known(NamedTuple):
    """What residuals against a prior belong to: the unknown, and the kind of measurement that it is."""

    key: Key
    kind: str | None


@dataclass(frozen=True, eq=False)
class Estimate:
    """A state of the fit. ``mast`` holds the eight numbers of ``MAST_NAMES``, ``joints_rad`` (k, 2) what is
    added to the readings of each head attitude, ``joint_errors`` (10,) the numbers of
    ``calib.geometry.rig.JOINTS_NAMES``, ``bows_m`` by board (2,) how far the middles of its sides, right and
    left, top and bottom, lie behind its centre, metres."""

    cameras: Mapping[str, CameraModel] = field(default_factory=dict)
    mast: FloatArray = field(default_factory=lambda: np.zeros(len(MAST_NAMES)))
    rover_from_station: Mapping[str, Rigid] = field(default_factory=dict)
    rover_from_board: Mapping[tuple[str, str], Rigid] = field(default_factory=dict)
    prisms_in_rover_m: Mapping[str, FloatArray] = field(default_factory=dict)
    joints_rad: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    joint_errors: FloatArray = field(default_factory=lambda: np.zeros(len(JOINTS_NAMES)))
    bows_m: Mapping[str, FloatArray] = field(default_factory=dict)

    @property
    def as_mast(self) -> Mast:
        """The mast of ``calib.geometry.rig``."""
        return mast_of(self.mast)

    @cached_property
    def as_joints(self) -> JointErrors:
        """The joints of ``calib.geometry.rig``; ValueError if their errors are too large to be any."""
        return joints_of(self.joint_errors)


@dataclass(frozen=True, eq=False)
class ResidualBlock:
    """Residuals (m,) of one group, in sigmas and unweighted, and their Jacobian (m, k) on unknowns (k,).

    ``width`` of them belong together (2: a dot, 3: a point of the station, 1: a single number); ``parts``
    says which columns of the Jacobian are whose.
    """

    residual: FloatArray
    jacobian: FloatArray
    columns: np.ndarray
    width: int
    parts: Mapping[Key, slice] = field(default_factory=dict)

    def rates(self, key: Key) -> FloatArray:
        """Return how the residuals change with one unknown, (m, k)."""
        return self.jacobian[:, self.parts[key]]

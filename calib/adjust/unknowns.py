"""The unknowns of a fit, each declared once and found by its key; a state of them, and what it leaves.

What each unknown's step does to a state, and how residuals depend on it, is `calib.adjust.adjustment`'s.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

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

    ``step`` (k,) is how far each may be off at all: one that the data leave open stays where it is. ``prior``
    (k,) is what is known of the numbers beforehand: by measurements of a ``kind`` (``calib.adjust.terms``),
    or as usual values to so much (``sigma``).
    """

    key: Key
    names: tuple[str, ...]
    step: FloatArray
    prior: FloatArray | None = None
    sigma: float = 0.0
    kind: str | None = None


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

    ``parts`` says which columns of the Jacobian are whose.
    """

    residual: FloatArray
    jacobian: FloatArray
    columns: np.ndarray
    parts: Mapping[Key, slice] = field(default_factory=dict)

    def rates(self, key: Key) -> FloatArray:
        """Return how the residuals change with one unknown, (m, k)."""
        return self.jacobian[:, self.parts[key]]

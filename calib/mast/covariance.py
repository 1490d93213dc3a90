"""The covariance that a mast file carries, and a rig moved along it.

A calibration leaves ``fit.parameters`` and ``fit.covariance`` in the mast file
(docs/how-to/survey-calibration.md). The parameters are ``mast.KEY.x``, ``joints.pan.c1``
(`calib.mast.joints`) and ``cameras.NAME.C.x``, as `calib.camera.parameters` orders a camera's step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.camera.parameters import parameter_names, stepped
from calib.errors import CalibError
from calib.mast.gimbal import MAST_NAMES, mast_of, numbers_of
from calib.mast.joints import JOINTS_NAMES, joints_of
from calib.mast.joints import numbers_of as joint_numbers_of
from calib.mast.rig import Rig
from calib.rigid import FloatArray, ReadOnlyArrays, frozen_array

ROUNDING = 1e-4
"""Of one: what a stored correlation may be off by, as where a file was written with few digits."""

_MAST = tuple(f"mast.{name}" for name in MAST_NAMES)


@dataclass(frozen=True, eq=False)
class RigCovariance(ReadOnlyArrays):
    """How sure a rig's parameters are: ``names`` (p,) and ``covariance`` (p, p), in the names' units.

    Raises
    ------
    ValueError
        If the covariance is not (p, p), finite, and without negative variances.
    """

    names: tuple[str, ...]
    covariance: FloatArray

    def __post_init__(self) -> None:
        size = len(self.names)
        object.__setattr__(self, "covariance", frozen_array(self.covariance, (size, size)))
        if (np.diag(self.covariance) < 0.0).any():
            raise ValueError("a covariance with a negative variance is none")

    def of(self, cameras: Sequence[str]) -> RigCovariance:
        """Return the part of the mast, of the joints and of some cameras."""
        wanted = tuple(f"cameras.{name}." for name in cameras)
        kept = [i for i, name in enumerate(self.names) if name.startswith(("mast.", "joints.", *wanted))]
        return RigCovariance(tuple(self.names[i] for i in kept), self.covariance[np.ix_(kept, kept)])

    def among(self, names: Sequence[str]) -> FloatArray:
        """Return the covariance (k, k) of other names in their order; what has no place here is exact."""
        at = {name: i for i, name in enumerate(self.names)}
        theirs = [i for i, name in enumerate(names) if name in at]
        mine = [at[names[i]] for i in theirs]
        covariance = np.zeros((len(names), len(names)))
        covariance[np.ix_(theirs, theirs)] = self.covariance[np.ix_(mine, mine)]
        return covariance


def stored_covariance(rig: Rig) -> RigCovariance | None:
    """Return the covariance of a rig's mast file, or None if it has none.

    Raises
    ------
    CalibError
        If ``fit.parameters`` and ``fit.covariance`` do not fit each other or the rig.
    """
    if "covariance" not in rig.fit or "parameters" not in rig.fit:
        return None
    known = {
        *_MAST,
        *JOINTS_NAMES,
        *(f"cameras.{n}.{p}" for n, c in rig.cameras.items() for p in parameter_names(c.model.kind)),
    }
    names = rig.fit["parameters"]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise CalibError("fit.parameters of the mast file is not a list of names")
    if strange := [name for name in names if name not in known]:
        raise CalibError(f"fit.parameters of the mast file names {strange[0]!r}, which the rig does not have")
    try:
        covariance = np.array(rig.fit["covariance"], dtype=np.float64)
    except (TypeError, ValueError):
        covariance = np.empty(0)
    square = covariance.shape == (len(names), len(names))
    if not square or not np.isfinite(covariance).all() or (np.diag(covariance) < 0).any():
        raise CalibError(
            f"fit.covariance of the mast file is not {len(names)} rows of {len(names)} numbers with a "
            "positive diagonal, as its fit.parameters ask"
        )
    if _impossible(covariance):
        raise CalibError(
            "fit.covariance of the mast file is none: it is not symmetric, or some direction has a negative "
            "variance"
        )
    return RigCovariance(tuple(names), covariance)


def _impossible(covariance: FloatArray) -> bool:
    """Whether a matrix with a positive diagonal is no covariance, beyond what rounding does."""
    scale = np.sqrt(np.diag(covariance))
    scaled = covariance / np.outer(*2 * [np.where(scale > 0.0, scale, 1.0)])
    if np.abs(scaled - scaled.T).max(initial=0.0) > ROUNDING:
        return True
    return bool(np.linalg.eigvalsh(scaled).min(initial=0.0) < -ROUNDING)


def moved_rig(rig: Rig, names: Sequence[str], step: FloatArray) -> Rig:
    """Return the rig with the named parameters moved by ``step`` (p,), in the names' units."""
    at = dict(zip(names, step.tolist(), strict=True))
    numbers = numbers_of(rig.mast) + np.array([at.get(name, 0.0) for name in _MAST])
    joints = rig.joints
    if any(at.get(name, 0.0) for name in JOINTS_NAMES):
        joints = joints_of(joint_numbers_of(joints) + np.array([at.get(name, 0.0) for name in JOINTS_NAMES]))
    cameras = dict(rig.cameras)
    for name, camera in rig.cameras.items():
        mine = [f"cameras.{name}.{part}" for part in parameter_names(camera.model.kind)]
        if any(at.get(part, 0.0) for part in mine):
            model = stepped(camera.model, np.array([at.get(part, 0.0) for part in mine]))
            cameras[name] = replace(camera, model=model)
    return replace(rig, mast=mast_of(numbers), joints=joints, cameras=cameras)

"""Pan/tilt mast kinematics and the rig: a mast with its cameras.

rover_from_head(pan, tilt) = Trans(t) Rot(x,θx) Rot(y,θy) Rot(z,θz) · Rot(z,pan) · Trans(a,0,0) Rot(x,k) ·
Rot(y,tilt) (paper eqs. (6)-(8); a and k make it any two revolute axes). Positive pan turns right, positive
tilt looks up. Angles are true ones, not what an encoder reads (`calib.mast.joints`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from calib.camera.cahvor import CameraModel
from calib.mast.joints import Joints
from calib.rigid import FloatArray, ReadOnlyArrays, Rigid, finite_float, frozen_array, rot_x, rot_y, rot_z


@dataclass(frozen=True, eq=False)
class Mast(ReadOnlyArrays):
    """Mast parameters: six of the paper, and axis offset a and twist k (0 in the paper's mast).

    Attributes
    ----------
    translation_m
        (3,) origin of the mast frame in the rover frame, metres.
    rotation_rad
        (3,) θx, θy, θz of the mast frame in the rover frame, radians.
    axis_offset_m, axis_twist_rad
        Length and twist of the common perpendicular from the pan axis to the tilt axis.

    Raises
    ------
    ValueError
        If a number is not finite.
    """

    translation_m: FloatArray
    rotation_rad: FloatArray
    axis_offset_m: float = 0.0
    axis_twist_rad: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "translation_m", frozen_array(self.translation_m, (3,)))
        object.__setattr__(self, "rotation_rad", frozen_array(self.rotation_rad, (3,)))
        for name in ("axis_offset_m", "axis_twist_rad"):
            object.__setattr__(self, name, finite_float(name, getattr(self, name)))

    @cached_property
    def rover_from_mast(self) -> Rigid:
        """The fixed part: mast frame in the rover frame (paper eq. (7))."""
        x, y, z = self.rotation_rad
        return Rigid(rot_x(x) @ rot_y(y) @ rot_z(z), self.translation_m)

    def mast_from_head(self, pan_rad: float, tilt_rad: float) -> Rigid:
        """Return the moving part: head frame in the mast frame (paper eq. (8), with a and k)."""
        pan = rot_z(pan_rad)
        return Rigid(
            pan @ rot_x(self.axis_twist_rad) @ rot_y(tilt_rad),
            pan @ np.array([self.axis_offset_m, 0.0, 0.0]),
        )

    def rover_from_head(self, pan_rad: float, tilt_rad: float) -> Rigid:
        """Return the head frame in the rover frame at true joint angles, radians."""
        return self.rover_from_mast @ self.mast_from_head(pan_rad, tilt_rad)


@dataclass(frozen=True, eq=False)
class RigCamera:
    """A camera of a rig: its model in the frame of the thing it is mounted ``on``."""

    on: Literal["head", "rover"]
    model: CameraModel


@dataclass(frozen=True, eq=False)
class Rig:
    """A mast with its cameras: what a mast file holds.

    ``stereo`` maps a pair name to its (left, right) camera names. ``joints`` is what the head's readings are
    wrong by: all else here speaks of true angles. ``fit`` and ``provenance`` are carried through unread.
    """

    name: str
    mast: Mast
    cameras: Mapping[str, RigCamera]
    stereo: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    fit: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    joints: Joints = field(default_factory=Joints)

    def __post_init__(self) -> None:
        for name in ("cameras", "stereo", "fit", "provenance"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel between processes: read-only views cannot be pickled."""
        views = (self.cameras, self.stereo, self.fit, self.provenance)
        return Rig, (self.name, self.mast, *map(dict, views), self.joints)

    def camera_in_rover(self, name: str, pan_rad: float, tilt_rad: float) -> CameraModel:
        """Return camera ``name`` in the rover frame at true joint angles; body cameras ignore them.

        Raises
        ------
        KeyError
            If the rig has no such camera.
        """
        camera = self.cameras[name]
        if camera.on == "rover":
            return camera.model
        return camera.model.moved(self.mast.rover_from_head(pan_rad, tilt_rad))

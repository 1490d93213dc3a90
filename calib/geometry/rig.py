"""Pan/tilt mast kinematics and the rig: a mast with its cameras.

rover_from_head(pan, tilt) = Trans(t) Rot(x,θx) Rot(y,θy) Rot(z,θz) · Rot(z,pan) · Trans(a,0,0) Rot(x,k) ·
Rot(y,tilt) (paper eqs. (6)-(8); a and k make it any two revolute axes). Positive pan turns right, positive
tilt looks up. Angles are true ones, not what an encoder reads (`calib.geometry.rig`).

A joint's true angle is u + Σ (c_i cos(i u) + s_i sin(i u)). There u is the angle read, less half the backlash
if the axis came to rest from smaller angles, plus half of it if from larger ones. The first harmonic is an
encoder's disc or magnet off its centre (an arm's sag looks the same in tilt), the second one that is oval.
The kinematics speak of true angles, a head of read ones.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from calib.geometry.cahvor import CameraModel
from calib.geometry.mode import SensorMode
from calib.geometry.rigid import (
    FloatArray,
    ReadOnlyArrays,
    Rigid,
    crossed,
    finite_float,
    frozen_array,
    rigid_rates,
    rot_x,
    rot_y,
    rot_z,
)

MOST_HARMONICS = 2
STEEPEST = 0.25
"""Σ i |(c_i, s_i)| of an axis at most: Newton's steps from the identity then come home from any angle."""
LARGEST_BACKLASH_RAD = 0.2

AXIS_NAMES = ("c1", "s1", "c2", "s2", "backlash_rad")
JOINTS_NAMES = tuple(f"joints.{axis}.{name}" for axis in ("pan", "tilt") for name in AXIS_NAMES)
"""The ten numbers of both joints, in the order of `joint_numbers_of`."""

Pair = tuple[float, float]
Approach = tuple[float, float]
"""From which side pan and tilt came to rest: +1 from smaller read angles, -1 from larger, 0 not known."""
UNKNOWN: Approach = (0.0, 0.0)

_Angle = TypeVar("_Angle", float, FloatArray)


@dataclass(frozen=True)
class AxisJoint:
    """One joint's errors; the default reads true.

    ``harmonics_rad`` are (c_i, s_i) of the first and second harmonic over a turn; may be shorter.
    ``backlash_rad`` is the full width of the play between encoder and load. An estimate of none may be
    negative; a mast file has no such value. ValueError for more than two harmonics, numbers that are not
    finite, harmonics so large that two readings could mean one angle, or a backlash above 0.2 rad.
    """

    harmonics_rad: tuple[Pair, ...] = ()
    backlash_rad: float = 0.0

    def __post_init__(self) -> None:
        if len(self.harmonics_rad) > MOST_HARMONICS:
            count = len(self.harmonics_rad)
            raise ValueError(f"harmonics_rad has {count} pairs where {MOST_HARMONICS} at most are expected")
        clean = tuple(
            (finite_float("harmonics_rad", c), finite_float("harmonics_rad", s))
            for c, s in self.harmonics_rad
        )
        object.__setattr__(self, "harmonics_rad", clean)
        steepest = sum(i * math.hypot(c, s) for i, (c, s) in enumerate(clean, 1))
        if steepest > STEEPEST:
            raise ValueError(
                f"harmonics_rad change the angle by up to {steepest:.3g} rad in a radian where at most "
                f"{STEEPEST:g} is expected"
            )
        backlash = finite_float("backlash_rad", self.backlash_rad)
        if not abs(backlash) <= LARGEST_BACKLASH_RAD:
            raise ValueError(
                f"backlash_rad is {backlash:g} rad where at most {LARGEST_BACKLASH_RAD:g} is expected"
            )
        object.__setattr__(self, "backlash_rad", backlash)

    @property
    def reads_true(self) -> bool:
        """Whether read and true angles are the same."""
        return self.backlash_rad == 0.0 and not any(any(pair) for pair in self.harmonics_rad)

    def true_rad(self, read_rad: _Angle, approach: float | FloatArray = 0.0) -> _Angle:
        """Return the true angle of a reading, or of an array (...) of them.

        ``approach`` is +1 from smaller read angles, -1 from larger, 0 if not known: the middle; in between
        where the load lies between the flanks.
        """
        return self._true(read_rad - self._slack(approach))[0]

    def read_rad(self, true_rad: _Angle, approach: float | FloatArray = 0.0) -> _Angle:
        """Return the reading of a true angle (or of an array of them), exact to rounding."""
        at = true_rad
        for _ in range(60):  # four do for tens of milliradians
            found, slope = self._true(at)
            step = (found - true_rad) / slope
            at = at - step
            if np.max(np.abs(step), initial=0.0) <= 1e-15 * (1.0 + np.max(np.abs(at), initial=0.0)):
                break
        return at + self._slack(approach)

    def goal_rad(self, true_rad: float, read_rad: float, approach: float = 0.0, turn: int = 0) -> float:
        """Return the reading to send an axis to, which is at a reading and approach, to reach a true angle.

        ``turn`` is 1 or -1 for a head that comes to this goal from smaller or from larger angles by itself.
        """
        wanted, present = self.read_rad(true_rad), read_rad - self._slack(approach)
        turn = turn or (wanted > present) - (wanted < present)
        return wanted + 0.5 * turn * self.backlash_rad if turn else read_rad

    def slope(self, read_rad: _Angle, approach: float | FloatArray = 0.0) -> _Angle:
        """Return by how much the true angle grows with the reading, radians in a radian."""
        return self._true(read_rad - self._slack(approach))[1]

    def rates(self, read_rad: ArrayLike, approach: ArrayLike = 0) -> FloatArray:
        """Return (..., 5): how the true angle changes with the numbers `AXIS_NAMES`, the reading fixed."""
        side = np.asarray(approach, dtype=np.float64)
        at = np.asarray(read_rad, dtype=np.float64) - self._slack(side)
        slack = -0.5 * side * self._true(at)[1]
        return np.stack([np.cos(at), np.sin(at), np.cos(2.0 * at), np.sin(2.0 * at), slack], axis=-1)

    def _slack(self, approach: Any) -> float:
        """How far the reading is before the load that comes from this side; of an array an array."""
        slack: float = 0.5 * approach * self.backlash_rad
        return slack

    def _true(self, at_rad: _Angle) -> tuple[_Angle, _Angle]:
        """The true angle of a reading without play, and how it grows with it."""
        true, slope = at_rad, 1.0 + 0.0 * at_rad
        for i, (c, s) in enumerate(self.harmonics_rad, 1):
            cos, sin = _turn(i * at_rad)
            true = true + c * cos + s * sin
            slope = slope + i * (s * cos - c * sin)
        return true, slope


@dataclass(frozen=True)
class JointErrors:
    """The errors of both joints; the default reads true."""

    pan: AxisJoint = field(default_factory=AxisJoint)
    tilt: AxisJoint = field(default_factory=AxisJoint)

    @property
    def reads_true(self) -> bool:
        """Whether read and true angles are the same in both."""
        return self.pan.reads_true and self.tilt.reads_true

    def true_rad(self, read_rad: Pair, approach: Approach = UNKNOWN) -> Pair:
        """Return true (pan, tilt) of a reading."""
        return self.pan.true_rad(read_rad[0], approach[0]), self.tilt.true_rad(read_rad[1], approach[1])

    def read_rad(self, true_rad: Pair, approach: Approach = UNKNOWN) -> Pair:
        """Return what (pan, tilt) read where they truly are."""
        return self.pan.read_rad(true_rad[0], approach[0]), self.tilt.read_rad(true_rad[1], approach[1])


def joint_numbers_of(joints: JointErrors) -> FloatArray:
    """Return the ten numbers (10,) of both joints, in the order of `JOINTS_NAMES`."""
    numbers = []
    for axis in (joints.pan, joints.tilt):
        pairs = (*axis.harmonics_rad, (0.0, 0.0), (0.0, 0.0))[:MOST_HARMONICS]
        numbers += [*(part for pair in pairs for part in pair), axis.backlash_rad]
    return np.array(numbers)


def joints_of(numbers: FloatArray) -> JointErrors:
    """Return the joints of ten numbers in the order of `JOINTS_NAMES`. Raises ValueError as `AxisJoint`."""
    pan, tilt = (
        AxisJoint(_without_zeros(((c1, s1), (c2, s2))), backlash)
        for c1, s1, c2, s2, backlash in np.asarray(numbers, dtype=np.float64).reshape(2, 5).tolist()
    )
    return JointErrors(pan, tilt)


def _without_zeros(pairs: tuple[Pair, ...]) -> tuple[Pair, ...]:
    """Leave out harmonics at the end that are nothing."""
    while pairs and pairs[-1] == (0.0, 0.0):
        pairs = pairs[:-1]
    return pairs


def _turn(at_rad: _Angle) -> tuple[_Angle, _Angle]:
    """Cosine and sine; of a float as floats."""
    kind: Any = math if isinstance(at_rad, float) else np
    return kind.cos(at_rad), kind.sin(at_rad)


@dataclass(frozen=True, eq=False)
class Mast(ReadOnlyArrays):
    """Mast parameters: six of the paper, and axis offset a and twist k (0 in the paper's mast).

    The origin (3,) of the mast frame in the rover frame and θx, θy, θz (3,); then length and twist of the
    common perpendicular from the pan axis to the tilt axis. ValueError if a number is not finite.
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

    def rover_from_head(self, pan_rad: float, tilt_rad: float) -> Rigid:
        """Return the head frame in the rover frame at true joint angles, radians."""
        head = gimbal(numbers_of(self), pan_rad, tilt_rad)
        return Rigid(head.rotation, head.translation_m)


@dataclass(frozen=True, eq=False)
class RigCamera:
    """A camera of a rig: its model in the frame of the thing it is mounted ``on``.

    ``sensor_mode`` is the one that its pictures were calibrated in; None if not known.
    """

    on: Literal["head", "rover"]
    model: CameraModel
    sensor_mode: SensorMode | None = None


@dataclass(frozen=True, eq=False)
class Rig:
    """A mast with its cameras: the content of a mast file.

    ``stereo`` maps a pair name to its (left, right) camera names. ``joints`` are the errors of the head's
    readings: all other angles are true ones. ``fit`` and ``provenance`` are carried through unread.
    """

    name: str
    mast: Mast
    cameras: Mapping[str, RigCamera]
    stereo: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    fit: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    joints: JointErrors = field(default_factory=JointErrors)

    def __post_init__(self) -> None:
        for name in ("cameras", "stereo", "fit", "provenance"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel between processes: read-only views cannot be pickled."""
        views = (self.cameras, self.stereo, self.fit, self.provenance)
        return Rig, (self.name, self.mast, *map(dict, views), self.joints)

    def camera_in_rover(self, name: str, pan_rad: float, tilt_rad: float) -> CameraModel:
        """Return camera ``name`` in the rover frame at true joint angles; body cameras ignore them.

        Raises KeyError if the rig has no such camera.
        """
        camera = self.cameras[name]
        if camera.on == "rover":
            return camera.model
        return camera.model.moved(self.mast.rover_from_head(pan_rad, tilt_rad))


MAST_NAMES = (
    *(f"translation_m.{axis}" for axis in "xyz"),
    *(f"rotation_rad.{axis}" for axis in "xyz"),
    "axis_offset_m",
    "axis_twist_rad",
)

MAST_FREE = {4: (0, 1, 2, 5), 6: (0, 1, 2, 3, 4, 5), 8: (0, 1, 2, 3, 4, 5, 6, 7)}
"""Which of the mast's eight numbers a fit of so many parameters moves; 4 is a vertical mast."""


def mast_of(numbers: FloatArray) -> Mast:
    """Return the mast of eight numbers in the order of ``MAST_NAMES``."""
    return Mast(numbers[:3], numbers[3:6], float(numbers[6]), float(numbers[7]))


def numbers_of(mast: Mast) -> FloatArray:
    """Return a mast's eight numbers in the order of ``MAST_NAMES``."""
    return np.array([*mast.translation_m, *mast.rotation_rad, mast.axis_offset_m, mast.axis_twist_rad])


class Gimbal(NamedTuple):
    """rover_from_head, of one pair of joint angles or of many (...), and what moves it.

    ``twists`` (..., 10, 6) say how it moves with the eight numbers of the mast, pan and tilt: a turn, and the
    shift of what is carried through the rover's origin.
    """

    rotation: FloatArray
    translation_m: FloatArray
    twists: FloatArray

    def in_head(self, twists: FloatArray) -> FloatArray:
        """Return motions (..., k, 6) of the rover frame as the head's frame has them."""
        turns = twists[..., :3]
        shifts = twists[..., 3:] + crossed(turns, self.translation_m[..., None, :])
        return np.concatenate([turns @ self.rotation, shifts @ self.rotation], axis=-1)


def gimbal(mast: FloatArray, pan_rad: float | FloatArray, tilt_rad: float | FloatArray) -> Gimbal:
    """Return rover_from_head of the mast's eight numbers at joint angles (...), with its rates."""
    x = rot_x(mast[3])
    xy = x @ rot_y(mast[4])
    xyz = xy @ rot_z(mast[5])
    ahead, beside, down = xyz.T
    along, across = _turned(ahead, beside, pan_rad)
    lying, standing = _turned(across, np.broadcast_to(down, across.shape), mast[7])
    lowered, forward = _turned(standing, along, tilt_rad)
    origin = mast[:3]
    place = origin + mast[6] * along
    twists = np.zeros((*along.shape[:-1], 10, 6))
    twists[..., [0, 1, 2], [3, 4, 5]] = 1.0
    twists[..., 6, 3:] = along
    axes = ((3, x[:, 0], origin), (4, x[:, 1], origin), (5, xy[:, 2], origin), (7, along, place))
    for number, axis, through in (*axes, (8, down, origin), (9, lying, place)):
        twists[..., number, :3] = axis
        twists[..., number, 3:] = crossed(through, axis)
    return Gimbal(np.stack([forward, lying, lowered], axis=-1), place, twists)


def _turned(
    one: FloatArray, other: FloatArray, angle_rad: float | FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Two vectors (..., 3) at right angles, turned from the first to the second."""
    c, s = np.asarray(np.cos(angle_rad))[..., None], np.asarray(np.sin(angle_rad))[..., None]
    return c * one + s * other, c * other - s * one


def joint_twists(
    head: Gimbal,
    joints: JointErrors,
    read_rad: Pair | FloatArray,
    approach: Approach | FloatArray,
) -> FloatArray:
    """Return (..., 12, 6): how the head moves with the ten numbers of `JOINTS_NAMES`, the readings fixed, and
    with pan's and tilt's reading."""
    by_angles = head.twists[..., 8:, :]
    axes: list[Any] = list(zip((joints.pan, joints.tilt), read_rad, approach, strict=True))
    rates = np.stack([joint.rates(read, side) for joint, read, side in axes], axis=-2)
    slopes = np.stack([np.asarray(joint.slope(read, side)) for joint, read, side in axes], axis=-1)
    by_errors = (by_angles[..., None, :] * rates[..., None]).reshape(*rates.shape[:-2], -1, 6)
    return np.concatenate([by_errors, by_angles * slopes[..., None]], axis=-2)


def gimbal_rates(per_point: FloatArray, points_m: FloatArray, head: Gimbal, wanted: np.ndarray) -> FloatArray:
    """Return (n, m, k): rates of something per rover-frame point (n, m, 3) as the head carries points along.

    ``wanted`` (k,) picks from a gimbal's ten numbers.
    """
    return np.asarray(rigid_rates(per_point, points_m, np.zeros(3)) @ head.twists[wanted].T)

"""Rotations and rigid transforms.

A transform is named ``b_from_a`` and maps coordinates in frame a to coordinates in frame b, so inner
names touch in a product: ``c_from_a = c_from_b @ b_from_a``. Quaternions are (w, x, y, z). The six numbers of
a small motion are a turn, then a shift (docs/conventions.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def frozen_array(values: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Return a read-only float64 copy of ``values``; ValueError unless finite and of exactly ``shape``."""
    array = np.array(values, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"shape {array.shape} where {shape} is expected")
    if not np.isfinite(array).all():
        raise ValueError(f"{array.tolist()} holds a value that is not finite")
    array.setflags(write=False)
    return array


def finite_float(name: str, value: float) -> float:
    """Return a number as a float; ValueError with its name if it is none, or not finite."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is {value!r} where a number is expected") from None
    except OverflowError:  # an integer
        raise ValueError(f"{name} is larger than any float") from None
    if not math.isfinite(number):
        raise ValueError(f"{name} is {number} where a finite number is expected")
    return number


class ReadOnlyArrays:
    """For frozen dataclasses: arrays that were read-only stay so when it is unpickled or deeply copied.

    Values that were made of them once and kept would else be stale.
    """

    def __setstate__(self, state: dict[str, Any]) -> None:
        for value in state.values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
        self.__dict__.update(state)


def unit_vector(vector: ArrayLike) -> FloatArray:
    """Return a vector (3,) at length 1; ValueError if it has no direction."""
    given = np.asarray(vector, dtype=np.float64)
    length = float(np.linalg.norm(given))
    if not 0.0 < length < math.inf:
        raise ValueError(f"{given.tolist()} where a direction is expected")
    # A length so close to 1 is 1: such vectors keep their bits when a file is read and written.
    return given if abs(length - 1.0) <= 4e-16 else given / length


def rot_x(angle_rad: float) -> FloatArray:
    """Return the (3, 3) right-handed rotation about x."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rot_y(angle_rad: float) -> FloatArray:
    """Return the (3, 3) right-handed rotation about y."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rot_z(angle_rad: float) -> FloatArray:
    """Return the (3, 3) right-handed rotation about z."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_of(quaternion: ArrayLike) -> FloatArray:
    """Return the rotation (3, 3) of a quaternion (w, x, y, z), whose length does not count.

    >>> rotation_of([1.0, 1.0, 1.0, 1.0]).tolist()  # a third of a turn: x becomes y, y becomes z
    [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    """
    numbers = np.asarray(quaternion, dtype=np.float64)
    w, x, y, z = (numbers / math.sqrt(numbers @ numbers)).tolist()
    turn = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + 2.0 * (w * turn + turn @ turn))


def quaternion_of(rotation: FloatArray) -> list[float]:
    """Return a rotation (3, 3) as its unit quaternion [w, x, y, z], w not negative.

    Four times q qᵀ is linear in the rotation; its row with the largest diagonal is the best conditioned
    (S. W. Shepperd, Journal of Guidance and Control 1, 1978, 223).
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    rows = (
        (1.0 + a + e + i, h - f, c - g, d - b),
        (h - f, 1.0 + a - e - i, b + d, c + g),
        (c - g, b + d, 1.0 - a + e - i, f + h),
        (d - b, c + g, f + h, 1.0 - a - e + i),
    )
    row = max(zip(range(4), rows, strict=True), key=lambda one: one[1][one[0]])[1]
    length = -math.hypot(*row) if row[0] < 0.0 else math.hypot(*row)
    return [part / length for part in row]


def tangents(axis: FloatArray) -> FloatArray:
    """Return two unit vectors (2, 3) that make right-handed axes with a unit vector (3,), the third."""
    x, y, z = axis.tolist()  # plain numbers: in a twentieth of the time
    p, q, r = min((abs(x), (0.0, z, -y)), (abs(y), (-z, 0.0, x)), (abs(z), (y, -x, 0.0)))[1]
    size = math.sqrt(p * p + q * q + r * r)
    p, q, r = p / size, q / size, r / size
    return np.array([[p, q, r], [y * r - z * q, z * p - x * r, x * q - y * p]])


@dataclass(frozen=True, eq=False)
class Rigid(ReadOnlyArrays):
    """A rigid transform ``b_from_a``: x_in_b = rotation @ x_in_a + translation_m.

    The rotation (3, 3) is orthonormal with determinant +1, to 1e-6, else ValueError; the translation (3,) is
    the origin of a in b, metres.
    """

    rotation: FloatArray
    translation_m: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "rotation", frozen_array(self.rotation, (3, 3)))
        off = float(np.abs(self.rotation @ self.rotation.T - np.eye(3)).max())
        # 1e-6: how far R Rᵀ may be from the identity: a label's six digits make a part of it.
        if not off <= 1e-6 or np.linalg.det(self.rotation) < 0.0:
            raise ValueError(
                f"{self.rotation.tolist()} is no rotation: it stretches or shears by {off:.2g}, or mirrors"
            )
        object.__setattr__(self, "translation_m", frozen_array(self.translation_m, (3,)))

    @staticmethod
    def identity() -> Rigid:
        """Return the transform that changes nothing."""
        return Rigid(np.eye(3), np.zeros(3))

    def __matmul__(self, b_from_c: Rigid) -> Rigid:
        """Return a_from_c = a_from_b @ b_from_c."""
        return Rigid(
            self.rotation @ b_from_c.rotation,
            self.rotation @ b_from_c.translation_m + self.translation_m,
        )

    @property
    def inverse(self) -> Rigid:
        """The transform the other way."""
        return Rigid(self.rotation.T, -self.rotation.T @ self.translation_m)

    def points(self, points_m: ArrayLike) -> FloatArray:
        """Return points (..., 3), metres, carried over (turned and moved)."""
        return np.asarray(points_m, dtype=np.float64) @ self.rotation.T + self.translation_m

    def vectors(self, vectors: ArrayLike) -> FloatArray:
        """Return vectors (..., 3) carried over (turned only)."""
        return np.asarray(vectors, dtype=np.float64) @ self.rotation.T

    def __eq__(self, other: Any) -> bool:
        return (
            isinstance(other, Rigid)
            and np.array_equal(self.rotation, other.rotation)
            and np.array_equal(self.translation_m, other.translation_m)
        )


def carried_covariance(covariance: FloatArray, now_from_then: Rigid) -> FloatArray:
    """Return a motion's covariance (6, 6), stated in one frame, along the axes and at the origin of another.

    A turn r and a shift t of then move a point x of now by R r x (x - p) + R t. The result is exactly
    symmetric and has no negative variance.
    """
    turn, shift = now_from_then.rotation, now_from_then.translation_m
    carried = np.zeros((6, 6))
    carried[:3, :3] = carried[3:, 3:] = turn
    carried[3:, :3] = np.cross(shift, turn.T).T
    moved = carried @ covariance @ carried.T
    moved = (moved + moved.T) / 2
    # A variance of nothing may come out of the product as -1e-20.
    np.fill_diagonal(moved, np.maximum(np.diag(moved), 0.0))
    return np.asarray(moved)


def turning(turn_rad: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) of a rotation vector (3,), radians."""
    from scipy.spatial.transform import Rotation  # slow to load, and a command on files needs no fit

    return np.asarray(Rotation.from_rotvec(turn_rad).as_matrix())


def moved_rigid(pose: Rigid, step: FloatArray) -> Rigid:
    """Return a pose turned by the rotation vector step[:3] about its origin and shifted by step[3:]."""
    return Rigid(turning(step[:3]) @ pose.rotation, pose.translation_m + step[3:])


_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


def crossed(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the cross products (..., 3) of vectors (..., 3): as np.cross, in half the time."""
    return np.asarray(one[..., _NEXT] * other[..., _LAST] - one[..., _LAST] * other[..., _NEXT])


def rigid_rates(per_point: FloatArray, points_m: FloatArray, origin_m: FloatArray) -> FloatArray:
    """Return (n, m, 6): rates of something per point (n, m, 3) for a turn about ``origin_m`` and a shift.

    With ``np.eye(3)[None]`` for ``per_point`` they are those of the points (n, 3) themselves.
    """
    arm = (points_m - origin_m)[:, None, :]
    moment = crossed(arm, per_point)
    return np.concatenate([moment, np.broadcast_to(per_point, moment.shape)], axis=2)


def rigid_twists(origin_m: FloatArray) -> FloatArray:
    """Return (..., 6, 6) turns about ``origin_m`` (..., 3) and shifts, each as a turn about 0 and a shift."""
    twists = np.zeros((*origin_m.shape[:-1], 6, 6)) + np.eye(6)
    twists[..., :3, 3:] = crossed(origin_m[..., None, :], np.eye(3))
    return twists


def crossed_rows(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the cross products (..., 3, n) of vectors (3, n) and (..., 3, n)."""
    (a, b, c), (d, e, f) = one, np.moveaxis(other, -2, 0)
    return np.stack([b * f - c * e, c * d - a * f, a * e - b * d], axis=-2)

"""The mast as eight numbers, and how what it carries moves as they and the joints do.

The kinematics are those of ``calib.mast.rig``; here with the axes and origins that least squares needs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from calib.mast.rig import Mast
from calib.rigid import FloatArray, crossed, rot_x, rot_y, rot_z

MAST_NAMES = (
    *(f"translation_m.{axis}" for axis in "xyz"),
    *(f"rotation_rad.{axis}" for axis in "xyz"),
    "axis_offset_m",
    "axis_twist_rad",
)

MAST_FREE = {4: (0, 1, 2, 5), 6: (0, 1, 2, 3, 4, 5), 8: (0, 1, 2, 3, 4, 5, 6, 7)}
"""Which of the mast's eight numbers a fit of so many parameters moves; 4 is the mast taken as vertical."""


def mast_of(numbers: FloatArray) -> Mast:
    """Return the mast of eight numbers in the order of ``MAST_NAMES``."""
    return Mast(numbers[:3], numbers[3:6], float(numbers[6]), float(numbers[7]))


def numbers_of(mast: Mast) -> FloatArray:
    """Return a mast's eight numbers in the order of ``MAST_NAMES``."""
    return np.array([*mast.translation_m, *mast.rotation_rad, mast.axis_offset_m, mast.axis_twist_rad])


class Gimbal(NamedTuple):
    """rover_from_head and its rates: what turns about which axis through which point, in the rover frame."""

    rotation: FloatArray
    translation_m: FloatArray
    axes: FloatArray
    """(10, 3): the eight numbers of the mast, pan, tilt; for a shift its direction, for an angle its axis."""
    mast_origin_m: FloatArray


_ABOUT_MAST, _ABOUT_HEAD = (3, 4, 5, 8), (7, 9)
"""Which of a gimbal's ten numbers are angles about axes through the mast's or the head's origin."""


def gimbal(mast: FloatArray, pan_rad: float, tilt_rad: float) -> Gimbal:
    """Return rover_from_head of the mast's eight numbers at joint angles, with its rates."""
    x = rot_x(mast[3])
    xy = x @ rot_y(mast[4])
    xyz = xy @ rot_z(mast[5])
    panned = xyz @ rot_z(pan_rad)
    twisted = panned @ rot_x(mast[7])
    origin = mast[:3]
    place = origin + mast[6] * panned[:, 0]
    eye = np.eye(3)
    axes = np.array([*eye, eye[0], x[:, 1], xy[:, 2], panned[:, 0], panned[:, 0], xyz[:, 2], twisted[:, 1]])
    return Gimbal(twisted @ rot_y(tilt_rad), place, axes, origin)


def gimbal_rates(per_point: FloatArray, points_m: FloatArray, head: Gimbal, wanted: np.ndarray) -> FloatArray:
    """Return (n, m, k): rates of something per rover-frame point (n, m, 3) as the head carries points along.

    ``wanted`` (k,) picks from a gimbal's ten numbers.
    """
    about_mast = crossed((points_m - head.mast_origin_m)[:, None, :], per_point)
    about_head = crossed((points_m - head.translation_m)[:, None, :], per_point)
    columns = []
    for index in wanted:
        kind = about_head if index in _ABOUT_HEAD else about_mast if index in _ABOUT_MAST else per_point
        columns.append(kind @ head.axes[index])
    return np.stack(columns, axis=-1) if columns else np.zeros((*per_point.shape[:2], 0))

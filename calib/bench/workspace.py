"""How well a rig would point, over the whole of where it points: the figure that the choice of poses lowers.

A target is clicked in a pair of the head at one attitude, ranged by it, and brought to the image centre by
the closed form. What the rig's parameters are off by moves the ranged place, and where the head then looks.
With the picture of the landing as truth the residual is, at first order,

    e = -(d pixel / d rig + d pixel / d point . d point / d rig),

the rates of the landing's picture, and the ranged point as both clicks hold it. A single camera is told the
range.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.bench.knowledge import Knowledge, Shot
from calib.errors import CalibError
from calib.mast.pointing import solve
from calib.rigid import FloatArray

RANGES_M = (2.0, 6.0, 10.0)
CLICKS = ((0.15, 0.2), (0.85, 0.8), (0.85, 0.2), (0.15, 0.8))
"""Where in the picture targets are clicked, in parts of its width and height: towards its corners."""
STEPS = (5, 3)


@dataclass(frozen=True)
class Workspace:
    """Where a rig points: joint angles at which targets are clicked, and how far away they are.

    Attributes
    ----------
    cameras
        The clicked camera, and its partner if there is one.
    pan_rad, tilt_rad
        From where to where.
    ranges_m
        Of the targets.
    one_sided
        Whether the head approaches every goal from the same side by itself, so that backlash is no error.
    """

    cameras: tuple[str, ...]
    pan_rad: tuple[float, float]
    tilt_rad: tuple[float, float]
    ranges_m: Sequence[float] = RANGES_M
    one_sided: bool = False


@dataclass(frozen=True, eq=False)
class Pointing:
    """How landings (2k) depend on the rig's unknowns (2k, p) and on the four joint readings (2k, 4).

    ``places`` (k) are pan and tilt of the click, radians, and the target's range, metres.
    """

    to_rig: FloatArray
    to_joints: FloatArray
    places: tuple[tuple[float, float, float], ...] = ()

    def rms_px(self, covariance: FloatArray) -> float:
        """Return the rms per axis of the landings that an uncertainty (p, p) of the rig makes."""
        return float(np.sqrt(max(np.sum(self._weights * covariance), 0.0)))

    @cached_property
    def _weights(self) -> FloatArray:
        """The matrix (p, p) whose product with a covariance has the mean square per axis as trace."""
        return np.asarray(self.to_rig.T @ self.to_rig / max(len(self.to_rig), 1))

    def by_counts_px(self, joint_sigma_rad: float) -> float:
        """Return the rms per axis that the readings alone leave, however well the rig is known."""
        squares = np.sum(self.to_joints**2) / max(len(self.to_joints), 1)
        return float(joint_sigma_rad * np.sqrt(squares))


def pointing(known: Knowledge, where: Workspace) -> Pointing:
    """Return how pointing over the workspace depends on what is unknown.

    Raises
    ------
    CalibError
        If nothing of the workspace can be pointed at.
    """
    rows, joints, places = [], [], []
    approach = 0
    for pan in np.linspace(*where.pan_rad, STEPS[0]):
        for tilt in np.linspace(*where.tilt_rad, STEPS[1]):
            for range_m in where.ranges_m:
                for click in CLICKS:
                    # Backlash shows where click and landing were approached from different sides.
                    approach = 0 if where.one_sided else 1 if approach != 1 else -1
                    clicked = Shot("", float(pan), float(tilt), (), approach, approach)
                    try:
                        row = _landing(known, where.cameras, clicked, click, range_m)
                    except CalibError:
                        continue
                    rows.append(row[0])
                    joints.append(row[1])
                    places.append((float(pan), float(tilt), float(range_m)))
    if not rows:
        raise CalibError(f"camera {where.cameras[0]} can be pointed at nothing of the workspace")
    return Pointing(np.concatenate(rows), np.concatenate(joints), tuple(places))


def _landing(
    known: Knowledge, cameras: Sequence[str], clicked: Shot, click: tuple[float, float], range_m: float
) -> tuple[FloatArray, FloatArray]:
    """One target's two rows: to the rig, and to the readings before and after the move."""
    rig = known.rig
    model = rig.cameras[cameras[0]].model
    width, height = model.size_px
    ray = model.ray(np.array([click[0] * width, click[1] * height]))
    head = known.head(clicked)
    point = head.rotation @ (ray.origins_m + range_m * ray.directions) + head.translation_m
    seen = [known.rates(camera, clicked, point[None]) for camera in cameras]
    by_point = np.concatenate([one.to_points[0] for one in seen])
    by_rig = np.concatenate([one.to_rig[0] for one in seen])
    by_joints = np.concatenate([one.to_joints[0] for one in seen])
    if len(cameras) == 1:  # its range is told: a row of its own, weighed as much as a pixel's
        along = head.rotation @ ray.directions
        by_point = np.vstack([by_point, along * float(np.linalg.norm(model.H)) / range_m])
        by_rig = np.vstack([by_rig, np.zeros(by_rig.shape[1])])
        by_joints = np.vstack([by_joints, np.zeros(2)])
    back = np.linalg.pinv(by_point)
    angles = solve(rig.mast, model, point, from_pan_rad=clicked.pan_rad, from_tilt_rad=clicked.tilt_rad)[0]
    landed = Shot(
        "",
        float(rig.joints.pan.read_rad(angles.pan_rad, -clicked.pan_approach)),
        float(rig.joints.tilt.read_rad(angles.tilt_rad, -clicked.tilt_approach)),
        (),
        -clicked.pan_approach,
        -clicked.tilt_approach,
    )
    there = known.rates(cameras[0], landed, point[None])
    to_point = there.to_points[0]
    if not (np.isfinite(by_rig).all() and np.isfinite(there.to_rig).all()):
        raise CalibError("outside the lens")
    return (
        to_point @ back @ by_rig - there.to_rig[0],
        np.concatenate([-there.to_joints[0], to_point @ back @ by_joints], axis=1),
    )

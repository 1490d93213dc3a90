"""Where a target lands that a rig points at, by another rig or its uncertainty.

A pointing as the daemon does it: two pixels of a stereo pair, triangulated and pointed at by the believed
rig. Where the target lands then is by the true one. The paper's sections IV and V, without a renderer.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from calib.adjust.result import FittedRig
from calib.errors import CalibError
from calib.geometry.covariance import RigCovariance
from calib.geometry.pointing import solve
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.geometry.stereo import triangulate
from calib.plan.knowledge import ExpectedPointing, Knowledge, Workspace, pointing
from mastctl.errors import MastctlError

POINTING_RANGE_M = 6.0

NEAR_CORNER = (0.2, 0.2)
"""Where targets are clicked, as part of the image's width and height: off the middle."""

PANS_RAD, TILTS_RAD = (-2.0, -1.0, 0.0, 1.0, 2.0), (-0.9, -0.4, 0.1, 0.6)
"""Joint angles at which two rigs are compared."""


def click(
    true: Rig, pair: tuple[str, str], pan_rad: float, tilt_rad: float, left_px: ArrayLike, range_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a target (3,), rover frame, metres, and its true pixels (2,) in the left and right image.

    The target is ``range_m`` along the true ray of ``left_px`` at the given joint angles. Raises CalibError
    if one of the two cameras does not see it.
    """
    rays = true.camera_in_rover(pair[0], pan_rad, tilt_rad).ray(left_px)
    target = rays.origins_m + range_m * rays.directions
    left, right = (seen(true, name, pan_rad, tilt_rad, target) for name in pair)
    return target, left, right


def seen(rig: Rig, camera: str, pan_rad: float, tilt_rad: float, point_m: FloatArray) -> FloatArray:
    """Return the pixel (2,) of a rover-frame point (3,), metres, inside or outside the image.

    Raises CalibError if the camera cannot project it.
    """
    pixel, valid = rig.camera_in_rover(camera, pan_rad, tilt_rad).project(point_m)
    if not valid:
        raise CalibError(f"camera {camera} does not see the point {np.round(point_m, 3).tolist()} m")
    return np.asarray(pixel)


def pointing_error_px(
    believed: Rig,
    true: Rig,
    pair: tuple[str, str],
    pan_rad: float,
    tilt_rad: float,
    target_m: FloatArray,
    left_px: ArrayLike,
    right_px: ArrayLike,
) -> FloatArray:
    """Return how far (2,), pixels, a target lands from the middle of the left image after one pointing.

    The target (3,), rover frame, was clicked in both images (2,) at the given joint angles. Raises CalibError
    if the believed rig finds no such point, or cannot point at it.
    """
    left, right = (believed.camera_in_rover(name, pan_rad, tilt_rad) for name in pair)
    found = triangulate(left, right, left_px, right_px)
    return position_error_px(believed, true, pair[0], pan_rad, tilt_rad, found.position_m, target_m)


def position_error_px(
    believed: Rig,
    true: Rig,
    camera: str,
    pan_rad: float,
    tilt_rad: float,
    position_m: FloatArray,
    target_m: FloatArray,
) -> FloatArray:
    """Return how far (2,), pixels, a target lands from the image's middle if ``position_m`` is pointed at.

    ``pan_rad``, ``tilt_rad`` choose the nearest of several solutions. Raises CalibError as above.
    """
    model = believed.cameras[camera].model
    middle = np.array(model.image_center_px)
    angles = solve(
        believed.mast, model, position_m, middle, from_pan_rad=pan_rad, from_tilt_rad=tilt_rad
    )[0]  # fmt: skip
    return np.asarray(seen(true, camera, angles.pan_rad, angles.tilt_rad, target_m) - middle)


def head_cameras(rig: Rig) -> Sequence[tuple[str, ...]]:
    """Return the cameras that point: the pairs on the head, the Navcams first, else one camera, else none."""
    pairs = {n: p for n, p in rig.stereo.items() if all(rig.cameras[c].on == "head" for c in p)}
    if pairs:
        return [pairs[name] for name in sorted(pairs, key=lambda name: name != "navcam")]
    return [(name,) for name, camera in rig.cameras.items() if camera.on == "head"][:1]


def first_cameras(rig: Rig) -> tuple[str, ...]:
    """Return the first of `head_cameras`. Raises MastctlError if no camera is on the head."""
    for cameras in head_cameras(rig):
        return cameras
    raise MastctlError("the mast file has no camera on the head, and so no head to calibrate")


@lru_cache(4)
def expected_pointing(
    fit: FittedRig, cameras: tuple[str, ...] | None = None, middle: bool = False
) -> tuple[ExpectedPointing, FloatArray] | None:
    """Return how first pointings depend on a fitted rig's numbers, and their covariance.

    Over the angles at which boards were seen, targets at 2, 6 and 10 m, clicked in these cameras, by default
    the first (one camera gets the range); with ``middle`` only amid those angles, `POINTING_RANGE_M` away.
    None if nothing can be pointed at. The last are kept: verdict, report and result of a bench need the same.
    """
    readings = np.array([(i.pan_rad, i.tilt_rad) for i in fit.images if i.pan_rad is not None], dtype=float)
    known, names = Knowledge(fit.rig, {}), cameras or first_cameras(fit.rig)
    if middle:
        pan, tilt = np.median(readings, axis=0).tolist()
        where = Workspace(names, (pan, pan), (tilt, tilt), ranges_m=(POINTING_RANGE_M,))
    else:
        (low_pan, low_tilt), (high_pan, high_tilt) = readings.min(axis=0), readings.max(axis=0)
        where = Workspace(names, (float(low_pan), float(high_pan)), (float(low_tilt), float(high_tilt)))
    try:
        landings = pointing(known, where)
    except CalibError:
        return None
    return landings, RigCovariance(fit.parameter_names, fit.covariance).among(known.names)


def pointing_change(new: Rig, old: Rig) -> dict[str, dict[str, float]]:
    """Return by pair of the head by how many pixels pointing would change, median and most over the joints.

    ``median_px``, ``most_px``: of a target clicked near a corner, `POINTING_RANGE_M` away;
    ``position_median_px``, ``position_most_px``: of one whose place in the rover frame is given. The new rig
    is treated as the true one. Pairs that the old rig does not have are left out.
    """
    found = {}
    for pair, names in new.stereo.items():
        if any(
            name not in old.cameras or "rover" in (new.cameras[name].on, old.cameras[name].on)
            for name in names
        ):
            continue
        size_px = np.array(new.cameras[names[0]].model.size_px)
        clicked, placed = [], []
        for tilt in TILTS_RAD:
            for pan in PANS_RAD:
                try:
                    target, left, right = click(
                        new, names, pan, tilt, size_px * NEAR_CORNER, POINTING_RANGE_M
                    )
                    off_px = pointing_error_px(old, new, names, pan, tilt, target, left, right)
                    clicked.append(np.linalg.norm(off_px))
                    off_px = position_error_px(old, new, names[0], pan, tilt, target, target)
                    placed.append(np.linalg.norm(off_px))
                except CalibError:
                    continue
        if placed:
            found[pair] = {
                "median_px": float(np.median(clicked)),
                "most_px": float(np.max(clicked)),
                "position_median_px": float(np.median(placed)),
                "position_most_px": float(np.max(placed)),
            }
    return found

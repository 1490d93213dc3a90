"""Camera hand-off: where a target that one stereo pair sees falls in other cameras (the paper's section V).

There are three steps: a ray through each picked pixel of the pair, the point nearest to both rays, and its
projection into each next camera, on the body or on the head, the head turned or not. The covariance goes the
same way, to first order in closed form. Errors of clicks, joint angles and calibration are carried through
the whole chain, so that errors which both sides share cancel as they do in the rig.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib.errors import NoHandoff
from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import (
    JOINT_NAMES,
    RayGap,
    RigCovariance,
    click_rates,
    clicked_point,
    pixel_rates,
)
from calib.geometry.rig import UNKNOWN, Approach, Rig
from calib.geometry.rigid import FloatArray, finite_float
from calib.geometry.stereo import Triangulation


@dataclass(frozen=True, eq=False)
class Joints:
    """Measured true joint angles, and the sigma of each reading; radians. ValueError if they are none.

    ``approach``: from which side the axes came (`calib.geometry.rig`); the backlash's sigma counts by it.
    """

    pan_rad: float
    tilt_rad: float
    sigma_rad: float = 0.0
    approach: Approach = UNKNOWN

    def __post_init__(self) -> None:
        for name in ("pan_rad", "tilt_rad", "sigma_rad"):
            object.__setattr__(self, name, finite_float(name, getattr(self, name)))
        if self.sigma_rad < 0.0:
            raise ValueError(f"sigma_rad is {self.sigma_rad} where 0 or more is expected")


@dataclass(frozen=True, eq=False)
class PredictedPixel:
    """Where a camera sees the target: pixel (2,), and its covariance (2, 2) by the clicks' noise alone.

    ``search_px2`` (2, 2) is that of everything stated to be uncertain: clicks, joint readings, calibration.
    Its ellipse is where to search for the target.
    """

    pixel_px: FloatArray
    covariance_px2: FloatArray
    search_px2: FloatArray


@dataclass(frozen=True, eq=False)
class Handoff:
    """A target handed to other cameras, whose images were taken at ``pan_rad`` and ``tilt_rad``.

    ``seen`` is what the source pair shows, rover frame, its covariance from the clicks alone, ``gap`` how far
    its two rays pass each other, ``covariance_m2`` (3, 3) that of the position from everything stated to be
    uncertain. ``pixels`` has None for a camera that does not see the target, ``reasons`` why. ``joint_px2``
    (2n, 2n) is ``search_px2`` of all n pixels together, in their order: what they share (the target's place,
    the calibration) moves them together.
    """

    seen: Triangulation
    gap: RayGap
    covariance_m2: FloatArray
    pixels: Mapping[str, PredictedPixel | None]
    joint_px2: FloatArray
    reasons: Mapping[str, str]
    pan_rad: float
    tilt_rad: float


def hand_off(
    rig: Rig,
    pair: tuple[str, str],
    to: Sequence[str],
    joints: Joints,
    left_px: ArrayLike,
    right_px: ArrayLike,
    *,
    to_joints: Joints | None = None,
    sigma_px: float = 0.2,
    calibration: RigCovariance | None = None,
) -> Handoff:
    """Hand a target, clicked (2,) in both images of a stereo pair, over to other cameras of body or head.

    Without ``to_joints`` source and destination images have one reading of the joints with one error.
    ``sigma_px`` is that of each pixel coordinate of a click. Without a ``calibration`` the covariances assume
    an exact rig, and the rays' gap is judged by `calib.geometry.covariance.RIG_PX`.

    Raises
    ------
    NoStereoPoint
        As `calib.geometry.stereo.triangulate`. ``not_one_point``: the two rays pass each other farther than
        clicks, joint readings and calibration explain (`calib.geometry.covariance`).
    NoHandoff
        ``too_near``: nearer than the pair's baseline. ``too_far``: infinity is within three sigma of the
        range. ``not_seen``: no destination camera sees the target.
    """
    seen, gap = clicked_point(
        rig, pair, joints.pan_rad, joints.tilt_rad, left_px, right_px,
        sigma_px=sigma_px, sigma_rad=joints.sigma_rad, calibration=calibration,
    )  # fmt: skip
    _refuse_range(seen, [rig.camera_in_rover(name, joints.pan_rad, joints.tilt_rad) for name in pair], pair)
    there, position = to_joints or joints, seen.position_m
    cameras = {name: rig.camera_in_rover(name, there.pan_rad, there.tilt_rad) for name in to}
    reasons = {name: why for name, model in cameras.items() if (why := _unseen(model, position))}
    shown = [name for name in to if name not in reasons]
    if not shown:
        whys = "; ".join(f"{name}: {why}" for name, why in reasons.items())
        raise NoHandoff("not_seen", f"no destination camera sees the target: {whys}")

    # How position (3) and pixels (2n) follow calibration and joint readings, of which the last are there.
    known = calibration.of((*pair, *shown)) if calibration else RigCovariance((), np.zeros((0, 0)))
    names, size = (*known.names, *JOINT_NAMES), len(known.names)
    readings = [joints] if to_joints is None else [joints, to_joints]
    clicked = click_rates(rig, names, pair, joints.pan_rad, joints.tilt_rad, position, joints.approach)
    views = [
        pixel_rates(rig, names, name, there.pan_rad, there.tilt_rad, position[None], there.approach)
        for name in shown
    ]
    both = np.concatenate([view.to_points[0] for view in views])
    rates = np.zeros((3 + 2 * len(shown), size + 2 * len(readings)))
    rates[:3, : size + 2] = seen.rates_m_per_px @ clicked
    rates[3:] = both @ rates[:3]
    rates[3:, [*range(size), -2, -1]] += np.concatenate([view.to_rig[0] for view in views])
    turned = np.repeat([reading.sigma_rad for reading in readings], 2) * rates[:, size:]
    total = rates[:, :size] @ known.covariance @ rates[:, :size].T + turned @ turned.T

    clicks = both @ seen.covariance_m2 @ both.T
    joint = clicks + total[3:, 3:]
    pixels: dict[str, PredictedPixel | None] = dict.fromkeys(to)
    for row, (name, view) in enumerate(zip(shown, views, strict=True)):
        part = (slice(2 * row, 2 * row + 2),) * 2
        pixels[name] = PredictedPixel(view.pixels_px[0], clicks[part], joint[part])
    position_m2 = seen.covariance_m2 + total[:3, :3]
    return Handoff(seen, gap, position_m2, pixels, joint, reasons, there.pan_rad, there.tilt_rad)


def _refuse_range(seen: Triangulation, models: Sequence[CameraModel], pair: tuple[str, str]) -> None:
    """Refuse a point for which the pair is no stereo pair."""
    baseline = models[1].C - models[0].C
    baseline_m = float(np.linalg.norm(baseline))
    between = seen.position_m - (models[0].C + models[1].C) / 2
    range_m = float(np.linalg.norm(between))
    if range_m < baseline_m:
        raise NoHandoff(
            "too_near",
            f"the target is {range_m:.3g} m away, nearer than the {baseline_m:.3g} m between {pair[0]} and "
            f"{pair[1]}; use a pair that sees near",
        )
    along = between / range_m
    sigma_m = math.sqrt(max(float(along @ seen.covariance_m2 @ along), 0.0))
    if 3.0 * sigma_m >= range_m:
        raise NoHandoff(
            "too_far",
            f"the target is {range_m:.3g} m away and its range uncertain by {sigma_m:.3g} m (one sigma), so "
            f"that {pair[0]} and {pair[1]} cannot distinguish it from infinity. Use a pair that sees far",
        )


def _unseen(model: CameraModel, position_m: FloatArray) -> str:
    """Why a camera does not see a point; empty if it does."""
    pixel, valid = model.project(position_m)
    if not valid:
        return "the target is behind the camera or beyond what its lens images"
    if model.holds(pixel):
        return ""
    width, height = model.size_px
    return (
        f"the target falls on pixel ({pixel[0]:.1f}, {pixel[1]:.1f}), outside the image of {width} x {height}"
    )

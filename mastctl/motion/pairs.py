"""Which pair of cameras serves for a target, and the record of a hand-off from one to the next."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import stored_covariance
from calib.geometry.handoff import Joints, hand_off
from calib.geometry.pointing import Solution, choose, solve
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.geometry.stereo import stereo_range_error_m
from calib.matching.handed_over import MatchedHandoff, matched_handoff
from calib.matching.handoff import RefineSettings, refine_handoff
from calib.matching.verdict import PatchMatch
from mastctl.devices.keep_out import KeptOut
from mastctl.devices.limits import Limits
from mastctl.motion.settings import HandoffRules
from mastctl.motion.views import CameraView

Chosen = Callable[[Sequence[Solution]], Solution]

CENTRING_STEPS = 3
"""Each solves exactly for one camera; the place in the other follows within a pixel after two."""


@dataclass(frozen=True)
class PairChoice:
    """A pair that sees a target.

    Attributes
    ----------
    pair
        Its name.
    pan_rad, tilt_rad
        True joint angles that bring the target midway between the two images' middles; None for a pair on
        the body, which the head does not turn.
    range_m
        From the middle between the pair's cameras.
    range_error_m
        By eqs. (1) and (2), 3 sigma.
    outside
        Which bounds are broken, in sentences; empty for a pair that keeps them all.
    """

    pair: str
    pan_rad: float | None
    tilt_rad: float | None
    range_m: float
    range_error_m: float
    outside: str = ""


def choose_pairs(
    rig: Rig,
    position_m: FloatArray,
    rules: HandoffRules | None = None,
    limits: Limits | None = None,
    from_rad: tuple[float, float] = (0.0, 0.0),
    chosen: Chosen | None = None,
) -> list[PairChoice]:
    """Return the pairs that see a position, the one that should take images first.

    Pairs that keep their bounds come first, the most accurate in front. Then those that see the target but
    break a bound, the shortest focal length in front: they serve where no other does.

    Parameters
    ----------
    position_m
        (3,) the target in the rover frame.
    limits
        Of the head; none by default.
    from_rad
        True pan and tilt of now, for the choice among solutions.
    chosen
        Chooses among them in place of ``limits``.

    Raises CalibError if no pair has the target well inside both images, with the reason for each.
    """
    rules = rules or HandoffRules()

    def within_limits(solutions: Sequence[Solution]) -> Solution:
        return choose(solutions, limits.pan_rad, limits.tilt_rad, *from_rad) if limits else solutions[0]

    choose_one = chosen or within_limits
    kept: list[tuple[float, PairChoice]] = []
    broken: list[tuple[float, PairChoice]] = []
    reasons: list[str] = []
    for name in rig.stereo:
        try:
            focal_px, choice = _choice_of(rig, name, position_m, rules, choose_one, from_rad)
        except (CalibError, KeptOut) as error:
            reasons.append(f"{name}: {error}")
            continue
        (broken if choice.outside else kept).append((focal_px, choice))
    kept.sort(key=lambda one: one[1].range_error_m)
    broken.sort(key=lambda one: one[0])
    found = [choice for _, choice in (*kept, *broken)]
    if not found:
        place = ", ".join(f"{value:.2f}" for value in position_m)
        why = "; ".join(reasons) or "none is configured with both cameras"
        raise CalibError(f"no stereo pair sees the target at ({place}) m: {why}")
    return found


def _choice_of(
    rig: Rig,
    name: str,
    position_m: FloatArray,
    rules: HandoffRules,
    chosen: Chosen,
    from_rad: tuple[float, float],
) -> tuple[float, PairChoice]:
    """One pair's focal length and how it would see the position. Raises CalibError if it cannot."""
    cameras = rig.stereo[name]
    angles = None
    if rig.cameras[cameras[0]].on == "head":
        angles = _centred(rig, cameras, position_m, chosen, from_rad)
    left, right = (rig.camera_in_rover(camera, *(angles or (0.0, 0.0))) for camera in cameras)
    for camera, model in zip(cameras, (left, right), strict=True):
        _check_in_image(camera, model, position_m, rules.margin_px)
    between = position_m - (left.C + right.C) / 2
    range_m = float(np.linalg.norm(between))
    steep_rad = math.asin(float(between[2]) / range_m)
    focal_px = left.focal_px[0]
    baseline_m = float(np.linalg.norm(right.C - left.C))
    error_m = stereo_range_error_m(range_m, focal_px, baseline_m, rules.disparity_error_px)
    bounds = rules.bounds(name)
    outside = []
    if range_m < bounds.nearest_m:
        outside.append(f"{range_m:.2f} m away, nearer than {bounds.nearest_m:g} m")
    if steep_rad > bounds.steepest_rad:
        outside.append(f"{steep_rad:.2f} rad below the horizontal, steeper than {bounds.steepest_rad:g} rad")
    if error_m > rules.range_error * range_m:
        outside.append(f"range error {error_m:.2f} m, more than {rules.range_error:g} of the range")
    pan_rad, tilt_rad = angles or (None, None)
    return focal_px, PairChoice(name, pan_rad, tilt_rad, range_m, error_m, "; ".join(outside))


def _centred(
    rig: Rig,
    cameras: tuple[str, str],
    position_m: FloatArray,
    chosen: Chosen,
    from_rad: tuple[float, float],
) -> tuple[float, float]:
    """Joint angles that put the target as far from the middle in the one camera as in the other.

    In the middle of one camera alone a near target may be outside the other's image. Raises CalibError.
    """
    left, right = (rig.cameras[camera].model for camera in cameras)
    middle = np.array(left.image_center_px)
    aim = middle.copy()
    pan_rad, tilt_rad = from_rad
    for _ in range(CENTRING_STEPS):
        solutions = solve(
            rig.mast, left, position_m, aim, from_pan_rad=from_rad[0], from_tilt_rad=from_rad[1]
        )
        best = chosen(solutions)
        pan_rad, tilt_rad = best.pan_rad, best.tilt_rad
        in_right, seen = rig.camera_in_rover(cameras[1], pan_rad, tilt_rad).project(position_m)
        if not bool(seen):
            break  # the check of both images says so
        off = (np.array(right.image_center_px) - in_right - (aim - middle)) / 2
        aim = np.clip(aim + off, 0.0, np.array(left.size_px) - 1.0)
    return pan_rad, tilt_rad


def _check_in_image(camera: str, model: CameraModel, position_m: FloatArray, margin_px: float) -> None:
    """Pass a camera that has a position well inside its image. Raises CalibError."""
    pixel, seen = model.project(position_m)
    if not bool(seen):
        raise CalibError(f"{camera} has it behind itself or beyond what its lens images")
    if not model.holds(pixel, margin_px):
        width, height = model.size_px
        raise CalibError(
            f"{camera} has it at pixel ({pixel[0]:.0f}, {pixel[1]:.0f}), not {margin_px:g} px inside its "
            f"{width}x{height} px"
        )


JOINT_SIGMA_RAD = 3e-5
"""What a joint reading is assumed to be wrong by: half a step of a stepped pan/tilt unit."""
LEAST_SIGMA_PX = 0.05
HANDOFF_SETTINGS = RefineSettings(least_px=6.0, model_px=1.0)
"""Two sets of cameras may mean rover frames that are 5 mrad apart, the paper's bias of 2 px in a Hazcam: wide
enough that this is found also by a mast file that says nothing of its own errors. Beyond 3 px nothing is."""


def record_of(
    rig: Rig, pair: tuple[str, str], views: Mapping[str, CameraView], found: Mapping[str, PatchMatch],
    to: Mapping[str, CameraView],
) -> MatchedHandoff | str:  # fmt: skip
    """Return the record of a target that one pair found, in another's images, or why there is none.

    ``pair``, ``views`` and ``found`` are the former pair, left camera first, its images, and where the target
    was found in them; ``to`` the images of the next pair.
    """
    if not to or any(name not in found or found[name].verdict != "good" for name in pair):
        return (
            "one of the pictures did not come, or the former pair did not find the target with both cameras"
        )
    left, right = (views[name] for name in pair)
    clicks = np.array([found[name].pixel_px for name in pair])
    sigma_px = max(LEAST_SIGMA_PX, *(float(found[name].sigma_px.max()) for name in pair))
    joints, to_joints = _joints(left), _joints(next(iter(to.values())))
    try:
        handed = hand_off(
            rig, pair, tuple(to), joints, clicks[0], clicks[1],
            to_joints=to_joints, sigma_px=sigma_px, calibration=stored_covariance(rig),
        )  # fmt: skip
    except CalibError as error:
        return " ".join(str(error).split())
    refined = refine_handoff(handed, (left, right), clicks, to, HANDOFF_SETTINGS)
    return matched_handoff(left.frame.mast_digest, pair, joints, clicks, sigma_px, to_joints, handed, refined)


def _joints(view: CameraView) -> Joints:
    frame = view.frame
    return Joints(*frame.true_rad, JOINT_SIGMA_RAD, (frame.pan_approach, frame.tilt_approach))


LEAST_ELLIPSE_PX = 0.05


def in_picture(camera: CameraModel, position_m: ArrayLike, covariance_m2: object) -> dict[str, float] | None:
    """Return the pixel of a point and one sigma of it as an ellipse.

    ``camera``: in the frame of the point; ``position_m``, ``covariance_m2``: (3,) metres and (3, 3) m²; None
    for a point whose covariance is not known: then the ellipse is none.

    Returns
    -------
    dict or None
        ``x_px``, ``y_px``, ``major_px``, ``minor_px`` (half axes), ``turn_rad`` (of the major one, from x
        towards y); None if the camera does not show the point.
    """
    place, rates, valid = camera.project_jacobian(position_m)
    if not bool(valid) or not camera.holds(place):
        return None
    ellipse = {"x_px": float(place[0]), "y_px": float(place[1])}
    if covariance_m2 is None:
        return ellipse | {"major_px": 0.0, "minor_px": 0.0, "turn_rad": 0.0}
    variances, axes = np.linalg.eigh(rates @ np.asarray(covariance_m2, dtype=float) @ rates.T)
    minor, major = (max(LEAST_ELLIPSE_PX, math.sqrt(max(0.0, one))) for one in variances.tolist())
    return ellipse | {
        "major_px": major, "minor_px": minor, "turn_rad": math.atan2(axes[1, 1], axes[0, 1])
    }  # fmt: skip

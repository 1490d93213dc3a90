"""Which stereo pair looks at a target: by range, by view angle, and by the accuracy that the budget predicts.

The paper hands over from Pancam to Navcam at 6 m, because Pancam's stereo ends at 5 m, and from Navcam to
Hazcam at 2 m, before Navcam looks down too steeply. Both are bounds of a pair here. Among the pairs that keep
their bounds and have the target well inside both pictures, the one with the smallest range error by eqs. (1)
and (2) looks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.camera.cahvor import CameraModel
from calib.errors import CalibError
from calib.mast.budget import stereo_range_error_m
from calib.mast.pointing import solve
from calib.mast.rig import Rig
from calib.mast.solutions import Solution, choose
from calib.rigid import FloatArray
from mastctl.devices.keep_out import KeptOut, NoWay
from mastctl.devices.limits import Limits

Chosen = Callable[[Sequence[Solution]], Solution]

CENTRING_STEPS = 3
"""Each solves exactly for one eye; the other eye's place follows within a pixel after two."""


@dataclass(frozen=True)
class PairBounds:
    """Where a pair looks.

    Attributes
    ----------
    nearest_m
        Least range of the target from the middle between the pair's cameras.
    steepest_rad
        How far below the rover's horizontal it looks at most.
    """

    nearest_m: float = 0.0
    steepest_rad: float = math.pi / 2


@dataclass(frozen=True)
class HandoffRules:
    """What decides between the pairs.

    Attributes
    ----------
    pairs
        Bounds of each pair by its name; a pair that is not here has none. The ranges are the paper's.
    margin_px
        The target lies at least so far inside both pictures.
    disparity_error_px
        3-sigma disparity error of eq. (1).
    range_error
        Largest range error by eqs. (1) and (2), 3 sigma, as a part of the range. At 0.2 a 640x480 Hazcam
        serves up to some 6 m.
    """

    pairs: Mapping[str, PairBounds] = field(
        default_factory=lambda: {"pancam": PairBounds(6.0), "navcam": PairBounds(2.0)}
    )
    margin_px: float = 30.0
    disparity_error_px: float = 1.0
    range_error: float = 0.2


@dataclass(frozen=True)
class Choice:
    """A pair that can look at a target.

    Attributes
    ----------
    pair
        Its name.
    pan_rad, tilt_rad
        True joint angles that bring the target midway between the two pictures' middles; None for a pair on
        the body, which looks wherever the head is.
    range_m
        From the middle between the pair's cameras.
    range_error_m
        By eqs. (1) and (2), 3 sigma.
    outside
        Which bounds are broken, in words; empty for a pair that keeps them all.
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
) -> list[Choice]:
    """Return the pairs that can look at a position, the one that should first.

    Pairs that keep their bounds come first, the most accurate in front. Then those that see the target but
    break a bound, the shortest focal length in front: they serve where no other does.

    Parameters
    ----------
    rig
        Mast, cameras and pairs.
    position_m
        (3,) the target in the rover frame.
    limits
        Of the head; none by default.
    from_rad
        True pan and tilt of now, for the choice among solutions.
    chosen
        Chooses among them in place of ``limits``.

    Raises
    ------
    CalibError
        If no pair has the target well inside both pictures, with the reason for each.
    """
    rules = rules or HandoffRules()

    def within_limits(solutions: Sequence[Solution]) -> Solution:
        return choose(solutions, limits.pan_rad, limits.tilt_rad, *from_rad) if limits else solutions[0]

    choose_one = chosen or within_limits
    kept: list[tuple[float, Choice]] = []
    broken: list[tuple[float, Choice]] = []
    reasons: list[str] = []
    for name in rig.stereo:
        try:
            focal_px, choice = _looked_at(rig, name, position_m, rules, choose_one, from_rad)
        except (CalibError, KeptOut, NoWay) as error:
            reasons.append(f"{name}: {error}")
            continue
        (broken if choice.outside else kept).append((focal_px, choice))
    kept.sort(key=lambda one: one[1].range_error_m)
    broken.sort(key=lambda one: one[0])
    found = [choice for _, choice in (*kept, *broken)]
    if not found:
        place = ", ".join(f"{value:.2f}" for value in position_m)
        words = "; ".join(reasons) or "none is configured with both eyes"
        raise CalibError(f"no stereo pair sees the target at ({place}) m: {words}")
    return found


def _looked_at(
    rig: Rig,
    name: str,
    position_m: FloatArray,
    rules: HandoffRules,
    chosen: Chosen,
    from_rad: tuple[float, float],
) -> tuple[float, Choice]:
    """One pair's focal length and how it would look. Raises CalibError if it cannot."""
    eyes = rig.stereo[name]
    angles = None
    if rig.cameras[eyes[0]].on == "head":
        angles = _centred(rig, eyes, position_m, chosen, from_rad)
    left, right = (rig.camera_in_rover(eye, *(angles or (0.0, 0.0))) for eye in eyes)
    for eye, model in zip(eyes, (left, right), strict=True):
        _check_inside(eye, model, position_m, rules.margin_px)
    between = position_m - (left.C + right.C) / 2
    range_m = float(np.linalg.norm(between))
    steep_rad = math.asin(float(between[2]) / range_m)
    focal_px = float(np.linalg.norm(np.cross(left.A, left.H)))
    baseline_m = float(np.linalg.norm(right.C - left.C))
    error_m = stereo_range_error_m(range_m, focal_px, baseline_m, rules.disparity_error_px)
    bounds = rules.pairs.get(name, PairBounds())
    outside = []
    if range_m < bounds.nearest_m:
        outside.append(f"{range_m:.2f} m away, nearer than {bounds.nearest_m:g} m")
    if steep_rad > bounds.steepest_rad:
        outside.append(f"{steep_rad:.2f} rad below the horizontal, steeper than {bounds.steepest_rad:g} rad")
    if error_m > rules.range_error * range_m:
        outside.append(f"range error {error_m:.2f} m, more than {rules.range_error:g} of the range")
    pan_rad, tilt_rad = angles or (None, None)
    return focal_px, Choice(name, pan_rad, tilt_rad, range_m, error_m, "; ".join(outside))


def _centred(
    rig: Rig,
    eyes: tuple[str, str],
    position_m: FloatArray,
    chosen: Chosen,
    from_rad: tuple[float, float],
) -> tuple[float, float]:
    """Joint angles that put the target as far from the middle in the one eye as in the other.

    In the middle of one eye alone a near target may be outside the other's picture. Raises CalibError.
    """
    left, right = (rig.cameras[eye].model for eye in eyes)
    middle = np.array(left.image_center_px)
    aim = middle.copy()
    pan_rad, tilt_rad = from_rad
    for _ in range(CENTRING_STEPS):
        solutions = solve(
            rig.mast, left, position_m, aim, from_pan_rad=from_rad[0], from_tilt_rad=from_rad[1]
        )
        best = chosen(solutions)
        pan_rad, tilt_rad = best.pan_rad, best.tilt_rad
        in_right, seen = rig.camera_in_rover(eyes[1], pan_rad, tilt_rad).project(position_m)
        if not bool(seen):
            break  # the check of both pictures says so
        off = (np.array(right.image_center_px) - in_right - (aim - middle)) / 2
        aim = np.clip(aim + off, 0.0, np.array(left.size_px) - 1.0)
    return pan_rad, tilt_rad


def _check_inside(eye: str, model: CameraModel, position_m: FloatArray, margin_px: float) -> None:
    """Pass a camera that has a position well inside its picture. Raises CalibError."""
    pixel, seen = model.project(position_m)
    if not bool(seen):
        raise CalibError(f"{eye} has it behind itself or beyond what its lens images")
    if not model.holds(pixel, margin_px):
        width, height = model.size_px
        raise CalibError(
            f"{eye} has it at pixel ({pixel[0]:.0f}, {pixel[1]:.0f}), not {margin_px:g} px inside its "
            f"{width}x{height} px"
        )

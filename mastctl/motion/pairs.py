"""Which pair of cameras serves a target, at which joint angles; and where an image shows a point."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from calib.errors import CalibError
from calib.files.records import ABSENT, PathInFile, Record
from calib.geometry.cahvor import CameraModel
from calib.geometry.pointing import Solution, solve
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.geometry.stereo import stereo_range_error_m
from mastctl.devices.keep_out import KeptOut, Pair

CENTRING_STEPS = 3
"""Each solves exactly for one camera; the place in the other follows within a pixel after two."""
LEAST_ELLIPSE_PX = 0.05


class PairBounds(Record):
    """For which targets a pair serves; its range is that from the middle between its cameras."""

    nearest_m: Annotated[float, Field(ge=0.0, le=1000.0)] = Field(
        default=0.0, description="least range of the target"
    )
    steepest_rad: Annotated[float, Field(ge=0.0, le=math.pi / 2)] = Field(
        default=math.pi / 2, description="how far below the horizontal it looks at most"
    )


USUAL_BOUNDS = {"pancam": PairBounds(nearest_m=6.0), "navcam": PairBounds(nearest_m=2.0)}
"""The paper's ranges, of pairs that no configuration names."""


class HandoffRules(Record):
    """What decides between the pairs; at a range error of 0.2 a 640x480 Hazcam serves up to some 6 m."""

    pairs: dict[str, PairBounds] = Field(default={}, description="the pair for each range (Tracking)")
    margin_px: Annotated[float, Field(ge=0.0, le=1000.0)] = Field(
        default=30.0, description="the target lies so far inside both pictures"
    )
    disparity_error_px: Annotated[float, Field(ge=0.001, le=100.0)] = Field(
        default=1.0, description="of the paper's eq. (1)"
    )
    range_error: Annotated[float, Field(ge=0.001, le=10.0)] = Field(
        default=0.2, description="largest range error that a pair may have"
    )

    def bounds(self, pair: str) -> PairBounds:
        """Return for which targets a pair serves."""
        return self.pairs.get(pair) or USUAL_BOUNDS.get(pair, PairBounds())


USUAL_RULES = HandoffRules()


class TrackingSettings(Record):
    """What may be set about tracking.

    A tenth of the range is a usual step between two poses; with three tenths the target is seen so
    differently that a longer step is treated as a pose that jumped.
    """

    handoff: HandoffRules = HandoffRules()
    most_step: Annotated[float, Field(ge=0.01, le=1.0)] = Field(
        default=0.3, description="longest way between two poses"
    )
    start_error: Annotated[float, Field(ge=0.001, le=1.0)] = Field(
        default=0.1, description="greatest distance of the target from a given position"
    )
    handoff_log: PathInFile = Field(default=ABSENT, description="record of hand-offs")


@dataclass(frozen=True)
class PairChoice:
    """A pair that sees a target.

    At the true joint angles the target is midway between the two images' middles; None for a pair on the
    body, which the head does not turn. ``range_m`` is from the middle between the pair's cameras,
    ``range_error_m`` by eqs. (1) and (2), 3 sigma. ``outside`` says which bounds are broken; empty for none.
    """

    pair: str
    true_rad: Pair | None
    range_m: float
    range_error_m: float
    outside: str = ""


def choose_pairs(
    rig: Rig,
    position_m: FloatArray,
    rules: HandoffRules = USUAL_RULES,
    from_rad: Pair = (0.0, 0.0),
    chosen: Callable[[Sequence[Solution]], Solution] = lambda solutions: solutions[0],
) -> list[PairChoice]:
    """Return the pairs that see a position (3,) of the rover frame, the one that should take images first.

    Pairs that keep their bounds come first, the most accurate in front. Then those that see the target but
    break a bound, the shortest focal length in front: they serve where no other does. ``from_rad`` are the
    true pan and tilt of now; ``chosen`` chooses among the solutions for one aim.

    Raises CalibError if no pair has the target well inside both images, with the reason for each.
    """
    found: list[tuple[tuple[bool, float], PairChoice]] = []
    reasons: list[str] = []
    for name in rig.stereo:
        try:
            found.append(_choice_of(rig, name, position_m, rules, chosen, from_rad))
        except (CalibError, KeptOut) as error:
            reasons.append(f"{name}: {error}")
    if not found:
        place = ", ".join(f"{value:.2f}" for value in position_m)
        why = "; ".join(reasons) or "none is configured with both cameras"
        raise CalibError(f"no stereo pair sees the target at ({place}) m: {why}")
    return [choice for _, choice in sorted(found, key=lambda one: one[0])]


def _choice_of(
    rig: Rig,
    name: str,
    position_m: FloatArray,
    rules: HandoffRules,
    chosen: Callable[[Sequence[Solution]], Solution],
    from_rad: Pair,
) -> tuple[tuple[bool, float], PairChoice]:
    """How one pair would see the position, and its rank. Raises CalibError if it cannot."""
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
    rank = bool(outside), focal_px if outside else error_m
    return rank, PairChoice(name, angles, range_m, error_m, "; ".join(outside))


def _centred(
    rig: Rig,
    cameras: tuple[str, str],
    position_m: FloatArray,
    chosen: Callable[[Sequence[Solution]], Solution],
    from_rad: Pair,
) -> Pair:
    """Joint angles that put the target as far from the middle in the one camera as in the other.

    In the middle of one camera alone a near target may be outside the other's image. Raises CalibError.
    """
    left, right = (rig.cameras[camera].model for camera in cameras)
    middle = np.array(left.image_center_px)
    aim, start = middle.copy(), {"from_pan_rad": from_rad[0], "from_tilt_rad": from_rad[1]}
    for _ in range(CENTRING_STEPS):
        best = chosen(solve(rig.mast, left, position_m, aim, **start))
        in_right, seen = rig.camera_in_rover(cameras[1], best.pan_rad, best.tilt_rad).project(position_m)
        if not bool(seen):
            break  # the check of both images says so
        off = (np.array(right.image_center_px) - in_right - (aim - middle)) / 2
        aim = np.clip(aim + off, 0.0, np.array(left.size_px) - 1.0)
    return best.pan_rad, best.tilt_rad


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


def in_picture(camera: CameraModel, position_m: ArrayLike, covariance_m2: object) -> dict[str, float] | None:
    """Return the pixel of a point (3,), in the camera's frame, and one sigma of it as an ellipse.

    ``x_px``, ``y_px``, the half axes ``major_px``, ``minor_px``, and ``turn_rad`` of the major one, from x
    towards y; 0 where the covariance (3, 3) is not known. None if the camera does not show the point.
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

"""Whether two clicks mean one point: the gap between their rays against what explains a gap.

Two rays have four coordinates and a point three: what is left over, how far the rays pass each other, is one
number that is zero but for noise. Its variance follows from that of the clicks, which takes in whatever is
uncertain about the rig (`calib.mast.rig_rates.click_covariance`); its square over that is chi-square with one
degree of freedom. Along the epipolar line nothing can be told: there every pixel is a point at another range.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib.camera.stereo import Triangulation, triangulate
from calib.errors import NoStereoPoint
from calib.mast.covariance import RigCovariance
from calib.mast.rig import Rig
from calib.mast.rig_rates import click_covariance
from calib.rigid import FloatArray

FALSE_ALARMS = 0.001
"""Chance that two clicks of one point are refused, if all stated sigmas are right."""

MOST_SIGMAS = 3.2905
"""Beyond it a normal error is, either side, in that part of cases."""

RIG_PX = 1.0
"""One sigma, each pixel coordinate, of what a camera is taken to be wrong by whose errors its rig does not
tell: the residuals of the paper's mast calibration are 0.85 to 1.13 px rms."""


@dataclass(frozen=True)
class RayGap:
    """How far two rays pass each other, and how far that is from what explains it.

    Attributes
    ----------
    gap_m, sigma_m
        The length of the rays' common normal, and one sigma of it.
    across_px, across_sigma_px
        The same in the right picture: how far its pixel is off the line on which the left one's ray lies.
    """

    gap_m: float
    sigma_m: float
    across_px: float
    across_sigma_px: float

    @property
    def sigmas(self) -> float:
        """The gap in standard deviations; infinite if it has none."""
        return self.gap_m / self.sigma_m if self.sigma_m > 0.0 else math.inf if self.gap_m > 0.0 else 0.0


def ray_gap(seen: Triangulation, clicks_px2: FloatArray) -> RayGap:
    """Return the gap of a triangulation with its sigma; ``clicks_px2`` (4, 4) is the clicks' covariance."""
    rates = seen.gap_m_per_px
    sigma_m = math.sqrt(max(float(rates @ clicks_px2 @ rates), 0.0))
    per_right_px = float(np.linalg.norm(rates[2:]))
    return RayGap(seen.ray_gap_m, sigma_m, seen.ray_gap_m / per_right_px, sigma_m / per_right_px)


def silent_cameras(pair: tuple[str, str], calibration: RigCovariance | None) -> tuple[str, ...]:
    """Return the cameras of a pair of whose errors a rig's covariance says nothing: all if there is none."""
    names = calibration.names if calibration else ()
    return tuple(one for one in pair if not any(name.startswith(f"cameras.{one}.") for name in names))


def refuse_two_points(gap: RayGap, pair: tuple[str, str], by: str) -> None:
    """Refuse two clicks whose rays pass each other farther than their noise explains.

    Parameters
    ----------
    gap
        As `ray_gap` gives it.
    pair
        The cameras' names, left first.
    by
        What was taken to explain a gap, in words.

    Raises
    ------
    NoStereoPoint
        ``not_one_point``.
    """
    if gap.sigmas <= MOST_SIGMAS:
        return
    raise NoStereoPoint(
        "not_one_point",
        f"the two pixels do not mean one point: their rays pass each other at {1e3 * gap.gap_m:.3g} mm, "
        f"{gap.sigmas:.1f} sigma; the pixel of {pair[1]} is {gap.across_px:.1f} px off the epipolar line of "
        f"that of {pair[0]}, where {by} explain {MOST_SIGMAS * gap.across_sigma_px:.1f} px at most",
    )


def clicked_point(
    rig: Rig,
    pair: tuple[str, str],
    pan_rad: float,
    tilt_rad: float,
    left_px: ArrayLike,
    right_px: ArrayLike,
    *,
    sigma_px: float = 0.2,
    sigma_rad: float = 0.0,
    calibration: RigCovariance | None = None,
) -> tuple[Triangulation, RayGap]:
    """Return the point that two clicks in a pair's pictures mean, rover frame, and the gap of its rays.

    Parameters
    ----------
    rig, pair, pan_rad, tilt_rad
        Who sees it, left camera first, and the joint readings.
    left_px, right_px
        (2,) clicks.
    sigma_px, sigma_rad
        Of each pixel coordinate of a click, and of each joint reading.
    calibration
        Covariance of the rig. A camera of which it says nothing is taken to be wrong by ``RIG_PX``.

    Raises
    ------
    NoStereoPoint
        As `calib.camera.stereo.triangulate`, and ``not_one_point``.
    """
    for name, pixel in zip(pair, (left_px, right_px), strict=True):
        if np.shape(pixel) != (2,):
            raise NoStereoPoint(
                "bad_pixel", f"a pixel of {name} of shape {np.shape(pixel)} where (2,) is expected"
            )
    left, right = (rig.camera_in_rover(name, pan_rad, tilt_rad) for name in pair)
    seen = triangulate(left, right, left_px, right_px, sigma_px)
    allowed = click_covariance(
        rig, pair, pan_rad, tilt_rad, seen.position_m,
        sigma_px=sigma_px, sigma_rad=sigma_rad, calibration=calibration,
    )  # fmt: skip
    unknown = silent_cameras(pair, calibration)
    allowed += np.diag(np.repeat([RIG_PX**2 if name in unknown else 0.0 for name in pair], 2))
    gap = ray_gap(seen, allowed)
    by = f"clicks good to {sigma_px:g} px and " + ("the mast file's covariance" if calibration else "the rig")
    if calibration and unknown:
        by += f", which knows nothing of {' and '.join(unknown)},"
    refuse_two_points(gap, pair, by)
    return seen, gap

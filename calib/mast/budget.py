"""The error budget of a target approach: Table I of the paper from its equations (1) to (4).

All errors are 3 sigma. The printed cells come from a pixel of 4.65 µm for all three cameras, the Hazcam being
taken at the others' 1024 x 768 pixels. The text's 4.69 µm does not give them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

PIXEL_M = 4.65e-6


@dataclass(frozen=True)
class StereoPair:
    """A stereo pair as the budget sees it: focal length and baseline, metres."""

    name: str
    focal_m: float
    baseline_m: float


@dataclass(frozen=True)
class BudgetRow:
    """One row of Table I: 3-sigma errors in centimetres.

    Attributes
    ----------
    name
        The camera at the start of the approach.
    stereo_cm
        Stereo range error where the approach starts, eq. (1).
    untracked_cm
        Where the target is after the approach without visual tracking, eq. (3).
    tracked_cm
        The same with ideal tracking and hand-off down to the last camera, eq. (4).
    """

    name: str
    stereo_cm: float
    untracked_cm: float
    tracked_cm: float


PAPER_PAIRS = (
    StereoPair("pancam", 16.0e-3, 0.30),
    StereoPair("navcam", 6.0e-3, 0.20),
    StereoPair("hazcam", 2.3e-3, 0.10),
)


def stereo_range_error_m(
    range_m: float, focal_px: float, baseline_m: float, disparity_error_px: float
) -> float:
    """Return R² Δd / (f B), the range error of a stereo pair, eq. (1); metres."""
    return range_m * range_m / (focal_px * baseline_m) * disparity_error_px


def target_approach_budget(
    pairs: tuple[StereoPair, ...] = PAPER_PAIRS,
    *,
    pixel_m: float = PIXEL_M,
    start_m: float = 10.0,
    end_m: float = 1.0,
    disparity_error_px: float = 1.0,
    odometry_error: float = 0.02,
) -> tuple[BudgetRow, ...]:
    """Return the rows of Table I, one for each pair as the one the approach starts with.

    Parameters
    ----------
    pairs
        From the longest focal length to the shortest; the last is the one that places the instrument.
    pixel_m
        Pixel size, metres; with the focal length it gives the focal length in pixels, eq. (2).
    start_m, end_m
        Distance to the target before and after the approach.
    disparity_error_px
        3-sigma disparity error of stereo at the start.
    odometry_error
        3-sigma navigation error as a part of the distance travelled; the paper takes 2 % of start_m.

    Notes
    -----
    While the target grows from start_m to end_m its place in the image is known no better than the first
    pixel was. The paper takes half of that growth as the disparity error at the end: ±5 pixels for 10 m to
    1 m. A hand-off scales it by the ratio of focal lengths, so that the focal length of the first camera
    stays in eq. (4) and the baseline is the last camera's.
    """
    grown_error_px = 0.5 * disparity_error_px * start_m / end_m
    last = pairs[-1]
    rows = []
    for pair in pairs:
        focal_px = pair.focal_m / pixel_m
        stereo_m = stereo_range_error_m(start_m, focal_px, pair.baseline_m, disparity_error_px)
        untracked_m = math.hypot(stereo_m, odometry_error * start_m)
        tracked_m = stereo_range_error_m(end_m, focal_px, last.baseline_m, grown_error_px)
        rows.append(BudgetRow(pair.name, 100.0 * stereo_m, 100.0 * untracked_m, 100.0 * tracked_m))
    return tuple(rows)

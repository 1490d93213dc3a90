"""What the pointing loop returns: steps, pointings with their residuals, and how a request fails."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray
from drivers.errors import DriverError
from drivers.interfaces import AxisReport
from mastctl.errors import MastctlError

Pair = tuple[float, float]


@dataclass(frozen=True)
class Step:
    """One step of an operation, for the record: what it was, how it ended, when, and its numbers.

    ``detail`` holds plain values with units in their names; of a failed step also ``code`` and ``message``.
    """

    name: str
    state: Literal["done", "failed"]
    started_s: float
    duration_s: float
    detail: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Pointing:
    """One pointing and what was measured after it.

    Attributes
    ----------
    commanded_pan_rad, commanded_tilt_rad, measured_pan_rad, measured_tilt_rad
        Joint angles that were sent, and those measured at the new image's mid-exposure: as the head reads
        them.
    true_pan_rad, true_tilt_rad
        The true angles then, by the mast file's joints.
    camera, frame_id
        The new image: exposed after the head had settled.
    aim_px
        (x, y) where the target was wanted; None for joint angles.
    predicted_px
        (x, y) where target position, mast file and measured joint angles put it; None if out of view.
    target_px
        (x, y) where the image shows it; None where nothing was clicked that could be found again.
    residual_px, residual_sigma_px
        target_px - aim_px, and one sigma of the match; None as above.
    predicted_sigma_px, predicted_covariance_px2
        One sigma of x and y of ``predicted_px``, and the whole (2, 2), of what one camera alone knows: the
        range, mast file, joint readings. None where a pair measured.
    note
        One sentence that says why there is no residual; empty otherwise.
    motion_evidence
        By camera of the new images: whether they moved as the joints did, as a ``verdict`` with numbers; of
        the one that measured also how a later image repeated it (`mastctl.motion.evidence`).
    """

    commanded_pan_rad: float
    commanded_tilt_rad: float
    measured_pan_rad: float
    measured_tilt_rad: float
    true_pan_rad: float
    true_tilt_rad: float
    camera: str = ""
    frame_id: str = ""
    aim_px: Pair | None = None
    predicted_px: Pair | None = None
    target_px: Pair | None = None
    residual_px: Pair | None = None
    residual_sigma_px: Pair | None = None
    predicted_sigma_px: Pair | None = None
    predicted_covariance_px2: tuple[Pair, Pair] | None = None
    note: str = ""
    motion_evidence: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class PointingResult:
    """What came of a request: position in the rover frame, range from the aim camera, the pointings.

    ``position_m`` and ``range_m`` are those of the last pointing, None for joint angles.

    ``range_from``: what says how far the target is: ``stereo``; ``given``, ``plane``, ``parallax`` or
    ``unknown`` with one camera; empty where nothing was clicked; ``range_interval_m``: with one camera, the
    ranges that are 95 % likely after the last image; the farther is None for infinity.
    """

    position_m: tuple[float, float, float] | None
    range_m: float | None
    pointings: tuple[Pointing, ...]
    range_from: str = ""
    range_interval_m: tuple[float, float | None] | None = None


class PointingError(MastctlError):
    """The request failed; the daemon stopped the mast.

    The four verdicts of a search for the target that found none:

    ``target_flat``: The image around the target has too little texture, or texture along one direction only.

    ``target_ambiguous``: A second place in the image fits nearly as well as the target.

    ``target_border``: The target lies at the border of an image or of the search window.

    ``target_not_found``: No place in the search window fits the target: hidden, changed, or at another range.

    Attributes
    ----------
    code
        For programs. Own codes: ``stopped``, ``outside_image``, ``no_stereo``, ``head_fault``,
        ``head_moving``, ``bad_reading``, ``no_fresh_frame``, ``did_not_arrive``, ``did_not_settle``,
        ``not_in_view``, ``target_flat``, ``target_ambiguous``, ``target_border``, ``target_not_found``,
        ``target_moving``, ``eyes_disagree``, ``off_the_line``, ``not_repeated``. That of a request that does
        not fit (`mastctl.motion.requests`), of a driver, of the limits or of the geometry passes through.
    step
        The step that failed.
    result
        The pointings done before it, None if there were none.
    """

    def __init__(self, code: str, message: str, step: str = "", result: PointingResult | None = None) -> None:
        self.code = code
        self.step = step
        self.result = result
        super().__init__(message)

    @property
    def detail(self) -> dict[str, str]:
        """The failed step, for the error's detail."""
        return {"step": self.step}


def pair(values: FloatArray) -> Pair:
    """Return (2,) as plain floats."""
    return float(values[0]), float(values[1])


def triple(values: FloatArray) -> tuple[float, float, float]:
    """Return (3,) as plain floats."""
    return float(values[0]), float(values[1]), float(values[2])


def rounded(values: FloatArray | Pair, digits: int = 4) -> list[float]:
    """Return numbers for a step's detail."""
    return [round(float(value), digits) for value in np.asarray(values).ravel()]


def counts_left(devices: object, tilt_rad: float, model: CameraModel | None) -> dict[str, Any]:
    """Return ``counts``: goal, measured count and what is left between command and measurement, by axis.

    A head that fails to answer has ``counts_missing`` instead, which says why; one without ``report`` (see
    `drivers.interfaces.PanTilt`) nothing.

    ``tilt_rad``: where the head is: a pan turns the image of a head that looks up less; ``model``: the aiming
    camera, for the pixels; None for joint angles alone.
    """
    report = getattr(devices, "report", None)
    try:
        axes: dict[str, AxisReport] = dict(report()) if report is not None else {}
    except DriverError as error:
        return {"counts_missing": str(error)}
    counts: dict[str, dict[str, Any]] = {}
    for name, axis in axes.items():
        one: dict[str, Any] = {"goal_counts": axis.goal_counts, "measured_counts": axis.measured_counts}
        counts[name] = one
        one["came_from"] = axis.side
        if axis.count_rad is not None:
            one["count_rad"] = axis.count_rad
        if axis.left_rad is None:
            continue
        one["left_rad"] = round(axis.left_rad, 7)
        if model is not None:
            # Yakimovsky and Cunningham (1978): the focal lengths of columns and rows
            focal_px = model.focal_px[0 if name == "pan" else 1]
            share = math.cos(tilt_rad) if name == "pan" else 1.0
            left_px = axis.left_px(focal_px)
            one["left_px"] = None if left_px is None else round(share * left_px, 3)
    return {"counts": counts} if counts else {}

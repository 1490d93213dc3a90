"""Whether to trust a bench's calibration, and why: a few tests, each one sentence."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calib.adjust.result import BenchCalibration
from calib.errors import CalibError
from calib.geometry.covariance import RigCovariance
from calib.geometry.significance import Level
from calib.plan.knowledge import Knowledge, Workspace, pointing
from calib.survey.records import Survey
from mastctl.calibration.verdict import (
    MANY_LEFT_OUT,
    POINTING_BAD_PX,
    POINTING_GOOD_PX,
    CalibrationVerdict,
    Grade,
    Reason,
    chi_square_grade,
    contradiction_reasons,
    sigma_reasons,
)

LITTLE = 0.2
"""Corners that are off by less than this part of ``corner_px`` are no reason for doubt."""


def judge_bench(survey: Survey, calibration: BenchCalibration) -> CalibrationVerdict:
    """Return whether to trust a bench's calibration; the worst of the reasons decides."""
    reasons = [
        *_noise(survey, calibration),
        *(Reason("care", note) for note in calibration.notes if " moved during placement " in note),
        *_inexact(survey, calibration),
        *_placements(calibration),
        *contradiction_reasons(calibration),
        *_drifts(calibration),
        *_checks(calibration),
        *(Reason("bad", direction.sentence) for direction in calibration.degenerate),
        *_pointing(calibration),
        *_left_out(calibration),
    ]
    grades = {reason.grade for reason in reasons}
    grade: Grade = "bad" if "bad" in grades else "care" if "care" in grades else "good"
    return CalibrationVerdict(grade, tuple(reasons))


def predicted_pointing_px(calibration: BenchCalibration) -> tuple[float, float] | None:
    """Return what a first pointing is off by, rms px an axis: by the calibration, and by readings alone.

    Over the angles at which boards were seen, targets at 2, 6 and 10 m, clicked in the first pair of the head
    (or its first camera, the range told). None if nothing can be pointed at.
    """
    rig = calibration.rig
    on_head = [name for name, camera in rig.cameras.items() if camera.on == "head"]
    pair = next((pair for pair in rig.stereo.values() if set(pair) <= set(on_head)), None)
    readings = np.array([(i.pan_rad, i.tilt_rad) for i in calibration.images if i.camera in on_head])
    (low_pan, low_tilt), (high_pan, high_tilt) = readings.min(axis=0).tolist(), readings.max(axis=0).tolist()
    known = Knowledge(rig, {}, calibration.joint_rad)
    where = Workspace(pair or (on_head[0],), (low_pan, high_pan), (low_tilt, high_tilt))
    try:
        landings = pointing(known, where)
    except CalibError:
        return None
    covariance = RigCovariance(calibration.parameter_names, calibration.covariance).among(known.names)
    return landings.rms_px(covariance), landings.by_counts_px(calibration.joint_rad)


def _noise(survey: Survey, calibration: BenchCalibration) -> Iterator[Reason]:
    """Whether the residuals are what the stated sigmas make them."""
    freedom = max(calibration.degrees_of_freedom, 1.0)
    factor = float(np.sqrt(calibration.chi2 / freedom))
    words = (
        f"chi-square is {calibration.chi2:.0f} for {freedom:.0f} degrees of freedom: the residuals are "
        f"{factor:.2f} times what the stated sigmas make them"
    )
    yield Reason(chi_square_grade(calibration, factor), words)
    yield from sigma_reasons(survey, calibration)


def _inexact(survey: Survey, calibration: BenchCalibration) -> Iterator[Reason]:
    """Whether corners are where the board's measures and the lenses have them, but for noise."""
    if calibration.inexact_m > 0.0:
        off_px = calibration.inexact_m * float(
            np.median(
                [calibration.rig.cameras[i.camera].model.focal_px[0] / i.range_m for i in calibration.images]
            )
        )
        yield Reason(
            "care" if off_px > LITTLE * survey.sigma.corner_px else "good",
            f"corners are off by some {1e3 * calibration.inexact_m:.2g} mm on the board, each alike in all "
            "pictures: an inexact print. They count with that, but since it is the same in every picture, "
            "uncertainties are rather too small",
        )


def _placements(calibration: BenchCalibration) -> Iterator[Reason]:
    """Whether boards stood at places enough."""
    if len(calibration.rover_from_board) < 2:
        yield Reason(
            "care",
            "all pictures show one placement: how far off things are hangs on one board at one distance; "
            "put it up once more, at another distance and turned by some 30 degrees",
        )


def _drifts(calibration: BenchCalibration) -> Iterator[Reason]:
    """Whether joints and cameras stayed what they were."""
    for drift in calibration.drifts:
        if drift.chance < Level.STATED:
            yield Reason("bad" if drift.size_px > POINTING_GOOD_PX else "care", drift.sentence)


def _checks(calibration: BenchCalibration) -> Iterator[Reason]:
    """Whether pictures that were not fitted are predicted as well as they should be."""
    lost = {
        image.name: int((~np.isfinite(image.residuals_px).all(axis=1)).sum())
        for image in calibration.images
        if image.purpose == "check"
    }
    for name, count in lost.items():
        if count:
            words = f"check picture {name} shows {count} corners where its camera, as fitted, has no pixel"
            yield Reason("bad", words)
    if not (calibration.check_rms_px or any(lost.values())):
        yield Reason("care", "there is no check picture: nothing shows how well the result predicts")
    for camera, (seen, expected, most, _) in calibration.checks.items():
        yield Reason(
            "good" if seen <= most else "bad",
            f"check pictures of {camera} are off by {seen:.2f} px rms an axis where {expected:.2f} are "
            f"expected; more than {most:.2f} would be bad",
        )


def _pointing(calibration: BenchCalibration) -> Iterator[Reason]:
    """How much the calibration adds to a pointing from a click."""
    predicted = predicted_pointing_px(calibration)
    if predicted is None:
        yield Reason("care", "pointing at 2 to 10 m is not possible at the angles at which boards were seen")
        return
    by_rig, by_counts = predicted
    good = max(POINTING_GOOD_PX, by_counts)
    grade: Grade = (
        "good" if by_rig <= good else "care" if by_rig <= max(POINTING_BAD_PX, by_counts) else "bad"
    )
    words = f"a first pointing is uncertain by {by_rig:.2f} px an axis from calibration"
    if by_counts > 0.0:
        words += f", by {by_counts:.2f} from what a reading says"
    yield Reason(grade, words)


def _left_out(calibration: BenchCalibration) -> Iterator[Reason]:
    """Whether too much was rejected."""
    fitted = [image for image in calibration.images if image.purpose != "check"]
    corners = sum(len(image.used) for image in fitted)
    too_many = False
    for kind, word, count in (("dot", "corners", corners), ("image", "pictures", len(fitted))):
        left = sum(outlier.kind == kind for outlier in calibration.outliers)
        if left > MANY_LEFT_OUT * max(count, 1):
            too_many = True
            yield Reason("care", f"{left} of {count} {word} were left out; look for the cause")
    if calibration.outliers and not too_many:
        yield Reason("good", f"{len(calibration.outliers)} measurements were left out, each named")

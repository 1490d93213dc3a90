"""Whether to trust a calibration, by a survey or on the bench, and why: a few tests, each one sentence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import takewhile

import numpy as np
from scipy.spatial.transform import Rotation

from calib.adjust.result import BenchCalibration, Calibration, FittedRig, ImageResiduals
from calib.errors import CalibError
from calib.geometry.significance import Level
from calib.survey.records import Survey, SurveyFinding
from mastctl.calibration.checks import exchanged_boards
from mastctl.calibration.landing import POINTING_RANGE_M, expected_pointing, pointing_sigma_px
from mastctl.calibration.reasons import CalibrationVerdict, Grade, Reason
from mastctl.calibration.sigmas import chi_square_reason, sigma_reasons

POINTING_GOOD_PX = 0.5
POINTING_BAD_PX = 2.0
"""Rms per axis that the calibration alone may add to pointing at a click; the paper reached 1.3 in all."""

MANY_LEFT_OUT = 0.05
"""Share of dots or images left out above which the survey itself is in doubt."""

TURNED_RAD = 2.0
"""A mast turned further against the rover is one whose joints count the other way."""

PAPER_GOOD_PX = 2.0
"""Rms of fitted images that the paper's method may leave: station errors of 2 mm are 1.4 px at 5 m."""

ODD_IMAGE = 6.0
"""An image this many times farther off than others of its camera and purpose; good surveys reach 3.4."""

FEW_IMAGES = 4

LITTLE = 0.2
"""Corners that are off by less than this part of ``corner_px`` are no reason for doubt."""


def judge(
    survey: Survey,
    fit: Calibration | BenchCalibration,
    warnings: Sequence[SurveyFinding] = (),
    undetected: Sequence[str] = (),
    jointly: Calibration | CalibError | None = None,
) -> CalibrationVerdict:
    """Return whether to trust a calibration.

    Parameters
    ----------
    survey
        With the dots or corners that were fitted.
    fit
        The result.
    warnings
        The warnings of the survey's check. What the joint fit tests again, finer, is left to its tests.
    undetected
        Names of images in which no dots were found.
    jointly
        The joint fit of a survey that was calibrated by the paper's method, which has no tests of its own; or
        why there is none.
    """
    own = (
        _of_survey(survey, fit, warnings, undetected, jointly)
        if isinstance(fit, Calibration)
        else _of_bench(survey, fit)
    )
    return CalibrationVerdict.by(
        [
            *_noise(survey, fit),
            *_contradictions(fit),
            *_checks(fit),
            *(Reason("bad", direction.sentence) for direction in fit.degenerate),
            *own,
            *_left_out(fit),
        ]
    )


def _of_survey(
    survey: Survey,
    fit: Calibration,
    warnings: Sequence[SurveyFinding],
    undetected: Sequence[str],
    jointly: Calibration | CalibError | None,
) -> Iterator[Reason]:
    """The reasons that only a survey has."""
    yield from _wider(fit)
    yield from _jointly(survey, jointly)
    yield from _odd_images(fit)
    yield from _turned(fit)
    yield from _pointing_of_pairs(fit)
    yield from _at_the_end(fit)
    yield from (Reason("care", sentence) for sentence in exchanged_boards(survey, fit))
    if undetected:
        yield Reason("care", f"no dots were found in {len(undetected)} images: {_some(undetected)}")
    joint = np.isfinite(fit.chi2_probability)
    if count := sum(not (joint and warning.tested_again) for warning in warnings):
        yield Reason("care", f"the check of the survey warned {count} times")


def _of_bench(survey: Survey, fit: BenchCalibration) -> Iterator[Reason]:
    """The reasons that only a bench has."""
    yield from (Reason("care", note) for note in fit.notes if " moved during placement " in note)
    yield from _inexact(survey, fit)
    if len(fit.rover_from_board) < 2:
        yield Reason(
            "care",
            "all images show one placement: how far off things are hangs on one board at one distance; "
            "put it up once more, at another distance and turned by some 30 degrees",
        )
    for drift in fit.drifts:
        if drift.chance < Level.STATED:
            yield Reason("bad" if drift.size_px > POINTING_GOOD_PX else "care", drift.sentence)
    yield _pointing_of_workspace(fit)


def _noise(survey: Survey, fit: Calibration | BenchCalibration) -> list[Reason]:
    """Whether the residuals are what the stated sigmas make them."""
    if isinstance(fit, BenchCalibration) or np.isfinite(fit.chi2_probability):
        return [chi_square_reason(fit), *sigma_reasons(survey, fit), *_no_more_than_stated(fit)]
    worst_px, camera = max((max(xy), name) for name, xy in fit.rms_px.items())
    sentence = f"the largest residual of the fitted images is {worst_px:.2f} px rms ({camera})"
    if worst_px > PAPER_GOOD_PX:
        upright = fit.mast_parameters == 4
        why = "the mast is not upright: use --mast 6" if upright else "station and boards do not agree"
        return [Reason("bad", f"{sentence}: {why}")]
    return [Reason("good", f"{sentence}, within what station errors of some mm leave")]


def _no_more_than_stated(fit: FittedRig) -> list[Reason]:
    known = [c for c in fit.components if np.isfinite(c.factor)]
    if not known or any(c.wrong for c in fit.components):
        return []
    most = max(known, key=lambda c: c.factor)
    sentence = (
        f"each kind of measurement scatters no more than stated, most of all {most.kind}: "
        f"{most.factor:.2f} ± {most.factor_sigma:.2f} times their sigma"
    )
    return [Reason("good", sentence)]


def _wider(fit: Calibration) -> list[Reason]:
    """Whether the residuals ask for a wider model than the one that was fitted."""
    if not fit.wider:
        return []
    needed = [model for model in fit.wider if model.significant]
    if not needed:
        first = min(fit.wider, key=lambda model: model.chance)
        sentence = (
            f"no wider model out of {len(fit.wider)} would gain more than chance makes likely; most "
            f"does {first.name}, {first.gain:.1f} in chi-square with {first.numbers} numbers"
        )
        return [Reason("good", sentence)]
    first, *others = needed
    grade: Grade = "bad" if first.size_px > POINTING_GOOD_PX else "care"
    more = "one more number" if first.numbers == 1 else f"{first.numbers} more numbers"
    reasons = [Reason(grade, f"{more} would gain {first.gain:.0f} in chi-square: {first.sentence}")]
    if others:
        names = _some([f"{model.name} ({model.gain:.0f} with {model.numbers})" for model in others])
        reasons.append(Reason("care", f"other terms that would gain, perhaps by the same cause: {names}"))
    return reasons


def _contradictions(fit: FittedRig) -> list[Reason]:
    """Whether placements agree with one another."""
    placements = fit.contradictions
    odd = [one for one in placements if one.significant]
    if len(placements) == 2:  # either contradicts the other
        odd = odd[:1]
    if placements and not odd:
        first = placements[0]
        agree = (
            f"each of {len(placements)} placements says what the others say of cameras, axes and joints; "
            f"{first.name} differs most, chi-square {first.gain:.0f} for {first.numbers} numbers"
        )
        return [Reason("good", agree)]
    return [Reason("care", one.sentence) for one in odd]


def _jointly(survey: Survey, fit: Calibration | CalibError | None) -> list[Reason]:
    """What the joint fit's tests say of a survey that another method calibrated."""
    if fit is None:
        return []
    if isinstance(fit, CalibError):
        untested = "whether sigmas and model are right was not tested"
        return [Reason("care", f"{untested}, since the survey cannot be fitted jointly: {fit}")]
    reasons = [*sigma_reasons(survey, fit), *_wider(fit), *_contradictions(fit)]
    return [replace(reason, sentence=f"fitted jointly, {reason.sentence}") for reason in reasons]


def _odd_images(fit: Calibration) -> list[Reason]:
    """Images that the paper's method kept, though they are far from the others (joint tests each of them)."""
    if np.isfinite(fit.chi2_probability) or fit.mast_parameters == 4:
        return []
    groups: dict[tuple[str, str], list[tuple[float, str]]] = {}
    for image in fit.images:
        if image.purpose != "check" and image.used.any():
            rms_px = float(np.sqrt(np.mean(image.residuals_px[image.used] ** 2)))
            groups.setdefault((image.camera, image.purpose), []).append((rms_px, image.name))
    reasons = []
    for group in groups.values():
        usual = float(np.median([rms_px for rms_px, _ in group]))
        odd = [(rms_px, name) for rms_px, name in group if rms_px > ODD_IMAGE * usual]
        if len(group) >= FEW_IMAGES and odd:
            rms_px, name = max(odd)
            off = f"image {name} is off by {rms_px:.2f} px rms where others like it are by {usual:.2f}"
            reasons.append(Reason("care", f"{off}: check its tapes, its angles and its dots"))
    return reasons


def _checks(fit: Calibration | BenchCalibration) -> list[Reason]:
    """Whether images that were not fitted are predicted as well as they should be."""
    reasons = [
        Reason("bad", f"check image {image.name} cannot show placement {image.placement}, which it names")
        for image in fit.images
        if image.purpose == "check" and not np.isfinite(image.residuals_px).all()
    ]
    reasons += [
        Reason(
            "bad",
            f"image {click.image} cannot show check point {click.point}, which was clicked in it: correct "
            "its row in clicks.csv or the point's in station.csv",
        )
        for click in (fit.unseen_clicks if isinstance(fit, Calibration) else ())
    ]
    if not (fit.check_rms_px or reasons):
        return [Reason("care", "there is no check image: nothing shows how well the result predicts")]
    for camera, size in fit.checks.items():
        sentence = (
            f"check images of {camera} are off by {size.seen_px:.2f} px rms an axis where "
            f"{size.expected_px:.2f} are expected; more than {size.most_px:.2f} would be bad"
        )
        reasons.append(Reason("good" if size.seen_px <= size.most_px else "bad", sentence))
    return reasons


def _turned(fit: Calibration) -> list[Reason]:
    """Whether the mast is turned about: a tilt that counts down fits as well, with the head half a turn off.

    `calib.survey.diagnoses` mostly refuses such a survey before.
    """
    angle = float(np.linalg.norm(Rotation.from_euler("XYZ", fit.rig.mast.rotation_rad).as_rotvec()))
    if angle < TURNED_RAD:
        return []
    turned = f"the mast comes out turned by {np.degrees(angle):.0f} degrees against the rover"
    return [Reason("bad", f"{turned}: pan or tilt has the wrong sign (right and up are positive)")]


def _inexact(survey: Survey, fit: BenchCalibration) -> Iterator[Reason]:
    """Whether corners are where the board's measures and the lenses have them, but for noise."""
    if fit.inexact_m > 0.0:
        off_px = fit.inexact_m * float(
            np.median([fit.rig.cameras[i.camera].model.focal_px[0] / i.range_m for i in fit.images])
        )
        yield Reason(
            "care" if off_px > LITTLE * survey.sigma.corner_px else "good",
            f"corners are off by some {1e3 * fit.inexact_m:.2g} mm on the board, each alike in all "
            "images: an inexact print. They count with that, but since it is the same in every image, "
            "uncertainties are rather too small",
        )


def _pointing_of_pairs(fit: Calibration) -> list[Reason]:
    """How much the calibration alone adds to a pointing from a click, pair by pair."""
    reasons = []
    for pair, names in fit.rig.stereo.items():
        if fit.rig.cameras[names[0]].on != "head":
            continue
        sigma = pointing_sigma_px(fit, names)
        if sigma is None:
            reasons.append(Reason("care", f"pointing by {pair} at {POINTING_RANGE_M:g} m is not possible"))
            continue
        near_corner = f"pointing {pair} at what was clicked near a corner at {POINTING_RANGE_M:g} m"
        sentence = f"{near_corner} is uncertain by {sigma:.2f} px an axis from calibration alone"
        reasons.append(Reason(_pointing_grade(sigma), sentence))
    return reasons


def _pointing_of_workspace(fit: BenchCalibration) -> Reason:
    """How much the calibration adds to a pointing from a click, beside what a reading adds."""
    expected = expected_pointing(fit)
    if expected is None:
        return Reason("care", "pointing at 2 to 10 m is not possible at the angles at which boards were seen")
    landings, covariance = expected
    by_rig, by_counts = landings.rms_px(covariance), landings.by_counts_px(fit.joint_rad)
    sentence = f"a first pointing is uncertain by {by_rig:.2f} px an axis from calibration"
    if by_counts > 0.0:
        sentence += f", by {by_counts:.2f} from what a reading says"
    return Reason(_pointing_grade(by_rig, by_counts), sentence)


def _pointing_grade(by_rig_px: float, by_counts_px: float = 0.0) -> Grade:
    if by_rig_px <= max(POINTING_GOOD_PX, by_counts_px):
        return "good"
    return "care" if by_rig_px <= max(POINTING_BAD_PX, by_counts_px) else "bad"


def _left_out(fit: Calibration | BenchCalibration) -> list[Reason]:
    """Whether too much was rejected."""
    fitted = [image for image in fit.images if image.purpose != "check"]
    dots = sum(len(image.used) for image in fitted)
    points = "dots" if isinstance(fit, Calibration) else "corners"
    reasons = []
    for kind, name, count in (("dot", points, dots), ("image", "images", len(fitted))):
        left = sum(outlier.kind == kind for outlier in fit.outliers)
        if left > MANY_LEFT_OUT * max(count, 1):
            reasons.append(Reason("care", f"{left} of {count} {name} were left out; look for the cause"))
    prisms, tapes = ([o.name for o in fit.outliers if o.kind == kind] for kind in ("prism", "tape"))
    station = fit.station if isinstance(fit, Calibration) else ()
    if prisms or len(tapes) > MANY_LEFT_OUT * sum(point.kind == "tape" for point in station):
        reasons.append(Reason("care", f"measure again: {_some([*prisms, *tapes])}"))
    if not reasons and fit.outliers:
        reasons.append(Reason("good", f"{len(fit.outliers)} measurements were left out, each named"))
    return reasons


def _at_the_end(fit: Calibration) -> list[Reason]:
    """Whether the last images of a camera were left out: what changed before them still holds, unnoticed.

    Were they kept, the fit would test such a change; an image that was left out takes its evidence along.
    """
    fitted: dict[str, list[ImageResiduals]] = {}
    for image in fit.images:
        if image.purpose != "check":
            fitted.setdefault(image.camera, []).append(image)
    reasons = []
    for camera, images in fitted.items():
        last = list(takewhile(lambda image: not image.used.any(), reversed(images)))
        if 0 < len(last) < len(images):
            left_out = f"the last {len(last)} of {len(images)} images of {camera} were left out"
            if len(last) == 1:
                left_out = f"the last of {len(images)} images of {camera} was left out"
            since = f"if focus, mount or a joint changed before {last[-1].name}, the result is of before"
            reasons.append(Reason("care", f"{left_out}: {since}; take some images again"))
    return reasons


def _some(names: Sequence[str], most: int = 4) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more

"""Whether to trust a calibration, by a survey or on the bench, and why: a few tests, each one sentence."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Literal

import numpy as np

from calib.adjust.noise import Component, as_one
from calib.adjust.result import BenchCalibration, Calibration, FittedRig, ImageResiduals
from calib.adjust.terms import DOTS_OF, DRAWING, JOINTS, PRISMS, TAPES
from calib.errors import CalibError
from calib.geometry.significance import Level
from calib.survey.records import Survey, SurveyFinding
from mastctl.calibration.landing import expected_pointing, head_cameras

Grade = Literal["good", "care", "bad"]

ADVICE: Mapping[Grade, str] = {
    "good": "trust it",
    "care": "use it with care",
    "bad": "do not trust it",
}

POINTING_GOOD_PX = 0.5
POINTING_BAD_PX = 2.0
"""Rms per axis that the calibration alone may add to pointing at a click; the paper reached 1.3 in all."""

MANY_LEFT_OUT = 0.05
"""Share of dots or images left out above which the survey itself is in doubt."""

PAPER_GOOD_PX = 2.0
"""Rms of fitted images that the paper's method may leave: station errors of 2 mm are 1.4 px at 5 m."""

LITTLE = 0.2
"""Corners that are off by less than this part of ``corner_px`` are no reason for doubt."""

UNEXPLAINED, HOPELESS = 2.0, 5.0
"""Residuals so many times their stated sigmas that no kind of measurement explains are a model's; kinds that
scatter so many times more or less than stated are not what they are treated as."""

MANY_UNEVEN = 0.25
"""Share of images noisier than stated above which the cause should be looked for."""

CLOSER = 0.1
"""Another board is the one that is shown if it fits the image so many times better than its own."""

FAR_PX = 20.0
"""The same where the image's own board has no pixels to compare with."""

OWN = "their own sigmas"
"""What states a sigma that dots or corners came with, each its own; shown is the median."""


@dataclass(frozen=True)
class Reason:
    """One test's outcome as a sentence."""

    grade: Grade
    sentence: str


@dataclass(frozen=True)
class CalibrationVerdict:
    """The worst of the reasons decides."""

    reasons: tuple[Reason, ...]

    @property
    def grade(self) -> Grade:
        """The worst grade."""
        return max((reason.grade for reason in self.reasons), key=list(ADVICE).index, default="good")

    @property
    def advice(self) -> str:
        """The grade as a person says it."""
        return ADVICE[self.grade]

    def as_json(self) -> dict[str, object]:
        """Return it as JSON or YAML."""
        reasons = [{"grade": reason.grade, "sentence": reason.sentence} for reason in self.reasons]
        return {"grade": self.grade, "words": self.advice, "reasons": reasons}


def judge(
    survey: Survey,
    fit: Calibration | BenchCalibration,
    warnings: Sequence[SurveyFinding] = (),
    undetected: Sequence[str] = (),
    jointly: Calibration | CalibError | None = None,
) -> CalibrationVerdict:
    """Return whether to trust a calibration; ``survey`` with the dots or corners that were fitted.

    Of ``warnings`` of the survey's check, what the joint fit tests again, finer, is left to its tests.
    ``undetected`` are images in which no dots were found. ``jointly``: the joint fit of a survey that was
    calibrated by the paper's method, which has no tests of its own; or why there is none.
    """
    own = (
        _of_survey(survey, fit, warnings, undetected, jointly)
        if isinstance(fit, Calibration)
        else _of_bench(survey, fit)
    )
    return CalibrationVerdict(
        (
            *_noise(survey, fit),
            *_contradictions(fit),
            *_checks(fit),
            *(Reason("bad", direction.sentence) for direction in fit.degenerate),
            *_pointing(survey, fit),
            *own,
            *_left_out(fit),
        )
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
    yield from _jointly(survey, fit, jointly)
    yield from _at_the_end(fit)
    yield from _other_boards(survey, fit)
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


def _noise(survey: Survey, fit: Calibration | BenchCalibration) -> Iterator[Reason]:
    """Whether the residuals are what the stated sigmas make them."""
    if isinstance(fit, BenchCalibration) or np.isfinite(fit.chi2_probability):
        yield _chi_square(fit)
        yield from _sigmas(survey, fit)
        return
    worst_px, camera = max((max(xy), name) for name, xy in fit.rms_px.items())
    sentence = f"the largest residual of the fitted images is {worst_px:.2f} px rms ({camera})"
    if worst_px <= PAPER_GOOD_PX:
        yield Reason("good", f"{sentence}, within what station errors of some mm leave")
    elif fit.mast_parameters == 4:
        yield Reason("bad", f"{sentence}: the mast is not upright: use --mast 6")
    else:
        yield Reason("bad", f"{sentence}: station and boards do not agree")


def _chi_square(fit: FittedRig) -> Reason:
    """Whether the residuals as a whole are what the stated sigmas make them.

    Single kinds of measurements, or images, that explain them have reasons of their own.
    """
    freedom = max(fit.degrees_of_freedom, 1.0)
    factor = float(np.sqrt(fit.chi2 / freedom))
    explained = any(c.wrong for c in fit.components) or any(i.scatter > 1.0 for i in fit.images)
    grade: Grade = "good"
    if fit.chi2_probability < Level.STATED and not explained:
        grade = "bad" if factor > UNEXPLAINED else "care"
    return Reason(
        grade,
        f"chi-square is {fit.chi2:.0f} for {freedom:.0f} degrees of freedom: the residuals are "
        f"{factor:.2f} times what the stated sigmas make them",
    )


def stated(survey: Survey, images: Sequence[ImageResiduals], kind: str) -> tuple[float, str, str]:
    """Return the stated sigma of a kind of measurement, its unit, and its key under sigma in survey.yaml, or
    `OWN`."""
    sigma = survey.sigma
    if kind.startswith(DOTS_OF):
        camera, key = kind.removeprefix(DOTS_OF), "corner_px" if survey.boards else "dot_px"
        own = [image.sigma_px for image in images if image.camera == camera and image.purpose != "check"]
        own_px = float(np.median(np.concatenate(own))) if own else order_px(survey)
        same = own_px == order_px(survey)
        return own_px, "px", key if same else OWN
    if kind == JOINTS:
        return 1e3 * sigma.joint_rad, "mrad", "joint_rad"
    if kind == DRAWING:
        return 1e3 * sigma.prism_cad_m, "mm", "prism_cad_m"
    return 1e3 * sigma.station_m, "mm", "station_m"


def order_px(survey: Survey) -> float:
    """Return the sigma of a dot or corner in survey.yaml, px."""
    return survey.sigma.corner_px if survey.boards else survey.sigma.dot_px


def _sigmas(survey: Survey, fit: FittedRig) -> Iterator[Reason]:
    """A reason for each kind of measurement whose stated sigma is not what its residuals show.

    Too small a sigma is a fault of the survey. Too large a one is none, once the fit takes what was found;
    unless it is so far off that the measurements may be smoothed, or copies.
    """
    wrong = [c for c in fit.components if c.wrong]
    for c in (*wrong, *(c for c in fit.components if c.generous)):
        sigma, unit, key = stated(survey, fit.images, c.kind)
        # Dots and corners come with what noise leaves of them; prints and lenses are in survey.yaml's sigma.
        most = max(1.0, order_px(survey) / sigma) if key == OWN else 1.0
        grade: Grade = "good" if c.generous or 1.0 < c.factor <= most else "care"
        if c.factor > HOPELESS * most:
            grade = "bad"
        elif c.factor < 1.0 / HOPELESS and not survey.boards:  # a bench's are counts, which have no choice
            grade = "care"
        sentence = (
            f"{c.kind} scatter by {c.factor:.2f} ± {c.factor_sigma:.2f} times their stated sigma: "
            f"{c.factor * sigma:.2g} {unit} where {key} {'say' if key == OWN else 'says'} {sigma:.3g} "
            f"{unit}; the fit and its uncertainties take {c.weighed * sigma:.2g} {unit}"
        )
        if c.wrong and c.kind == PRISMS and all(other.kind != TAPES for other in wrong):
            sentence += "; tapes do not, so it may be the drawing of the prisms that is off (prism_cad_m)"
        yield Reason(grade, sentence)
    yield from _uneven(survey, fit.images)
    yield from _one_station(survey, fit.components)


def _uneven(survey: Survey, images: Sequence[ImageResiduals]) -> Iterator[Reason]:
    """Images that are noisier than others of their camera: each counts with what it scatters."""
    noisy = [image for image in images if image.scatter > 1.0]
    if noisy:
        worst = max(noisy, key=lambda image: image.scatter)
        beyond = [i for i in noisy if i.scatter * float(np.median(i.sigma_px)) > order_px(survey)]
        sentence = (
            f"{len(noisy)} of {len(images)} images scatter more than others of their camera, {worst.name} "
            f"most, by {worst.scatter:.1f} times; each counts with its own sigma"
        )
        many = len(beyond) > MANY_UNEVEN * len(images)
        look = ". That is many: look for motion, focus or light"
        yield Reason("care", sentence + look) if many else Reason("good", sentence)


def _one_station(survey: Survey, components: Sequence[Component]) -> Iterator[Reason]:
    """Whether prisms scatter as the tapes of the same station do: by tapes alone its sigma is found smaller
    than stated, and a wrong prism hides under the stated one."""
    by_kind = {c.kind: c for c in components if np.isfinite(c.factor)}
    tapes, prisms = by_kind.get(TAPES), by_kind.get(PRISMS)
    if tapes is None or prisms is None or not tapes.generous or prisms.factor < tapes.factor:
        return
    if not as_one(tapes, prisms):
        sigma_mm = 1e3 * survey.sigma.station_m
        yield Reason(
            "care",
            f"prisms scatter by {prisms.factor * sigma_mm:.1f} mm where the tapes of the same station do by "
            f"{tapes.factor * sigma_mm:.1f} mm: one of them, or their drawing, is wrong; measure them again",
        )


def _wider(fit: Calibration) -> Iterator[Reason]:
    """Whether the residuals ask for a wider model than the one that was fitted."""
    needed = [model for model in fit.wider if model.significant]
    if needed:
        first = needed[0]
        grade: Grade = "bad" if first.size_px > POINTING_GOOD_PX else "care"
        more = "one more number" if first.numbers == 1 else f"{first.numbers} more numbers"
        yield Reason(grade, f"{more} would gain {first.gain:.0f} in chi-square: {first.sentence}")
    elif fit.wider:
        least = min(fit.wider, key=lambda model: model.chance)
        yield Reason(
            "good",
            f"no wider model out of {len(fit.wider)} would gain more than chance makes likely; most "
            f"does {least.name}, {least.gain:.1f} in chi-square with {least.numbers} numbers",
        )
    if needed[1:]:
        names = _some([f"{model.name} ({model.gain:.0f} with {model.numbers})" for model in needed[1:]])
        yield Reason("care", f"other terms that would gain, perhaps by the same cause: {names}")


def _contradictions(fit: FittedRig) -> Iterator[Reason]:
    """Whether placements agree with one another."""
    placements = fit.contradictions
    odd = [one for one in placements if one.significant]
    if len(placements) == 2:  # either contradicts the other
        odd = odd[:1]
    yield from (Reason("care", one.sentence) for one in odd)
    if placements and not odd:
        first = placements[0]
        yield Reason(
            "good",
            f"each of {len(placements)} placements says what the others say of cameras, axes and joints; "
            f"{first.name} differs most, chi-square {first.gain:.0f} for {first.numbers} numbers",
        )


def _jointly(survey: Survey, other: Calibration, fit: Calibration | CalibError | None) -> Iterator[Reason]:
    """What the joint fit's tests say of a survey that another method calibrated."""
    if isinstance(fit, CalibError):
        untested = "whether sigmas and model are right was not tested"
        yield Reason("care", f"{untested}, since the survey cannot be fitted jointly: {fit}")
    elif fit is not None:
        for reason in (*_sigmas(survey, fit), *_wider(fit), *_contradictions(fit)):
            yield replace(reason, sentence=f"fitted jointly, {reason.sentence}")
        left_out = {outlier.name for outlier in other.outliers}
        if odd := [o.name for o in fit.outliers if o.kind == "image" and o.name not in left_out]:
            used = "would be left out as too far off, and was used: check tapes, angles and dots"
            yield Reason("care", f"fitted jointly, {_some(odd)} {used}")


def _checks(fit: Calibration | BenchCalibration) -> Iterator[Reason]:
    """Whether images that were not fitted are predicted as well as they should be."""
    blind = [
        f"check image {image.name} cannot show placement {image.placement}, which it names"
        for image in fit.images
        if image.purpose == "check" and not np.isfinite(image.residuals_px).all()
    ]
    blind += [
        f"image {click.image} cannot show check point {click.point}, which was clicked in it: correct its "
        "row in clicks.csv or the point's in station.csv"
        for click in (fit.unseen_clicks if isinstance(fit, Calibration) else ())
    ]
    yield from (Reason("bad", sentence) for sentence in blind)
    if not (fit.check_rms_px or blind):
        yield Reason("care", "there is no check image: nothing shows how well the result predicts")
        return
    for camera, size in fit.checks.items():
        sentence = (
            f"check images of {camera} are off by {size.seen_px:.2f} px rms an axis where "
            f"{size.expected_px:.2f} are expected; more than {size.most_px:.2f} would be bad"
        )
        yield Reason("good" if size.seen_px <= size.most_px else "bad", sentence)


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


def _pointing(survey: Survey, fit: Calibration | BenchCalibration) -> Iterator[Reason]:
    """How much the calibration adds to a pointing from a click, camera pair by pair.

    Of a survey that leaves something open that is no number: its covariance is of a chance.
    """
    if fit.degenerate:
        return
    joint_rad = fit.joint_rad if isinstance(fit, BenchCalibration) else survey.sigma.joint_rad
    for cameras in head_cameras(fit.rig):
        by = cameras[0].rpartition("_")[0] if len(cameras) > 1 else cameras[0]
        expected = expected_pointing(fit, cameras, middle=isinstance(fit, Calibration))
        if expected is None:
            reason = f"pointing {by} at 2 to 10 m is not possible at the angles at which boards were seen"
            yield Reason("care", reason)
            continue
        landings, covariance = expected
        by_rig, by_counts = landings.rms_px(covariance), landings.by_counts_px(joint_rad)
        sentence = f"a first pointing by {by} is uncertain by {by_rig:.2f} px an axis from calibration"
        if by_counts > 0.0:
            sentence += f", by {by_counts:.2f} from what a reading says"
        good, bad = (max(limit_px, by_counts) for limit_px in (POINTING_GOOD_PX, POINTING_BAD_PX))
        yield Reason("good" if by_rig <= good else "care" if by_rig <= bad else "bad", sentence)


def _other_boards(survey: Survey, fit: Calibration) -> Iterator[Reason]:
    """Placements whose images show another one of their set-up far better than their own.

    Images of the check, and those that the fit left out, are tried with every board where the fit has it.
    """
    left_out = {outlier.name for outlier in fit.outliers if outlier.kind == "image"}
    shown: dict[tuple[str, str, str], list[str]] = {}
    for image in fit.images:
        if image.purpose != "check" and f"image {image.name}" not in left_out:
            continue
        model = fit.rig.camera_in_rover(image.camera, image.pan_rad or 0.0, image.tilt_rad or 0.0)
        in_board = survey.board.dots_in_board_m(image.rows, image.columns)
        off_px = {}
        for (setup, placement), pose in fit.rover_from_board.items():
            predicted, valid = model.project(pose.points(in_board))
            if setup == image.setup and placement != image.placement and valid.all():
                off_px[placement] = float(np.sqrt(np.mean((predicted - image.pixels_px) ** 2)))
        own_px = float(np.sqrt(np.mean(image.residuals_px**2)))
        other = min(off_px, key=lambda placement: off_px[placement], default=None)
        if other is not None and off_px[other] < (CLOSER * own_px if np.isfinite(own_px) else FAR_PX):
            shown.setdefault((image.setup, image.placement, other), []).append(image.name)
    for (setup, own, other), images in shown.items():
        yield Reason(
            "care",
            f"image{'s' * (len(images) > 1)} {_some(images)} cannot show placement {own} but would show "
            f"{other} (set-up {setup}): are they exchanged in images.csv, or their tapes in station.csv?",
        )


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
    if prisms or len(tapes) > MANY_LEFT_OUT * sum(point.board is not None for point, _ in station):
        reasons.append(Reason("care", f"measure again: {_some([*prisms, *tapes])}"))
    if not reasons and fit.outliers:
        reasons.append(Reason("good", f"{len(fit.outliers)} measurements were left out, each named"))
    return reasons


def _at_the_end(fit: Calibration) -> Iterator[Reason]:
    """Whether the last images of a camera were left out: what changed before them still holds, unnoticed.

    Were they kept, the fit would test such a change; an image that was left out takes its evidence along.
    """
    for camera in fit.rig.cameras:
        images = [image for image in fit.images if image.camera == camera and image.purpose != "check"]
        last = list(takewhile(lambda image: not image.used.any(), reversed(images)))
        if 0 < len(last) < len(images):
            count = f"{len(last)} of {len(images)}" if len(last) > 1 else f"of {len(images)}"
            were = "were" if len(last) > 1 else "was"
            yield Reason(
                "care",
                f"the last {count} images of {camera} {were} left out: if focus, mount or a joint changed "
                f"before {last[-1].name}, the result is of before; take some images again",
            )


def _some(names: Sequence[str], most: int = 4) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more

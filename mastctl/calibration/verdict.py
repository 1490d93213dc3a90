"""Whether to trust a calibration, and why: a few tests, each one sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from calib.adjust.goodness import Component, as_one
from calib.adjust.result import BenchCalibration, Calibration, ImageResiduals
from calib.adjust.terms import PRISMS, TAPES
from calib.adjust.uncertainty import pointing_covariance
from calib.errors import CalibError
from calib.geometry.significance import Level
from calib.survey.records import Survey, SurveyFinding
from mastctl.calibration.checks import exchanged_boards
from mastctl.calibration.tested import allowed, wrong_sentence

Grade = Literal["good", "care", "bad"]

WORDS: Mapping[Grade, str] = {
    "good": "trust it",
    "care": "use it with care",
    "bad": "do not trust it",
}

POINTING_RANGE_M = 6.0
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

UNEXPLAINED = 2.0
"""Residuals so many times their stated sigmas that no kind of measurement explains are a model's."""

MANY_UNEVEN = 0.25
"""Share of images noisier than stated above which somebody should look for the cause."""

HOPELESS = 5.0
"""Measurements that scatter so many times their stated sigma, or by so much less, are not what they are taken
for."""


@dataclass(frozen=True)
class Reason:
    """One test's outcome in words."""

    grade: Grade
    sentence: str


@dataclass(frozen=True)
class CalibrationVerdict:
    """The worst of the reasons decides."""

    grade: Grade
    reasons: tuple[Reason, ...]

    @property
    def words(self) -> str:
        """The grade as a person says it."""
        return WORDS[self.grade]

    def told(self) -> dict[str, object]:
        """Return it as JSON or YAML."""
        reasons = [{"grade": reason.grade, "sentence": reason.sentence} for reason in self.reasons]
        return {"grade": self.grade, "words": self.words, "reasons": reasons}


def judge_calibration(
    survey: Survey,
    calibration: Calibration,
    warnings: Sequence[SurveyFinding] = (),
    undetected: Sequence[str] = (),
    jointly: Calibration | CalibError | None = None,
) -> CalibrationVerdict:
    """Return whether to trust a calibration.

    Parameters
    ----------
    survey
        With the dots that were fitted.
    calibration
        What came of it.
    warnings
        What the check of the survey warned of. What the joint fit tests again, finer, is left to its tests.
    undetected
        Names of images in which no dots were found.
    jointly
        The joint fit of a survey that was calibrated by the paper's method, which has no tests of its own; or
        why there is none.
    """
    reasons = [
        *_noise(survey, calibration),
        *_wider(calibration),
        *contradiction_reasons(calibration),
        *_jointly(survey, jointly),
        *_odd_images(calibration),
        *_checks(calibration),
        *_open(calibration),
        *_turned(calibration),
        *_pointing(calibration),
        *_left_out(calibration),
        *_at_the_end(calibration),
        *(Reason("care", sentence) for sentence in exchanged_boards(survey, calibration)),
    ]
    if undetected:
        reasons.append(Reason("care", f"no dots were found in {len(undetected)} images: {_some(undetected)}"))
    joint = np.isfinite(calibration.chi2_probability)
    if count := sum(not (joint and warning.tested_again) for warning in warnings):
        reasons.append(Reason("care", f"the check of the survey warned {count} times"))
    grades = {reason.grade for reason in reasons}
    grade: Grade = "bad" if "bad" in grades else "care" if "care" in grades else "good"
    return CalibrationVerdict(grade, tuple(reasons))


def _noise(survey: Survey, calibration: Calibration) -> list[Reason]:
    """Whether the residuals are what the stated sigmas make them."""
    if not np.isfinite(calibration.chi2_probability):
        worst = max((max(xy), name) for name, xy in calibration.rms_px.items())
        words = f"the largest residual of the fitted images is {worst[0]:.2f} px rms ({worst[1]})"
        if worst[0] > PAPER_GOOD_PX:
            upright = calibration.mast_parameters == 4
            why = "the mast is not upright: use --mast 6" if upright else "station and boards do not agree"
            return [Reason("bad", f"{words}: {why}")]
        return [Reason("good", f"{words}, within what station errors of some mm leave")]
    factor = np.sqrt(calibration.chi2 / max(calibration.degrees_of_freedom, 1.0))
    words = (
        f"chi-square is {calibration.chi2:.0f} for {calibration.degrees_of_freedom:.0f} degrees of freedom: "
        f"the residuals are {factor:.2f} times what the stated sigmas make them"
    )
    wrong = [c for c in calibration.components if c.wrong]
    reasons = [Reason(chi_square_grade(calibration, factor), words)]
    reasons += sigma_reasons(survey, calibration)
    told = [c for c in calibration.components if np.isfinite(c.factor)]
    if told and not wrong:
        most = max(told, key=lambda c: c.factor)
        words = f"each kind of measurement scatters no more than stated, most of all {most.kind}: "
        words += f"{most.factor:.2f} ± {most.factor_sigma:.2f} times their sigma"
        reasons.append(Reason("good", words))
    return reasons


def chi_square_grade(calibration: Calibration | BenchCalibration, factor: float) -> Grade:
    """Return how bad residuals are that are ``factor`` times what stated sigmas make them: no reason by
    themselves where single kinds of measurements, or images, explain it; these have reasons of their own."""
    if calibration.chi2_probability >= Level.STATED:
        return "good"
    if any(c.wrong for c in calibration.components) or any(i.scatter > 1.0 for i in calibration.images):
        return "good"
    return "bad" if factor > UNEXPLAINED else "care"


def sigma_reasons(survey: Survey, calibration: Calibration | BenchCalibration) -> list[Reason]:
    """Return a reason for each kind of measurement whose stated sigma is not what its residuals show.

    Too small a sigma is a fault of the survey. Too large a one is none, once the fit takes what was found;
    unless it is so far off that the measurements may be smoothed, or copies.
    """
    components, images = calibration.components, calibration.images
    wrong = [c for c in components if c.wrong]
    reasons = []
    for c in (*wrong, *(c for c in components if c.generous)):
        most = allowed(survey, images, c.kind)
        grade: Grade = "good" if c.generous or 1.0 < c.factor <= most else "care"
        if c.factor > HOPELESS * most:
            grade = "bad"
        elif c.factor < 1.0 / HOPELESS and not survey.boards:  # a bench's are counts, which nobody chose
            grade = "care"
        reasons.append(Reason(grade, wrong_sentence(survey, images, c, wrong)))
    return [*reasons, *_uneven(survey, images), *_one_station(survey, components)]


def _uneven(survey: Survey, images: Sequence[ImageResiduals]) -> list[Reason]:
    """Images that are noisier than others of their camera: each counts with what it scatters."""
    order_px = survey.sigma.corner_px if survey.boards else survey.sigma.dot_px
    noisy = [image for image in images if image.scatter > 1.0]
    if not noisy:
        return []
    worst = max(noisy, key=lambda image: image.scatter)
    beyond = [i for i in noisy if i.scatter * float(np.median(i.sigma_px)) > order_px]
    words = (
        f"{len(noisy)} of {len(images)} images scatter more than others of their camera, {worst.name} most, "
        f"by {worst.scatter:.1f} times; each counts with its own sigma"
    )
    if len(beyond) <= MANY_UNEVEN * len(images):
        return [Reason("good", words)]
    return [Reason("care", f"{words}. That is many: look for motion, focus or light")]


def _one_station(survey: Survey, components: Sequence[Component]) -> list[Reason]:
    """Whether prisms scatter as the tapes of the same station do: by tapes alone its sigma is found smaller
    than stated, and a wrong prism hides under the stated one."""
    by_kind = {c.kind: c for c in components if np.isfinite(c.factor)}
    tapes, prisms = by_kind.get(TAPES), by_kind.get(PRISMS)
    if tapes is None or prisms is None or not tapes.generous or prisms.factor < tapes.factor:
        return []
    if as_one(tapes, prisms):
        return []
    sigma_mm = 1e3 * survey.sigma.station_m
    words = (
        f"prisms scatter by {prisms.factor * sigma_mm:.1f} mm where the tapes of the same station do by "
        f"{tapes.factor * sigma_mm:.1f} mm: one of them, or their drawing, is wrong; measure them again"
    )
    return [Reason("care", words)]


def _wider(calibration: Calibration) -> list[Reason]:
    """Whether the residuals ask for a wider model than the one that was fitted."""
    if not calibration.wider:
        return []
    asked = [model for model in calibration.wider if model.significant]
    if not asked:
        first = min(calibration.wider, key=lambda model: model.chance)
        words = (
            f"no wider model out of {len(calibration.wider)} would gain more than chance makes likely; most "
        )
        words += f"does {first.name}, {first.gain:.1f} in chi-square with {first.numbers} numbers"
        return [Reason("good", words)]
    first, *others = asked
    grade: Grade = "bad" if first.size_px > POINTING_GOOD_PX else "care"
    more = "one more number" if first.numbers == 1 else f"{first.numbers} more numbers"
    words = f"{more} would gain {first.gain:.0f} in chi-square: {first.sentence}"
    reasons = [Reason(grade, words)]
    if others:
        names = _some([f"{model.name} ({model.gain:.0f} with {model.numbers})" for model in others])
        reasons.append(Reason("care", f"other terms that would gain, perhaps by the same cause: {names}"))
    return reasons


def contradiction_reasons(calibration: Calibration | BenchCalibration) -> list[Reason]:
    """Return whether placements agree with one another."""
    placements = calibration.contradictions
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
        words = "whether sigmas and model are right was not tested, since the survey cannot be fitted jointly"
        return [Reason("care", f"{words}: {fit}")]
    reasons = [*sigma_reasons(survey, fit), *_wider(fit), *contradiction_reasons(fit)]
    return [replace(reason, sentence=f"fitted jointly, {reason.sentence}") for reason in reasons]


def _odd_images(calibration: Calibration) -> list[Reason]:
    """Images that the paper's method kept, though they are far from the others (joint tests each of them)."""
    if np.isfinite(calibration.chi2_probability) or calibration.mast_parameters == 4:
        return []
    groups: dict[tuple[str, str], list[tuple[float, str]]] = {}
    for image in calibration.images:
        if image.purpose != "check" and image.used.any():
            rms_px = float(np.sqrt(np.mean(image.residuals_px[image.used] ** 2)))
            groups.setdefault((image.camera, image.purpose), []).append((rms_px, image.name))
    reasons = []
    for group in groups.values():
        usual = float(np.median([rms_px for rms_px, _ in group]))
        odd = [(rms_px, name) for rms_px, name in group if rms_px > ODD_IMAGE * usual]
        if len(group) >= FEW_IMAGES and odd:
            rms_px, name = max(odd)
            words = f"image {name} is off by {rms_px:.2f} px rms where others like it are by {usual:.2f}"
            reasons.append(Reason("care", f"{words}: check its tapes, its angles and its dots"))
    return reasons


def _checks(calibration: Calibration) -> list[Reason]:
    """Whether images that were not fitted are predicted as well as they should be."""
    reasons = [
        Reason("bad", f"check image {image.name} cannot show placement {image.placement}, which it names")
        for image in calibration.images
        if image.purpose == "check" and not np.isfinite(image.residuals_px).all()
    ]
    reasons += [
        Reason(
            "bad",
            f"image {click.image} cannot show check point {click.point}, which was clicked in it: correct "
            "its row in clicks.csv or the point's in station.csv",
        )
        for click in calibration.unseen_clicks
    ]
    if not (calibration.check_rms_px or reasons):
        return [Reason("care", "there is no check image: nothing shows how well the result predicts")]
    for camera, size in calibration.checks.items():
        words = (
            f"check images of {camera} are off by {size.seen_px:.2f} px rms an axis where the survey's noise "
            f"explains {size.expected_px:.2f}"
        )
        grade: Grade = "good" if size.seen_px <= size.most_px else "bad"
        reasons.append(Reason(grade, f"{words}; more than {size.most_px:.2f} would be bad"))
    return reasons


def _open(calibration: Calibration) -> list[Reason]:
    return [Reason("bad", direction.sentence) for direction in calibration.degenerate]


def _turned(calibration: Calibration) -> list[Reason]:
    """Whether the mast is turned about: a tilt that counts down fits as well, with the head half a turn off.

    `calib.survey.mixups` mostly refuses such a survey before.
    """
    angle = float(np.linalg.norm(Rotation.from_euler("XYZ", calibration.rig.mast.rotation_rad).as_rotvec()))
    if angle < TURNED_RAD:
        return []
    words = f"the mast comes out turned by {np.degrees(angle):.0f} degrees against the rover"
    return [Reason("bad", f"{words}: pan or tilt has the wrong sign (right and up are positive)")]


def _pointing(calibration: Calibration) -> list[Reason]:
    """How much the calibration alone adds to a pointing from a click."""
    reasons = []
    for pair, names in calibration.rig.stereo.items():
        if calibration.rig.cameras[names[0]].on != "head":
            continue
        sigma = pointing_sigma_px(calibration, names)
        if sigma is None:
            reasons.append(Reason("care", f"pointing by {pair} at {POINTING_RANGE_M:g} m is not possible"))
            continue
        grade: Grade = "good" if sigma <= POINTING_GOOD_PX else "care" if sigma <= POINTING_BAD_PX else "bad"
        words = f"pointing {pair} at what was clicked near a corner at {POINTING_RANGE_M:g} m"
        reasons.append(
            Reason(grade, f"{words} is uncertain by {sigma:.2f} px an axis from calibration alone")
        )
    return reasons


def pointing_sigma_px(calibration: Calibration, pair: tuple[str, str]) -> float | None:
    """Return the sigma (rms per axis, pixels) of pointing at targets clicked near the image's corners.

    None if no such target can be pointed at.
    """
    width, height = calibration.rig.cameras[pair[0]].model.size_px
    seen = [i for i in calibration.images if i.camera == pair[0] and i.pan_rad is not None]
    pan = float(np.median([i.pan_rad for i in seen])) if seen else 0.0
    tilt = float(np.median([i.tilt_rad for i in seen])) if seen else 0.0
    variances = []
    for x, y in ((0.2, 0.2), (0.8, 0.2), (0.2, 0.8), (0.8, 0.8)):
        try:
            left_px = np.array([x * width, y * height])
            covariance = pointing_covariance(calibration, pair, pan, tilt, left_px, POINTING_RANGE_M)
        except CalibError:
            continue
        variances.append(np.trace(covariance) / 2)
    return float(np.sqrt(np.mean(variances))) if variances else None


def _left_out(calibration: Calibration) -> list[Reason]:
    """Whether too much was rejected."""
    by_kind = {
        kind: [outlier for outlier in calibration.outliers if outlier.kind == kind]
        for kind in ("dot", "image", "tape", "prism")
    }
    fitted = [image for image in calibration.images if image.purpose != "check"]
    dots = sum(len(image.used) for image in fitted)
    reasons = []
    for kind, count in (("dot", dots), ("image", len(fitted))):
        left = len(by_kind[kind])
        if left > MANY_LEFT_OUT * max(count, 1):
            reasons.append(Reason("care", f"{left} of {count} {kind}s were left out; look for the cause"))
    tapes = sum(point.kind == "tape" for point in calibration.station)
    if by_kind["prism"] or len(by_kind["tape"]) > MANY_LEFT_OUT * tapes:
        names = _some([outlier.name for kind in ("prism", "tape") for outlier in by_kind[kind]])
        reasons.append(Reason("care", f"measure again: {names}"))
    if not reasons and calibration.outliers:
        reasons.append(Reason("good", f"{len(calibration.outliers)} measurements were left out, each named"))
    return reasons


def _at_the_end(calibration: Calibration) -> list[Reason]:
    """Whether the last images of a camera were left out: what changed before them still holds, untold.

    Were they kept, the fit would test such a change; an image that was left out takes its evidence along.
    """
    fitted: dict[str, list[ImageResiduals]] = {}
    for image in calibration.images:
        if image.purpose != "check":
            fitted.setdefault(image.camera, []).append(image)
    reasons = []
    for camera, images in fitted.items():
        last = list(takewhile(lambda image: not image.used.any(), reversed(images)))
        if 0 < len(last) < len(images):
            words = f"the last {len(last)} of {len(images)} images of {camera} were left out"
            if len(last) == 1:
                words = f"the last of {len(images)} images of {camera} was left out"
            since = (
                f"{words}: if focus, mount or a joint changed before {last[-1].name}, the result is of before"
            )
            reasons.append(Reason("care", f"{since}; take some images again"))
    return reasons


def _some(names: Sequence[str], most: int = 4) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more

"""The statements of a bench's fit: sigmas, gains of terms, expected check images, gauges."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calib.adjust.adjustment import Adjustment
from calib.adjust.checks import expected_checks
from calib.adjust.hypotheses import ScoredFit, find_contradictions, find_drifts
from calib.adjust.model_terms import TermGain, candidate_terms, choose_terms
from calib.adjust.result import BenchCalibration, ImageResiduals
from calib.adjust.robust import Weighed
from calib.adjust.scatter import own_scales, print_error_m
from calib.adjust.solver import Minimum
from calib.adjust.terms import ImageTerm, scattered_images, widened_images
from calib.adjust.uncertainty import fitted_fields, image_residuals, rms_by_camera
from calib.adjust.unknowns import Estimate
from calib.calibrate.bench.problem import BenchProblem
from calib.calibrate.starts.wrong_dots import wrong_dots
from calib.geometry.significance import Level


def bench_calibration(
    bench: BenchProblem,
    stated: tuple[Adjustment, Minimum[Estimate]],
    weighed: Weighed,
    chosen: Sequence[str],
    tests: Mapping[str, TermGain],
    began: float,
) -> BenchCalibration:
    """Put together what the fit says; chi-square is that of the stated sigmas."""
    problem, state, covariance = weighed.problem, weighed.fit.state, weighed.covariance
    for one in weighed.components:
        if one.wrong or one.generous:
            bench.notes.append(
                f"{one.kind} scatter by {one.factor:.2f} ± {one.factor_sigma:.2f} times the stated "
                "sigma; they count with that"
            )
    order_px = bench.survey.sigma.corner_px
    own = own_scales(problem, state, bench.terms.checks, weighed.factors, order_px)
    checks = widened_images(scattered_images(bench.terms.checks, own), weighed.factors)
    scatter = {t.name: t.scatter for t in (*weighed.images, *checks)}
    images = image_residuals(bench.survey, problem, state, bench.terms.images, bench.terms.checks, scatter)
    checked = _checked(images, bench.terms.checks)
    scored = ScoredFit(problem, state)
    # A parameter that is not seen keeps what is weakly known of it, and is reported as open.
    kinds = ("mast", "joints", "camera")
    return BenchCalibration(
        **fitted_fields(bench.survey, problem, state, weighed.part(*kinds), images, kinds, bench.notes),
        **weighed.judged_fields(stated),
        terms=_gains(bench, chosen, tests, weighed),
        check_rms_px=rms_by_camera(checked),
        checks=expected_checks(problem, state, covariance, checks, checked, Level.PREDICTED),
        gauges=_gauges(bench, chosen),
        contradictions=find_contradictions(scored),
        drifts=find_drifts(scored),
        joint_rad=problem.joint_rad,
        inexact_m=print_error_m(problem, state),
        bows_m=state.bows_m,
        seconds=time.perf_counter() - began,
    )


def _gains(
    bench: BenchProblem, chosen: Sequence[str], tests: Mapping[str, TermGain], weighed: Weighed
) -> tuple[TermGain, ...]:
    """Every term with what it gains; those of the model beside one another."""
    every = candidate_terms(bench.boards)
    _, gains = choose_terms(weighed.problem, weighed.fit, {name: every[name] for name in chosen})
    entered = {name: replace(gain, entered=True) for name, gain in gains.items()}
    return tuple({**tests, **entered}.values())


def _gauges(bench: BenchProblem, chosen: Sequence[str]) -> tuple[str, ...]:
    """What pictures cannot know, and how it was fixed."""
    known = bench.options.rover_from_board
    if known is not None:
        where = (
            f"the rover frame hangs on placement {known[0][1]} of board {known[0][0]}, whose pose was stated"
        )
    elif bench.options.rover_from_mast is not None:
        where = "the mast stands in the rover frame as was stated, with no uncertainty"
    else:
        where = (
            "the rover frame is the mast's at zero angles (z down along the pan axis): where the "
            "vehicle is, pictures cannot show"
        )
    gauges = [
        where,
        "its origin is where the pan axis is nearest to the tilt axis: pictures determine no other height "
        "along it",
        "pan is zero where the tilt axis points to y, tilt where the head's x lies square to pan. An "
        "offset of either would turn the frame or all head cameras, and is none",
        "every length is as long as the boards were measured: 0.1 % there is 0.1 % of every range",
    ]
    if "tilt harmonic 1" in chosen:
        gauges.append(
            "the first harmonic of tilt is encoder and an arm's sag together: pictures cannot separate them"
        )
    return tuple(gauges)


def _checked(images: Sequence[ImageResiduals], checks: Sequence[ImageTerm]) -> list[ImageResiduals]:
    """The check images, less corners that disagree with the rest of their own image."""
    wrong, _ = wrong_dots(checks)
    none = {t.name: np.zeros_like(t.keep) for t in checks}
    return [
        replace(i, used=np.isfinite(i.residuals_px).all(axis=1) & ~wrong.get(i.name, none[i.name]))
        for i in images
        if i.name in none
    ]

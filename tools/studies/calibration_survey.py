"""Surveys of the study of calibration: variants, and one survey fitted and judged.

One thing is varied at a time from the paper's survey (III, Table II): how many placements the mast is
calibrated with, how many boards the cameras, how well the station measures, how many prisms there are, which
pairs see which boards, whether the mast is taken as upright. A survey carries its seed, so that it comes to
the same wherever it runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calib.adjust.result import Calibration
from calib.errors import CalibError
from calib.geometry.pointing import solve
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.geometry.stereo import triangulate
from calib.survey.records import Sigma
from hil_tests.support.sim_survey.plan import SurveyPlan
from hil_tests.support.sim_survey.survey import simulate_survey
from mastctl.calibration.landing import click, pointing_error_px, seen
from mastctl.calibration.run import FITS, Method

METHODS: tuple[Method, ...] = ("paper", "joint")
PAPER_STATION_M = 0.002


@dataclass(frozen=True)
class Variant:
    """One point of a study: what the survey is like and how it is fitted."""

    study: str
    label: str
    method: Method = "joint"
    mast_parameters: int = 6
    plan: SurveyPlan = field(default_factory=SurveyPlan)


def variants() -> tuple[Variant, ...]:
    """Return everything that is varied, one thing at a time from the paper's survey."""
    base = SurveyPlan()
    found: list[Variant] = []
    for method in METHODS:
        plans = {f"{n}": replace(base, mast_boards=n) for n in (2, 3, 4, 5, 6, 8, 12, 18)}
        found += [Variant(f"placements, {method}", label, method, 6, plan) for label, plan in plans.items()]
        rings = {n: tuple(replace(ring, boards=n) for ring in base.rings) for n in (2, 4, 8, 12)}
        found += [
            Variant(f"boards, {method}", f"{n}", method, 6, replace(base, rings=some))
            for n, some in rings.items()
        ]
        found += [
            Variant(f"station, {method}", f"{mm:g} mm", method, 6, replace(base, sigma=Sigma(mm / 1000, 0.1)))
            for mm in (0.5, 1.0, 2.0, 4.0)
        ]
    found += [Variant("prisms", f"{n}", "joint", 6, replace(base, prisms=n)) for n in (3, 4)]
    for also in ("", "navcam"):
        some = tuple(replace(r, also=also) if r.pair == "hazcam" else r for r in base.rings)
        label = f"seen by {also} too" if also else "seen by hazcam"
        found.append(Variant("hazcam boards", label, plan=replace(base, rings=some)))
    paper = replace(base, sigma=Sigma(PAPER_STATION_M, 0.1))
    found += [Variant("mast parameters", f"{n}", "paper", n, paper) for n in (4, 6, 8)]
    return tuple(found)


DISTANCES_M = (10.0, 6.0, 2.0)
CLICK_PX = 0.2
PAN_RAD, TILT_RAD = (-1.0, 1.0), (-0.6, -0.05)
MARGIN = 0.1
"""Targets keep so far from the images' edges, as part of the width and height."""

PANCAM_TO_NAVCAM, NAVCAM_TO_HAZCAM = "pancam to navcam", "navcam to hazcam"
HANDOFFS = (
    *((PANCAM_TO_NAVCAM, range_m) for range_m in DISTANCES_M),
    (NAVCAM_TO_HAZCAM, 2.0),
)
"""What is handed off, and how far away it is."""

Handoff = tuple[str, float]


@dataclass(frozen=True, eq=False)
class SurveyTask:
    """One survey of one variant; ``seed`` is the study's and the survey's number."""

    rig: Rig
    variant: Variant
    seed: tuple[int, int]
    targets: int


@dataclass(frozen=True, eq=False)
class SurveyOutcome:
    """What one survey came to; ``failure`` says why there is nothing else.

    Attributes
    ----------
    pointing_px, exact_px
        By distance, (n, 2) errors of pointing after clicks of 0.2 px noise, and after exact clicks.
    handoff_px
        By ``HANDOFFS``, (n, 2) errors against exact projection.
    mast, sigma
        The six (or eight) numbers, estimated, and their standard deviations.
    mast_rms_px
        By pair, (x, y) rms over the images of purpose ``mast``.
    """

    variant: Variant
    failure: str = ""
    pointing_px: Mapping[float, FloatArray] = field(default_factory=dict)
    exact_px: Mapping[float, FloatArray] = field(default_factory=dict)
    handoff_px: Mapping[Handoff, FloatArray] = field(default_factory=dict)
    mast: FloatArray = field(default_factory=lambda: np.full(8, np.nan))
    sigma: FloatArray = field(default_factory=lambda: np.full(8, np.nan))
    mast_rms_px: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def one_survey(task: SurveyTask) -> SurveyOutcome:
    """Simulate one survey, fit it, and measure what pointing and hand-off by the result are worth."""
    variant = task.variant
    of_survey = np.random.SeedSequence([*task.seed, 0]).generate_state(1)[0]
    survey, _ = simulate_survey(task.rig, int(of_survey), variant.plan)
    try:
        fit = FITS[variant.method](survey, variant.mast_parameters)
    except CalibError as error:
        return SurveyOutcome(variant, failure=str(error))
    rng = np.random.default_rng([*task.seed, 1])
    pointing, exact = _pointing(task.rig, fit.rig, task.targets, rng)
    mast, sigma = fit.rig.mast, fit.sigma["mast"]
    return SurveyOutcome(
        variant,
        "",
        pointing,
        exact,
        _handoffs(task.rig, fit.rig, task.targets, rng),
        np.array([*mast.translation_m, *mast.rotation_rad, mast.axis_offset_m, mast.axis_twist_rad]),
        np.array(
            [*sigma["translation_m"], *sigma["rotation_rad"], sigma["axis_offset_m"], sigma["axis_twist_rad"]]
        ),
        _mast_rms(fit),
    )


def _pointing(
    true: Rig, believed: Rig, targets: int, rng: np.random.Generator
) -> tuple[dict[float, FloatArray], dict[float, FloatArray]]:
    """Errors by distance, (targets, 2): of noisy clicks, and of exact ones at the same targets."""
    pair = true.stereo["navcam"]
    noisy: dict[float, FloatArray] = {}
    exact: dict[float, FloatArray] = {}
    for range_m in DISTANCES_M:
        rows: list[list[FloatArray]] = []
        while len(rows) < targets:
            pan, tilt = rng.uniform(*PAN_RAD), rng.uniform(*TILT_RAD)
            left_px = _pixel(true, pair[0], rng)
            noise = CLICK_PX * rng.standard_normal((2, 2))
            target, left, right = click(true, pair, pan, tilt, left_px, range_m)
            if not true.cameras[pair[1]].model.holds(right):
                continue
            rows.append(
                [
                    _pointed(believed, true, pair, pan, tilt, target, left + n[0], right + n[1])
                    for n in (noise, 0 * noise)
                ]
            )
        both = np.array(rows)
        noisy[range_m], exact[range_m] = both[:, 0], both[:, 1]
    return noisy, exact


def _pointed(believed: Rig, true: Rig, *rest: Any) -> FloatArray:
    """As `pointing_error_px`; not-a-number where the believed rig finds no answer."""
    try:
        return pointing_error_px(believed, true, *rest)
    except CalibError:
        return np.full(2, np.nan)


def _handoffs(true: Rig, believed: Rig, targets: int, rng: np.random.Generator) -> dict[Handoff, FloatArray]:
    """Errors (n, 2) of both eyes of the receiving pair, by hand-off; clicks have noise."""
    found: dict[Handoff, FloatArray] = {}
    for name, range_m in HANDOFFS:
        giver, taker = name.split(" to ")
        if not {giver, taker} <= set(true.stereo) & set(believed.stereo):
            continue
        rows: list[FloatArray] = []
        for _ in range(targets):
            shot = _shared_view(true, true.stereo[giver], true.stereo[taker], range_m, rng)
            if shot is None:
                continue
            pan, tilt, target, left, right = shot
            noise = CLICK_PX * rng.standard_normal((2, 2))
            pair, takers = true.stereo[giver], true.stereo[taker]
            try:
                errors = handoff_errors_px(
                    believed, true, pair, takers, pan, tilt, target, left + noise[0], right + noise[1]
                )
            except CalibError:
                rows.append(np.full(2, np.nan))
                continue
            rows += errors.values()
        if rows:
            found[name, range_m] = np.array(rows)
    return found


def handoff_errors_px(
    believed: Rig,
    true: Rig,
    pair: tuple[str, str],
    to: tuple[str, ...],
    pan_rad: float,
    tilt_rad: float,
    target_m: FloatArray,
    left_px: FloatArray,
    right_px: FloatArray,
) -> Mapping[str, FloatArray]:
    """Return by camera how far (2,), pixels, a hand-off puts a target from where it truly is.

    Cameras of ``to`` whose image does not hold the target are left out. Raises CalibError as above.
    """
    left, right = (believed.camera_in_rover(name, pan_rad, tilt_rad) for name in pair)
    position = triangulate(left, right, left_px, right_px).position_m
    errors = {}
    for name in to:
        pixel, valid = true.camera_in_rover(name, pan_rad, tilt_rad).project(target_m)
        if valid and true.cameras[name].model.holds(pixel):
            errors[name] = seen(believed, name, pan_rad, tilt_rad, position) - pixel
    return errors


def _shared_view(
    true: Rig, pair: tuple[str, str], takers: tuple[str, str], range_m: float, rng: np.random.Generator
) -> tuple[float, float, FloatArray, FloatArray, FloatArray] | None:
    """Joint angles, and a target that both eyes of a pair see there and the taking camera too.

    Takers on the body: a target of theirs, and the head turned to it. Takers on the head: any view.
    """
    for _ in range(100):
        pan, tilt = rng.uniform(*PAN_RAD), rng.uniform(*TILT_RAD)
        if true.cameras[takers[0]].on == "rover":
            rays = true.cameras[takers[0]].model.ray(_pixel(true, takers[0], rng))
            place = rays.origins_m + range_m * rays.directions
            aim_px = _pixel(true, pair[0], rng)
            try:
                angles = solve(true.mast, true.cameras[pair[0]].model, place, aim_px)[0]
            except CalibError:
                continue
            pan, tilt = angles.pan_rad, angles.tilt_rad
            if not np.isfinite(place).all() or abs(pan) > 1.5 or not -1.2 < tilt < 0.3:
                continue
            left_px = seen(true, pair[0], pan, tilt, place)
            eye = true.camera_in_rover(pair[0], pan, tilt).ray(left_px)
            away_m = float(np.linalg.norm(place - eye.origins_m))
        else:
            left_px, away_m = _pixel(true, pair[0], rng), range_m
        try:
            target, left, right = click(true, pair, pan, tilt, left_px, away_m)
        except CalibError:
            continue
        if true.cameras[pair[1]].model.holds(right):
            return pan, tilt, target, left, right
    return None


def _pixel(rig: Rig, camera: str, rng: np.random.Generator) -> FloatArray:
    """A pixel (2,) anywhere but at the edges."""
    size = np.array(rig.cameras[camera].model.size_px, dtype=np.float64)
    return np.asarray(size * rng.uniform(MARGIN, 1.0 - MARGIN, 2))


def _mast_rms(fit: Calibration) -> dict[str, tuple[float, float]]:
    """Rms by pair over the images of purpose ``mast``, those that were left out included."""
    found = {}
    for pair, names in fit.rig.stereo.items():
        residuals = [i.residuals_px for i in fit.images if i.camera in names and i.purpose == "mast"]
        if residuals:
            found[pair] = rms_px(np.concatenate(residuals))
    return found


def rms_px(errors: FloatArray) -> tuple[float, float]:
    """Return the rms (x, y) of errors (n, 2); those that are not-a-number do not count."""
    x, y = np.sqrt(np.nanmean(errors**2, axis=0))
    return float(x), float(y)


def survey_tasks(
    rig: Rig, *, surveys: int, targets: int, seed: int, chosen: Sequence[Variant]
) -> list[SurveyTask]:
    """Return the tasks of a study: so many surveys of each variant, with so many targets at each distance.

    Every variant has the same seeds: what differs between two is then the variant rather than the draw.
    """
    return [
        SurveyTask(rig, variant, (seed, number), targets) for variant in chosen for number in range(surveys)
    ]

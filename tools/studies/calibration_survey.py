"""Surveys of the study of calibration: what is varied, one of them fitted and judged, and all together.

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
from calib.survey.records import Sigma
from mastctl.calibration.landing import click, handoff_errors_px, pointing_error_px, seen
from mastctl.calibration.run import FITS, Method
from tools.sim_survey.plan import SurveyPlan
from tools.sim_survey.survey import simulate_survey

METHODS: tuple[Method, ...] = ("paper", "joint")
PAPER_STATION_M = 0.002


@dataclass(frozen=True)
class Variant:
    """One point of a study: what the survey is like and how it is fitted."""

    study: str
    label: str
    value: float
    method: Method = "joint"
    mast_parameters: int = 6
    plan: SurveyPlan = field(default_factory=SurveyPlan)


def variants() -> tuple[Variant, ...]:
    """Return everything that is varied, one thing at a time from the paper's survey."""
    base = SurveyPlan()
    found: list[Variant] = []
    for method in METHODS:
        for count in (2, 3, 4, 5, 6, 8, 12, 18):
            plan = replace(base, mast_boards=count)
            found.append(Variant(f"placements, {method}", f"{count}", count, method, 6, plan))
    for method in METHODS:
        for count in (2, 4, 8, 12):
            plan = replace(base, rings=tuple(replace(ring, boards=count) for ring in base.rings))
            found.append(Variant(f"boards, {method}", f"{count}", count, method, 6, plan))
    for method in METHODS:
        for station_m in (0.0005, 0.001, 0.002, 0.004):
            plan = replace(base, sigma=Sigma(station_m, 0.1))
            label = f"{1000 * station_m:g} mm"
            found.append(Variant(f"station, {method}", label, 1000 * station_m, method, 6, plan))
    for prisms in (3, 4):
        found.append(Variant("prisms", f"{prisms}", prisms, "joint", 6, replace(base, prisms=prisms)))
    for also in ("", "navcam"):
        rings = tuple(replace(r, also=also) if r.pair == "hazcam" else r for r in base.rings)
        label = f"seen by {also} too" if also else "seen by hazcam"
        found.append(Variant("hazcam boards", label, float(bool(also)), plan=replace(base, rings=rings)))
    paper = replace(base, sigma=Sigma(PAPER_STATION_M, 0.1))
    for parameters in (4, 6, 8):
        found.append(Variant("mast parameters", f"{parameters}", parameters, "paper", parameters, paper))
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
    seconds
        Of the fit.
    """

    variant: Variant
    failure: str = ""
    pointing_px: Mapping[float, FloatArray] = field(default_factory=dict)
    exact_px: Mapping[float, FloatArray] = field(default_factory=dict)
    handoff_px: Mapping[Handoff, FloatArray] = field(default_factory=dict)
    mast: FloatArray = field(default_factory=lambda: np.full(8, np.nan))
    sigma: FloatArray = field(default_factory=lambda: np.full(8, np.nan))
    mast_rms_px: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    seconds: float = 0.0


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
        fit.seconds,
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


PAPER_TABLE_V: Mapping[int, Mapping[str, tuple[float, float]]] = {
    6: {"pancam": (0.854, 1.102), "navcam": (1.129, 1.002)},
    4: {"pancam": (2.871, 22.294), "navcam": (2.784, 7.934)},
}


@dataclass(frozen=True, eq=False)
class VariantSummary:
    """All surveys of one variant together."""

    variant: Variant
    surveys: int
    failed: int
    pointing_rms_px: Mapping[float, tuple[float, float]]
    exact_rms_px: Mapping[float, tuple[float, float]]
    handoff_rms_px: Mapping[Handoff, tuple[float, float]]
    handoff_worst_px: Mapping[Handoff, float]
    seconds: float

    @property
    def exact_px(self) -> float:
        """Rms an axis of pointing after exact clicks, over all distances."""
        return _together(self.exact_rms_px)

    def handoff_px(self, name: str) -> float:
        """Rms an axis of a hand-off, over all its distances; not-a-number where there was none."""
        return _together({d: xy for (n, d), xy in self.handoff_rms_px.items() if n == name})

    def handoff_most_px(self, name: str) -> float:
        """Worst of a hand-off, over all its distances; not-a-number where there was none."""
        return max((worst for (n, _), worst in self.handoff_worst_px.items() if n == name), default=np.nan)

    @property
    def pointing_px(self) -> float:
        """Rms an axis of pointing after clicks with noise, over all distances."""
        return _together(self.pointing_rms_px)


@dataclass(frozen=True, eq=False)
class CalibrationExperiment:
    """The whole study."""

    rig: Rig
    seed: int
    surveys: int
    outcomes: tuple[SurveyOutcome, ...]
    seconds: float

    @property
    def summaries(self) -> tuple[VariantSummary, ...]:
        """One a variant, in the order of the study."""
        variants = dict.fromkeys(outcome.variant for outcome in self.outcomes)
        return tuple(
            _summarise(variant, [o for o in self.outcomes if o.variant == variant]) for variant in variants
        )

    def of(self, study: str) -> tuple[SurveyOutcome, ...]:
        """Return the outcomes of one study."""
        return tuple(outcome for outcome in self.outcomes if outcome.variant.study == study)


def survey_tasks(
    rig: Rig, *, surveys: int, targets: int, seed: int, chosen: Sequence[Variant] | None = None
) -> list[SurveyTask]:
    """Return the tasks of a study, for `tools.studies.calibration_survey.one_survey`.

    Parameters
    ----------
    rig
        The true one.
    surveys
        Of each variant.
    targets
        Of each survey, at each distance, and for each hand-off.
    seed
        The same seed gives the same numbers, wherever the tasks run.
    chosen
        Variants; all of `variants` by default.
    """
    every = variants() if chosen is None else tuple(chosen)
    # Every variant has the same seeds: what differs between two is then the variant rather than the draw.
    return [
        SurveyTask(rig, variant, (seed, number), targets) for variant in every for number in range(surveys)
    ]


def _summarise(variant: Variant, outcomes: Sequence[SurveyOutcome]) -> VariantSummary:
    good = [outcome for outcome in outcomes if not outcome.failure]

    def rms(name: str) -> dict[Any, tuple[float, float]]:
        keys = dict.fromkeys(key for outcome in good for key in getattr(outcome, name))
        return {key: rms_px(np.concatenate([getattr(o, name)[key] for o in good])) for key in keys}

    handoffs = dict.fromkeys(key for outcome in good for key in outcome.handoff_px)
    worst = {
        key: float(np.nanmax(np.linalg.norm(np.concatenate([o.handoff_px[key] for o in good]), axis=1)))
        for key in handoffs
    }
    return VariantSummary(
        variant,
        len(outcomes),
        len(outcomes) - len(good),
        rms("pointing_px"),
        rms("exact_px"),
        rms("handoff_px"),
        worst,
        float(np.mean([o.seconds for o in good])) if good else 0.0,
    )


def _together(by_distance: Mapping[float, tuple[float, float]]) -> float:
    """Rms an axis over all distances; not-a-number where there are none."""
    values = np.array(list(by_distance.values()))
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")

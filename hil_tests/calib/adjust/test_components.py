"""Sigmas as residuals show them, kind by kind; the simulator's noise is the truth."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from calib.adjust.noise import Component, found_sigmas, variance_components
from calib.adjust.result import Calibration
from calib.adjust.terms import StationTerm
from calib.adjust.unknowns import ResidualBlock
from calib.calibrate.survey import fit_joint
from calib.geometry.rig import Rig
from calib.geometry.significance import Level
from calib.survey.records import Sigma
from hil_tests.calib.adjust.small_surveys import survey_of
from mastctl.calibration.verdict import judge

OFF = 3.5
"""How many of its own sigmas a found factor may be from the true one."""

STATED = Sigma(station_m=0.001, dot_px=0.1, joint_rad=1e-4)


@lru_cache
def told_otherwise(navcams: Rig, happens: Sigma) -> Calibration:
    """The fit of a survey whose errors are as large as ``happens`` and stated as ``STATED``."""
    return fit_joint(replace(survey_of(navcams, 4, sigma=happens), sigma=STATED))


def by_kind(fit: Calibration) -> dict[str, Component]:
    return {c.kind: c for c in fit.components}


@pytest.mark.parametrize(
    ("happens", "wrong", "factor"),
    [
        (replace(STATED, station_m=0.003), {"tapes", "prisms"}, 3.0),
        (replace(STATED, dot_px=0.25), {"dots of navcam_left", "dots of navcam_right"}, 2.5),
        (replace(STATED, joint_rad=4e-4), {"joint readings"}, 4.0),
        (STATED, set(), 1.0),
    ],
    ids=["station", "dots", "joints", "as stated"],
)
def test_the_kind_that_is_worse_than_stated_is_found_and_no_other(
    navcams: Rig, happens: Sigma, wrong: set[str], factor: float
) -> None:
    fit = told_otherwise(navcams, happens)
    found = by_kind(fit)
    assert {kind for kind, c in found.items() if c.wrong} == wrong
    for kind, c in found.items():
        if np.isnan(c.factor):  # too little redundancy to say anything, as it should say
            assert kind not in wrong
            continue
        expected = factor if kind in wrong else 1.0
        assert abs(c.factor - expected) < OFF * c.factor_sigma, c


OTHER_KIND = pytest.mark.long(4, "measurements better than stated; worse ones are in the quick run")


@pytest.mark.parametrize(
    "happens",
    [
        replace(STATED, station_m=0.003),
        pytest.param(replace(STATED, station_m=0.0004), marks=OTHER_KIND),
        pytest.param(replace(STATED, dot_px=0.025), marks=OTHER_KIND),
    ],
    ids=["station worse", "station better", "dots better"],
)
def test_the_covariance_is_that_of_the_errors_that_happened(navcams: Rig, happens: Sigma) -> None:
    """A survey that states the truth has it; one that states too much or too little must come to the same."""
    fit = told_otherwise(navcams, happens)
    honest = fit_joint(survey_of(navcams, 4, sigma=happens))
    n = len(fit.part("mast."))
    ratio = np.sqrt(np.diag(fit.covariance)[:n] / np.diag(honest.covariance)[:n])
    assert np.abs(ratio - 1.0).max() < 0.15, ratio
    assert np.abs(fit.estimate[:n] - honest.estimate[:n]).max() < 1e-3


def test_a_sigma_that_is_too_large_is_reported_and_harms_nothing(navcams: Rig) -> None:
    stated = Sigma(station_m=0.003, dot_px=0.3, joint_rad=3e-4)
    survey = replace(survey_of(navcams, 4, sigma=STATED), sigma=stated)
    fit = fit_joint(survey)
    assert fit.chi2 < 0.2 * fit.degrees_of_freedom
    found = by_kind(fit)
    for kind in ("tapes", "dots of navcam_left", "dots of navcam_right"):
        assert found[kind].generous and found[kind].weighed == pytest.approx(1 / 3, rel=0.25)
    told = [r for r in judge(survey, fit).reasons if "times their stated sigma: 0.1 px" in r.sentence]
    assert len(told) == 2 and {r.grade for r in told} == {"good"}


def test_luck_with_few_numbers_narrows_nothing() -> None:
    few = Component("prisms", 24, 8.0, 0.5, 0.1, 1.0, 0.99, 0.02)
    many = Component("dots of navcam_left", 800, 700.0, 0.97, 0.03, 1.0, 0.9, 0.1)
    assert found_sigmas([few, many]) == {"prisms": 1.0, "dots of navcam_left": 1.0}


@pytest.mark.parametrize("kinds", [1, 4])
def test_right_sigmas_are_called_wrong_as_seldom_as_stated_all_kinds_together(kinds: int) -> None:
    others = [Component(f"dots of c{k}", 800, 700.0, 1.0, 0.03, 1.0, 0.5, 0.5) for k in range(1, kinds)]
    chances = (np.arange(16_000) + 0.5) / 16_000  # what right sigmas give: every chance as often as any other

    def alarms(**options: bool) -> float:
        found = [
            found_sigmas(
                [Component("dots of c0", 800, 700.0, 1.1, 0.03, 1.0, p, 1.0 - p), *others], **options
            )
            for p in chances.tolist()
        ]
        return kinds * float(np.mean([one["dots of c0"] != 1.0 for one in found]))

    assert alarms() == pytest.approx(Level.STATED, rel=0.11)
    assert alarms(narrows=False) == pytest.approx(Level.STATED, rel=0.11), "one side alone has it all"


def heights(sigma_m: float, count: int, rng: np.random.Generator) -> list[tuple[StationTerm, ResidualBlock]]:
    """One unknown height, measured so often: a mean, whose redundancy is one less than the measurements."""
    term = StationTerm("s", ("s", "b"), "a", np.zeros(3), np.zeros(3), 1.0)
    measured = rng.normal(0.0, sigma_m, count)
    return [(term, ResidualBlock(np.array([m]), np.ones((1, 1)), np.array([0]))) for m in measured]


def test_of_a_mean_it_is_the_sample_variance() -> None:
    blocks = heights(2.0, 40, np.random.default_rng(1))
    every = np.array([float(b.residual[0]) for _, b in blocks])
    centred = [(t, replace(b, residual=b.residual - every.mean())) for t, b in blocks]
    (found,) = variance_components(centred, np.array([[1 / 40]]))
    assert found.redundancy == pytest.approx(39)
    assert found.factor == pytest.approx(every.std(ddof=1))
    assert found.factor_sigma == pytest.approx(found.factor / np.sqrt(2 * 39))


def test_tapes_and_prisms_share_a_sigma_unless_they_cannot() -> None:
    tapes = Component("tapes", 300, 270.0, 3.0, 0.13, 1.0, 1e-30)
    few = Component("prisms", 24, 12.0, 2.0, 0.4, 1.0, 0.01)
    assert found_sigmas([tapes, few])["prisms"] == found_sigmas([tapes, few])["tapes"] > 2.9
    good = replace(tapes, factor=1.0, chance=0.5)
    bad = replace(few, factor=4.0, chance=1e-20)
    apart = found_sigmas([good, bad])
    assert apart == {"tapes": 1.0, "prisms": 4.0}

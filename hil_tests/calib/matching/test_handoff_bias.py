"""The constant offset of hand-offs: sign, size, significance and words."""

from __future__ import annotations

import numpy as np
import pytest

from calib.geometry.handoff import Joints
from calib.geometry.significance import chance, sigmas
from calib.matching.handoff import Landed, MatchedHandoff, handoff_bias


def record(off_px: np.ndarray) -> list[MatchedHandoff]:
    """One hand-off to hazcam_left for each offset, every fifth one not accepted in hazcam_right."""
    made = []
    for index, off in enumerate(off_px):
        there = np.array([300.0 + index, 200.0])
        landed = {
            "hazcam_left": Landed(there, 0.01 * np.eye(2), "accepted", "", there + off, 0.02 * np.eye(2)),
            "hazcam_right": Landed(there, 0.01 * np.eye(2), "flat", "no texture"),
        }
        made.append(
            MatchedHandoff(
                "2026-01-01T00:00:00Z", "d", ("navcam_left", "navcam_right"), Joints(0.0, 0.0),
                np.zeros((2, 2)), 0.2, Joints(0.0, 0.0), landed,
            )
        )  # fmt: skip
    return made


def test_an_offset_is_told_with_its_sign_sigma_and_number() -> None:
    rng = np.random.default_rng(1)
    (bias,) = handoff_bias(record(np.array([1.8, -0.7]) + rng.normal(0.0, 0.43, (24, 2))))
    assert bias.handoffs == 24 and bias.left_out == 0
    # 0.4 px of model, 0.1 and 0.14 px of noise: 0.436 px a hand-off, 0.089 px their mean.
    assert np.sqrt(bias.covariance_px2[0, 0]) == pytest.approx(0.089, rel=0.25)
    assert np.abs(bias.offset_px - [1.8, -0.7]).max() < 0.3
    assert bias.significant and bias.sigmas > 15
    assert bias.sentence.startswith("hazcam_left sees targets 1.") and "px right and 0." in bias.sentence
    assert "px higher of where navcam puts them" in bias.sentence and "24 hand-offs" in bias.sentence


def test_larger_noise_alone_is_significant_as_rarely_as_stated() -> None:
    rng = np.random.default_rng(2)
    for true_px in (0.436, 1.5):
        chances = np.array(
            [handoff_bias(record(rng.normal(0.0, true_px, (10, 2))))[0].chance for _ in range(300)]
        )
        assert 2 <= np.sum(chances < 0.05) <= 30  # 15 expected


def test_a_blunder_does_not_make_an_offset() -> None:
    rng = np.random.default_rng(3)
    off = rng.normal(0.0, 0.43, (20, 2))
    off[4] = (30.0, -20.0)
    (bias,) = handoff_bias(record(off))
    assert bias.left_out == 1 and not bias.significant


@pytest.mark.parametrize("apart_px", [0.1, 5.0, 400.0])
def test_of_two_offsets_both_count_however_far_apart(apart_px: float) -> None:
    (bias,) = handoff_bias(record(np.array([[0.0, 1.0], [apart_px, 1.0]])))
    assert bias.handoffs == 2 and bias.left_out == 0
    assert bias.offset_px == pytest.approx([apart_px / 2, 1.0])
    # half their distance, or what the matches' sigma says of a mean of two
    assert np.sqrt(bias.covariance_px2[0, 0]) >= max(0.43 / np.sqrt(2.0), apart_px / np.sqrt(8.0) * 0.99)


def test_significance_is_that_of_the_normal_distribution() -> None:
    # Standard tables: 5 % of chi-square with two degrees of freedom, 5 % of F(2, 10); two and three sigma.
    assert chance(5.991, 2) == pytest.approx(0.05, abs=1e-4)
    assert chance(2 * 4.103 * 3.0, 2, 3.0, 10) == pytest.approx(0.05, abs=1e-4)
    assert sigmas(0.0455) == pytest.approx(2.0, abs=1e-3)
    assert sigmas(0.0027) == pytest.approx(3.0, abs=1e-3)
    assert sigmas(0.0) == 37.0 and sigmas(1.0) == 0.0

"""Chances of misfits, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import chdtrc

from calib.geometry.significance import chance_of_sum, rare_sum


@pytest.mark.parametrize("total", [2.0, 12.0, 30.0, 60.0, 90.0])
def test_the_chance_of_a_weighted_sum_of_squares_is_that_of_its_closed_form(total: float) -> None:
    """Pairs of equal weights a and b: the sum of two exponential numbers of means 2a and 2b."""
    a, b = 3.0, 0.5
    exact = (a * np.exp(-total / (2 * a)) - b * np.exp(-total / (2 * b))) / (a - b)
    found = chance_of_sum(total, np.array([a, a, b, b]))
    assert found == pytest.approx(exact, rel=0.06)
    if exact < 0.5:
        assert rare_sum(found, np.array([a, a, b, b])) == pytest.approx(total, rel=1e-6)


def test_one_large_weight_among_many_small_ones_decides_far_out() -> None:
    """One square counts 1, and 1000 others 0.01 each: ten, give or take half of one, and that one square. A
    chi-square of the same mean and variance (220 degrees of freedom) gives 3e-10."""
    weights = np.array([1.0, *[0.01] * 1000])
    draws = np.random.default_rng(1).standard_normal((200000, 2))
    simulated = np.mean(draws[:, 0] ** 2 + 10.0 + np.sqrt(0.2) * draws[:, 1] > 20.0)
    assert chance_of_sum(20.0, weights) == pytest.approx(simulated, rel=0.1)


@pytest.mark.parametrize("freedom", [1, 2, 7, 300])
def test_equal_weights_are_chi_square(freedom: int) -> None:
    for total in np.array([0.3, 1.0 - 1e-9, 1.0, 1.0 + 1e-9, 1.5, 3.0]) * freedom:
        exact = float(chdtrc(freedom, total))
        assert chance_of_sum(2.0 * total, np.full(freedom, 2.0)) == pytest.approx(exact, rel=0.06)


@pytest.mark.parametrize("total", [1e4, 1e8, 5e9, 5e10])
@pytest.mark.parametrize("others", [0, 40])
def test_a_sum_that_nothing_explains_has_no_chance(total: float, others: int) -> None:
    """Check pictures of another placement are hundreds of pixels off, a sum 1e10 times the largest weight."""
    assert chance_of_sum(total, np.array([1.0, *[0.1] * others])) == 0.0

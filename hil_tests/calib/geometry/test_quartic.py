"""Real roots of quartics within an interval, against roots chosen first."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.geometry.reach import roots_between

NEAR = 1e-6
SEEDS = 40


@pytest.mark.parametrize("tiny", [0.0, 1e-300, 1e-30, 1e-15])
def test_leading_coefficients_may_vanish(tiny: float) -> None:
    np.testing.assert_allclose(
        roots_between((tiny, tiny, 1.0, -1.0, -2.0), -5.0, 5.0), [-1.0, 2.0], atol=NEAR
    )


def test_a_root_between_two_level_turns_is_found() -> None:
    """t³ - 3 t is level at -1 and at 1 exactly, where a search for the root between them begins."""
    expected = np.sort(np.roots([1.0, 0.0, -3.0, 0.5]).real)
    np.testing.assert_allclose(roots_between((0.0, 1.0, 0.0, -3.0, 0.5), -3.0, 3.0), expected, atol=NEAR)


def test_a_minimum_just_above_zero_counts_only_when_asked() -> None:
    nearly_double = (0.0, 0.0, 1.0, -2.0, 1.0 + 1e-13)
    assert roots_between(nearly_double, -5.0, 5.0) == []
    assert roots_between(nearly_double, -5.0, 5.0, touching=1e-12) == pytest.approx([1.0])


@given(st.lists(st.floats(-1e6, 1e6), min_size=5, max_size=5))
def test_whatever_comes_back_is_a_change_of_sign(coefficients: list[float]) -> None:
    c = np.array(coefficients)
    for root in roots_between(tuple(coefficients), -10.0, 10.0):
        assert -10.0 <= root <= 10.0
        size = np.polyval(np.abs(c), abs(root))
        slope = abs(np.polyval(np.polyder(c), root))
        assert abs(np.polyval(c, root)) <= 1e-12 * size + 1e-12 * slope * (abs(root) + 1.0) + 1e-300

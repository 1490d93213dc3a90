"""Quaternions worked by hand: the order of their parts, their length and their sign."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calib.geometry.rigid import quaternion_of, rot_x, rotation_of

SAME = 1e-14


def test_a_third_of_a_turn_about_the_diagonal_makes_y_of_x_and_z_of_y() -> None:
    turn = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    assert_allclose(rotation_of([3.0, 3.0, 3.0, 3.0]), turn, atol=SAME)
    assert_allclose(quaternion_of(np.array(turn)), [0.5, 0.5, 0.5, 0.5], atol=SAME)


@pytest.mark.parametrize("angle_rad", [0.0, 0.3, -0.3, 3.0, -3.0, np.pi - 1e-9])
def test_a_turn_about_x_has_half_the_angle_and_no_negative_w(angle_rad: float) -> None:
    half = [np.cos(angle_rad / 2), np.sin(angle_rad / 2), 0.0, 0.0]
    assert_allclose(quaternion_of(rot_x(angle_rad)), half, atol=SAME)
    assert_allclose(rotation_of(np.negative(half)), rot_x(angle_rad), atol=SAME)

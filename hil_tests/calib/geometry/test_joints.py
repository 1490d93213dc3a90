"""Read and true angles: the contract's formula, found again by a root finder that knows nothing of it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import approx_fprime, brentq

from calib.geometry.covariance import moved_rig, pixel_rates
from calib.geometry.rig import JOINTS_NAMES, AxisJoint, JointErrors, Rig, joint_numbers_of, joints_of

INVERSE_RAD = 1e-12
RATE = 1e-6

harmonic = st.tuples(st.floats(-0.03, 0.03), st.floats(-0.03, 0.03))
angle = st.floats(-2 * math.pi, 2 * math.pi)
side = st.sampled_from([-1, 0, 1])


def by_hand(read: float, side: int, c1: float, s1: float, c2: float, s2: float, b: float) -> float:
    """The contract's section 2, spelled out."""
    u = read - b / 2 if side > 0 else read + b / 2 if side < 0 else read
    return u + c1 * math.cos(u) + s1 * math.sin(u) + c2 * math.cos(2 * u) + s2 * math.sin(2 * u)


@given(angle, side, harmonic, harmonic, st.floats(0.0, 0.01))
@settings(max_examples=60)
def test_a_true_angle_is_led_back_to_the_reading_that_a_root_finder_finds(
    true: float, side: int, first: tuple[float, float], second: tuple[float, float], b: float
) -> None:
    joint = AxisJoint((first, second), b)

    def off(read: float) -> float:
        return by_hand(read, side, *first, *second, b) - true

    root = brentq(off, true - 1.0, true + 1.0, xtol=1e-15, rtol=1e-15)
    read = joint.read_rad(true, side)
    assert abs(read - root) < INVERSE_RAD
    assert abs(joint.true_rad(read, side) - true) < INVERSE_RAD
    assert abs(joint.true_rad(root, side) - by_hand(root, side, *first, *second, b)) < 1e-14


@given(angle, st.sampled_from([-1.0, 1.0]), harmonic, harmonic)
@settings(max_examples=40)
def test_its_rates_are_those_that_differences_give(
    read: float, side: float, first: tuple[float, float], second: tuple[float, float]
) -> None:
    numbers = np.array([*first, *second, 0.004])

    def moved(at: np.ndarray) -> float:
        return by_hand(read, int(side), *at.tolist())

    joint = AxisJoint((first, second), 0.004)
    np.testing.assert_allclose(joint.rates(read, side), approx_fprime(numbers, moved, 1e-7), atol=RATE)
    by_read = approx_fprime(np.array([read]), lambda at: by_hand(float(at[0]), int(side), *numbers), 1e-7)
    assert joint.slope(read, int(side)) == pytest.approx(float(by_read[0]), abs=RATE)


def test_harmonics_as_large_as_are_taken_lead_back_from_every_angle() -> None:
    joint = AxisJoint(((0.0, 0.05), (0.1, 0.0)), 0.1)
    true = np.linspace(-7.0, 7.0, 2001)
    sides = np.resize([-1.0, 0.0, 1.0], true.shape)
    again = joint.true_rad(joint.read_rad(true, sides), sides)
    np.testing.assert_allclose(again, true, rtol=0.0, atol=INVERSE_RAD)


def test_joints_without_errors_change_no_bit() -> None:
    joints = JointErrors()
    assert joints.reads_true
    for one in (0.1, -2.7, 1e-300, 3.0):
        assert joints.true_rad((one, -one), (1, -1)) == (one, -one) == joints.read_rad((one, -one), (-1, 1))


def test_backlash_is_half_on_either_side_and_none_in_the_middle() -> None:
    joint = AxisJoint((), 0.004)
    assert [joint.true_rad(0.5, side) for side in (1, -1, 0)] == [0.498, 0.502, 0.5]


def test_ten_numbers_make_the_joints_again() -> None:
    joints = JointErrors(AxisJoint(((0.001, 0.002),), 0.003), AxisJoint(((0.004, 0.0), (0.0, 0.006))))
    numbers = joint_numbers_of(joints)
    told = dict(zip(JOINTS_NAMES, numbers.tolist(), strict=True))
    assert told["joints.pan.s1"] == 0.002 and told["joints.tilt.s2"] == 0.006
    assert told["joints.pan.backlash_rad"] == 0.003 and told["joints.pan.c2"] == 0.0
    assert joints_of(numbers) == joints


@pytest.mark.parametrize(
    ("harmonics", "backlash", "words"),
    [
        (((0.1, 0.0), (0.1, 0.0)), 0.0, "in a radian where at most 0.25"),
        (((0.1, 0.0),) * 3, 0.0, "3 pairs where 2 at most"),
        (((math.nan, 0.0),), 0.0, "finite"),
        ((), 0.3, "backlash_rad is 0.3 rad where at most 0.2"),
    ],
)
def test_what_cannot_be_led_back_is_refused(
    harmonics: tuple[tuple[float, float], ...], backlash: float, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        AxisJoint(harmonics, backlash)


def test_pixels_move_with_the_joints_numbers_as_differences_say(true_rig: Rig) -> None:
    joints = JointErrors(
        AxisJoint(((0.005, -0.003), (0.001, 0.002)), 0.004), AxisJoint(((0.0, 0.002),), 0.003)
    )
    rig, read, approach = replace(true_rig, joints=joints), (0.4, -0.3), (1.0, -1.0)
    names = ("mast.rotation_rad.x", *JOINTS_NAMES, "tilt_rad")
    at = joints.true_rad(read, approach)
    point = rig.mast.rover_from_head(*at).points(np.array([[4.0, 0.3, 0.2]]))

    def seen(rig: Rig) -> np.ndarray:
        camera = rig.camera_in_rover("navcam_left", *rig.joints.true_rad(read, approach))
        return np.asarray(camera.project(point)[0][0])

    rates = pixel_rates(rig, names, "navcam_left", *at, point, approach).to_rig
    step = 1e-6
    for name in names[:-1]:
        up, down = (moved_rig(rig, (name,), np.array([sign * step])) for sign in (1.0, -1.0))
        by_difference = (seen(up) - seen(down)) / (2 * step)
        np.testing.assert_allclose(rates[0, :, names.index(name)], by_difference, atol=2e-3, err_msg=name)
    turned = [
        rig.camera_in_rover("navcam_left", at[0], at[1] + d).project(point)[0][0] for d in (step, -step)
    ]
    np.testing.assert_allclose(rates[0, :, -1], (turned[0] - turned[1]) / (2 * step), atol=2e-3)

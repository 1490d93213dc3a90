"""Soft limits: the bound itself is allowed, one step beyond is not, and nothing that is no number passes."""

from __future__ import annotations

import math

import pytest

from mastctl.devices.judge import Limits, OutsideLimits

LIMITS = Limits((-2.6, 2.6), (-1.2, 1.57), 1.0)


@pytest.mark.parametrize(("pan", "tilt"), [(0.0, 0.0), (-2.6, -1.2), (2.6, 1.57)])
def test_angles_up_to_the_bounds_pass(pan: float, tilt: float) -> None:
    LIMITS.check(pan, tilt)


@pytest.mark.parametrize(
    ("pan", "tilt", "what"),
    [
        (math.nextafter(2.6, 3), 0.0, "pan"),
        (math.nextafter(-2.6, -3), 0.0, "pan"),
        (0.0, math.nextafter(1.57, 2), "tilt"),
        (0.0, math.nextafter(-1.2, -2), "tilt"),
    ],
)
def test_the_next_number_beyond_a_bound_is_refused_and_told_apart(pan: float, tilt: float, what: str) -> None:
    with pytest.raises(OutsideLimits) as refused:
        LIMITS.check(pan, tilt)
    assert refused.value.detail["what"] == what
    assert refused.value.code == "outside_limits"
    value, bound = str(refused.value).split(" rad is beyond the soft limit ")
    assert value.removeprefix(f"{what} ") != bound.removesuffix(" rad")


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", ["pan", "tilt"])
def test_what_is_not_finite_is_refused(axis: str, value: float) -> None:
    angles = (value, 0.0) if axis == "pan" else (0.0, value)
    with pytest.raises(OutsideLimits, match=f"{axis} .* is not a finite angle"):
        LIMITS.check(*angles)


@pytest.mark.parametrize("speed", [0.0, -0.1, math.nan, math.inf])
def test_a_speed_that_a_servo_could_take_for_full_speed_is_refused(speed: float) -> None:
    with pytest.raises(OutsideLimits, match="finite number above 0"):
        LIMITS.speed(speed)

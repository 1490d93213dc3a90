"""When a head counts as at rest: readings that dither, creep, ring, and a word that flickers."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from calib.geometry.rig import JointErrors
from drivers.interfaces import Reading
from mastctl.devices.joint_history import DITHER_RAD, JointHistory, RestWatch

XM430_RAD = 2 * math.pi / 4096
"""A count of a 12-bit servo."""

D46_HALF_STEP_RAD = math.radians(185.1428 / 3600)
POLL_S = 0.02
DWELL_S = 0.15
Angle = Callable[[float], float]


def first_rest_s(angle: Angle, moving: Callable[[float], bool], within_s: float = 6.0) -> float | None:
    """When a head counts as at rest first, seconds; None if not in time."""
    watch = RestWatch(DWELL_S)
    for n in range(round(within_s / POLL_S)):
        time_s = n * POLL_S
        if watch.rests(Reading(angle(time_s), 0.1, moving(time_s), 50.0 + time_s)):
            return time_s
    return None


def counted(angle_rad: float, count_rad: float = XM430_RAD) -> float:
    return round(angle_rad / count_rad) * count_rad


def dither(count_rad: float, levels: int, seed: int) -> Angle:
    random = np.random.default_rng(seed)
    return lambda time_s: 0.3 + count_rad * int(random.integers(levels))


def flicker(seed: int, share: float = 0.5) -> Callable[[float], bool]:
    random = np.random.default_rng(seed + 1000)
    return lambda time_s: bool(random.random() < share)


def never(time_s: float) -> bool:
    return False


@pytest.mark.parametrize("flickers", [True, False])
@pytest.mark.parametrize(
    ("count_rad", "levels"),
    [
        (XM430_RAD, 2),
        (XM430_RAD, 4),
        (D46_HALF_STEP_RAD, 6),
    ],
)
def test_a_head_whose_counts_dither_comes_to_rest_whatever_its_word(
    count_rad: float, levels: int, flickers: bool
) -> None:
    for seed in range(40):
        rest_s = first_rest_s(dither(count_rad, levels, seed), flicker(seed) if flickers else never)
        assert rest_s is not None and rest_s < 2.5, f"seed {seed}: {rest_s}"


def test_a_head_that_stands_is_at_rest_after_the_dwell() -> None:
    rest_s = first_rest_s(lambda time_s: min(time_s, 0.5), lambda time_s: time_s < 0.5)
    assert rest_s == pytest.approx(0.5 + DWELL_S, abs=2 * POLL_S)


@pytest.mark.parametrize("speed_rad_per_s", [0.004, 0.012, 0.05])
@pytest.mark.parametrize("flickers", [True, False])
def test_a_head_that_creeps_never_rests(speed_rad_per_s: float, flickers: bool) -> None:
    said = flicker(1) if flickers else never
    assert first_rest_s(lambda time_s: speed_rad_per_s * time_s, said) is None


def test_a_slow_creep_under_a_dither_never_rests() -> None:
    for seed in range(20):
        shaken = dither(XM430_RAD, 2, seed)
        angle = lambda time_s: shaken(time_s) + counted(0.005 * time_s)  # noqa: B023, E731
        assert first_rest_s(angle, flicker(seed)) is None, seed


def test_a_creep_that_was_seen_is_no_rest_between_two_counts() -> None:
    """At 5 mrad/s a count takes 0.3 s, twice the dwell: who creeps to its goal stands in between."""

    def angle(time_s: float) -> float:
        return counted(0.1 * time_s if time_s < 0.1 else 0.01 + 0.005 * (time_s - 0.1))

    assert first_rest_s(angle, lambda time_s: time_s < 0.5) is None


@pytest.mark.parametrize("hz", [0.7, 3.0, 8.0])
def test_a_head_that_rings_beyond_a_dither_never_rests(hz: float) -> None:
    ring: Angle = lambda time_s: 0.55 * DITHER_RAD * math.sin(2 * math.pi * hz * time_s)  # noqa: E731
    assert first_rest_s(ring, never) is None
    assert first_rest_s(ring, flicker(3)) is None


def test_a_head_that_always_says_that_it_moves_does_not_rest() -> None:
    assert first_rest_s(lambda time_s: 0.3, lambda time_s: True) is None
    assert first_rest_s(dither(XM430_RAD, 2, 5), lambda time_s: time_s > 0.01) is None


# In frames and in the status


def history(flags: Callable[[int], bool], angle: Callable[[int], float], count: int = 60) -> JointHistory:
    made = JointHistory(JointErrors())
    for n in range(count):
        made.add(Reading(angle(n), 0.0, flags(n), 10.0 + 0.05 * n))
    return made


def at_the_end(made: JointHistory, count: int = 60) -> bool:
    end_s = 10.0 + 0.05 * (count - 1) - 0.001
    return made.at_exposure(end_s - 0.05, end_s - 0.025, end_s, "head").moving


def shaking(n: int) -> float:
    return XM430_RAD * (n * 7 % 3 - 1)


def test_frames_of_a_head_that_dithers_at_rest_were_taken_at_rest() -> None:
    made = history(lambda n: n % 2 == 1, shaking)
    assert not at_the_end(made)
    assert made.newest is not None and not made.newest.moving


@pytest.mark.parametrize(
    ("flags", "angle"),
    [
        (lambda n: n % 2 == 1, lambda n: shaking(n) + (0.01 if n > 57 else 0.0)),
        (lambda n: n > 57, lambda n: 0.0),
        (lambda n: n > 30, shaking),
        (lambda n: n % 8 > 0, shaking),
        (lambda n: n % 2 == 1, lambda n: 0.0002 * n),
        (lambda n: n % 2 == 1, lambda n: 3 * shaking(n)),
    ],
    ids=["goes off", "begins to move", "says so all the time", "says so mostly", "creeps", "shakes more"],
)
def test_frames_of_a_head_that_moves_were_taken_in_motion(
    flags: Callable[[int], bool], angle: Callable[[int], float]
) -> None:
    made = history(flags, angle)
    assert at_the_end(made)
    assert made.newest is not None and made.newest.moving == flags(59)


def test_a_dither_is_no_rest_within_a_second_of_a_move() -> None:
    made = history(lambda n: n % 2 == 1, shaking)
    made.move_sent(10.0 + 0.05 * 45)
    assert at_the_end(made)
    made.add(Reading(0.0, 0.0, True, 13.0))
    assert made.newest is not None and made.newest.moving

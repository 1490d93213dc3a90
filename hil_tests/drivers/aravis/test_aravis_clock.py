"""The camera's clock tied to ours, by hand-worked cases: the bounds, and the window that follows."""

from __future__ import annotations

import pytest

from drivers.aravis.camera import DRIFT, CameraClock, ClockStepped
from drivers.aravis.device import WallClock

AHEAD_S = 1000.0  # the camera's clock before ours
ROUNDING_S = 1e-9


def read(clock: CameraClock, before_s: float, after_s: float, latched_s: float) -> None:
    clock.read(before_s, latched_s + AHEAD_S, after_s)


def test_a_reading_bounds_the_difference_by_its_round_trip() -> None:
    clock = CameraClock(0.02)
    read(clock, 50.0, 50.002, 50.001)
    assert clock.low_s == pytest.approx(-AHEAD_S - 0.001, abs=ROUNDING_S)
    assert clock.high_s == pytest.approx(-AHEAD_S + 0.001, abs=ROUNDING_S)


def test_bounds_widen_by_the_drift_until_they_are_narrowed_again() -> None:
    clock = CameraClock(0.02)
    read(clock, 50.0, 50.0, 50.0)
    read(clock, 60.0, 60.1, 60.05)  # a slow answer tells less than ten seconds of drift lose
    assert clock.high_s - clock.low_s == pytest.approx(2 * 10.1 * DRIFT, abs=1e-6)
    read(clock, 61.0, 61.0002, 61.0001)
    assert clock.high_s - clock.low_s == pytest.approx(0.0002, abs=1e-6)


def test_without_readings_the_quickest_arrival_is_the_upper_bound() -> None:
    clock = CameraClock(0.015)
    for stamp_s, delay_s in ((1.0, 0.030), (1.04, 0.011), (1.08, 0.020)):
        clock.arrived(stamp_s + AHEAD_S, stamp_s + delay_s)
    drifted_s = 0.05 * DRIFT
    assert clock.high_s == pytest.approx(-AHEAD_S + 0.011, abs=drifted_s)
    assert clock.low_s == pytest.approx(-AHEAD_S + 0.011 - 0.015, abs=drifted_s)
    clock.arrived(3600.0 + AHEAD_S, 3600.02)  # an hour later: the old bound has grown beyond it
    assert clock.high_s == pytest.approx(-AHEAD_S + 0.02, abs=ROUNDING_S)


def test_a_clock_that_was_set_is_noticed_by_reading_it() -> None:
    clock = CameraClock(0.02)
    read(clock, 50.0, 50.001, 50.0005)
    with pytest.raises(ClockStepped, match=r"off by 0\.4"):
        read(clock, 51.0, 51.001, 51.0005 - 0.5)


def test_a_frame_that_comes_before_its_stamp_shows_a_clock_that_was_set() -> None:
    clock = CameraClock(0.02)
    read(clock, 50.0, 50.001, 50.0005)
    with pytest.raises(ClockStepped):
        clock.arrived(51.0 + AHEAD_S, 50.9)


def tied() -> CameraClock:
    clock = CameraClock(0.02)
    read(clock, 50.0, 50.002, 50.001)
    return clock


@pytest.mark.parametrize(
    ("stamped", "begin_s", "end_s"),
    [("start", 0.0, 0.01), ("end", -0.01, 0.0), ("either", -0.01, 0.01)],
)
def test_a_window_holds_the_exposure_by_what_is_stamped(stamped: str, begin_s: float, end_s: float) -> None:
    window = tied().window(50.5 + AHEAD_S, stamped, 0.01, 51.0)  # type: ignore[arg-type]
    assert window.begin_s == pytest.approx(50.5 + begin_s - 0.001, abs=ROUNDING_S)
    assert window.end_s == pytest.approx(50.5 + end_s + 0.001, abs=ROUNDING_S)


def test_a_window_ends_when_the_frame_comes() -> None:
    window = tied().window(50.5 + AHEAD_S, "either", 0.01, 50.506)
    assert window.end_s == 50.506


def test_a_wall_clock_that_was_set_changes_no_frames_age() -> None:
    wall, ahead_s = WallClock(), 1.7e9
    assert wall.ago_s(9.99 + ahead_s, 10.0 + ahead_s, 10.0) == 0.0  # nothing to compare with yet
    assert wall.ago_s(10.09 + ahead_s, 10.1 + ahead_s, 10.1) == pytest.approx(0.01, abs=1e-6)
    for step_s in (0.5, -0.5):  # set between the packet and the taking, and for a while after
        stamped_s, ahead_s = 10.19 + ahead_s, ahead_s + step_s
        assert [wall.ago_s(stamped_s, 10.2 + ahead_s, 10.2) for _ in range(8)] == [0.0] * 8
        assert wall.ago_s(10.19 + ahead_s, 10.2 + ahead_s, 10.2) == pytest.approx(0.01, abs=1e-6)

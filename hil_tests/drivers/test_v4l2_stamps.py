"""When a frame was exposed, by its stamp: cases worked by hand, for a camera of 25 Hz and 10 ms exposure."""

from __future__ import annotations

import pytest

from drivers.v4l2 import abi
from drivers.v4l2.stamps import StampCheck, StampRule, Window, exposure_window

START = abi.BUF_FLAG_TIMESTAMP_MONOTONIC | 0x10000
END = abi.BUF_FLAG_TIMESTAMP_MONOTONIC
KNOWN = StampRule(period_s=0.040, exposure_s=0.010, margin_s=0.001)
UNKNOWN = StampRule(period_s=0.040, exposure_s=None, margin_s=0.0)
UVC = StampRule(period_s=0.040, exposure_s=0.010, margin_s=0.0, driver="uvcvideo")


def window(rule: StampRule, flags: int, received_s: float = 200.0) -> tuple[float, float]:
    found = exposure_window(rule, flags, 100.0, received_s)
    return found.begin_s, found.end_s


def test_a_stamp_at_the_start_begins_the_window() -> None:
    assert window(KNOWN, START) == pytest.approx((99.999, 100.050))


def test_a_stamp_at_the_end_leaves_room_for_readout_and_exposure() -> None:
    assert window(KNOWN, END) == pytest.approx((99.949, 100.000))


def test_an_unknown_exposure_may_last_a_whole_period() -> None:
    assert window(UNKNOWN, START) == pytest.approx((100.0, 100.080))
    assert window(UNKNOWN, END) == pytest.approx((99.920, 100.0))


def test_uvcvideo_stamps_the_readout_whatever_it_says() -> None:
    assert window(UVC, START) == pytest.approx((99.990, 100.040))


def test_nothing_is_exposed_after_it_was_received() -> None:
    assert window(KNOWN, START, received_s=100.012) == pytest.approx((99.999, 100.012))


def test_the_true_exposure_lies_in_the_window_for_every_kind_of_stamp() -> None:
    # A rolling shutter: first row exposed [t, t+e], last row [t+r, t+r+e]; readout [t+e, t+e+r].
    begin_s, exposure_s, readout_s = 50.0, 0.010, 0.030
    end_s = begin_s + exposure_s + readout_s
    rule = StampRule(0.040, exposure_s, 0.0)
    for stamp_s, flags, driver in (
        (begin_s, START, ""),
        (begin_s + exposure_s, START, "uvcvideo"),
        (end_s, END, ""),
        (end_s, END, "uvcvideo"),
    ):
        found = exposure_window(StampRule(0.040, exposure_s, 0.0, driver), flags, stamp_s, end_s + 0.002)
        assert found.begin_s <= begin_s + 1e-9 and found.end_s >= end_s - 1e-9, (flags, driver)
        assert abs(found.mid_s - (begin_s + end_s) / 2) <= found.mid_uncertainty_s(rule.exposure_s)


def test_the_uncertainty_of_the_middle_shrinks_by_a_known_exposure() -> None:
    assert Window(1.0, 1.05).mid_uncertainty_s(None) == pytest.approx(0.025)
    assert Window(1.0, 1.05).mid_uncertainty_s(0.01) == pytest.approx(0.020)
    assert Window(1.0, 1.05).mid_uncertainty_s(0.2) == 0.0


def test_stamps_that_cannot_be_true_are_told() -> None:
    check = StampCheck()
    assert check.wrong_stamp(START, 10.0, 10.001) == ""
    assert check.wrong_stamp(START, 10.04, 10.036) == ""  # ahead by less than 5 ms: rounding
    assert check.wrong_stamp(START, 10.08, 10.05) == "its stamp is 30.0 ms ahead of the clock"
    assert check.wrong_stamp(START, 10.02, 10.1) == "its stamp is 20.0 ms before the last frame's"
    assert check.wrong_stamp(START, 10.06, 10.07) == ""  # neither a step ahead nor back condemns what follows
    assert "monotonic" in check.wrong_stamp(0, 10.2, 10.2)
    assert "monotonic" in check.wrong_stamp(0x4000, 10.3, 10.3)


def test_gaps_in_the_count_are_dropped_frames() -> None:
    check = StampCheck()
    assert [check.dropped_before(n) for n in (7, 8, 11, 12)] == [0, 0, 2, 0]


def test_a_count_that_wraps_is_no_gap() -> None:
    check = StampCheck()
    assert [check.dropped_before(n) for n in (2**32 - 2, 2**32 - 1, 0, 2)] == [0, 0, 0, 1]


def test_a_count_that_begins_again_is_not_four_thousand_million_dropped_frames() -> None:
    check = StampCheck()
    assert [check.dropped_before(n) for n in (1000, 0, 1)] == [0, 0, 0]

"""When a frame was exposed, by its stamp: cases worked by hand, for a camera of 25 Hz and 10 ms exposure."""

from __future__ import annotations

import pytest

from drivers.newest import ExposureWindow
from drivers.v4l2 import abi
from drivers.v4l2.stamps import Spacing, StampCheck, StampRule, Timing, exposure_window
from drivers.values_set import ValuesSet

START = abi.BUF_FLAG_TIMESTAMP_MONOTONIC | 0x10000
END = abi.BUF_FLAG_TIMESTAMP_MONOTONIC
RULE = StampRule(margin_s=0.001)
KNOWN = Timing(exposure_s=0.010, longest_s=0.010, apart_s=0.040, before_apart_s=0.040)
UNKNOWN = Timing(exposure_s=None, longest_s=None, apart_s=0.040, before_apart_s=0.050)
EXACT, UVC = StampRule(margin_s=0.0), StampRule(margin_s=0.0, driver="uvcvideo")


def window(rule: StampRule, timing: Timing, flags: int, received_s: float = 200.0) -> tuple[float, float]:
    found = exposure_window(rule, timing, flags, 100.0, received_s)
    assert found is not None
    return found.begin_s, found.end_s


def test_a_stamp_at_the_start_begins_the_window() -> None:
    assert window(RULE, KNOWN, START) == pytest.approx((99.999, 100.050))


def test_a_stamp_at_the_end_leaves_room_for_readout_and_exposure() -> None:
    assert window(RULE, KNOWN, END) == pytest.approx((99.949, 100.000))


def test_an_unknown_exposure_may_last_as_long_as_its_own_frame() -> None:
    assert window(EXACT, UNKNOWN, START, 100.1) == pytest.approx((100.0, 100.1))  # by the next one's length
    assert window(EXACT, UNKNOWN, END) == pytest.approx((99.910, 100.0))
    assert window(UVC, UNKNOWN, START) == pytest.approx((99.960, 100.040))


def test_an_exposure_longer_than_the_frame_is_taken_as_it_is() -> None:
    longer = Timing(0.1, 0.1, 0.040, 0.040)
    assert window(UVC, longer, START) == pytest.approx((99.900, 100.040))
    assert window(EXACT, longer, END) == pytest.approx((99.860, 100.0))


def test_a_frame_that_nothing_bounds_has_no_window() -> None:
    first, second = Timing(None, None, None, None), Timing(None, None, 0.04, None)
    assert exposure_window(EXACT, first, START, 100.0, 100.1) == ExposureWindow(100.0, 100.1)
    for timing, rule, flags in ((first, UVC, START), (first, EXACT, END), (second, EXACT, END)):
        assert exposure_window(rule, timing, flags, 100.0, 100.1) is None
    known = Timing(0.01, 0.01, None, None)
    assert exposure_window(UVC, known, START, 100.0, 100.1) == ExposureWindow(99.99, 100.1)
    assert exposure_window(EXACT, known, END, 100.0, 100.1) is None


def test_a_frame_has_the_time_before_it_less_that_of_lost_ones() -> None:
    spacing = Spacing(promised_s=0.040, margin_s=0.0)
    assert spacing.see(0, 100.00) == (None, None)
    assert spacing.see(1, 100.04) == (pytest.approx(0.04), None)
    assert spacing.see(2, 100.14) == (pytest.approx(0.10), pytest.approx(0.10))
    assert spacing.see(3, 100.18) == (pytest.approx(0.04), pytest.approx(0.10))
    assert spacing.see(5, 100.28) == (pytest.approx(0.06), pytest.approx(0.06))  # one lost: 0.04 of 0.10
    assert spacing.see(7, 100.33) == (pytest.approx(0.05), pytest.approx(0.06))  # no room for the lost one
    assert spacing.see(8, 99.00) == (None, None)
    assert spacing.see(9, 99.04) == (pytest.approx(0.04), None)


def test_a_period_that_was_neither_promised_nor_seen_is_taken_off_nothing() -> None:
    spacing = Spacing(promised_s=None, margin_s=0.002)
    spacing.see(0, 100.00)
    assert spacing.see(2, 100.08)[0] == pytest.approx(0.08)
    assert spacing.see(3, 100.12)[0] == pytest.approx(0.04)
    assert spacing.see(5, 100.20)[0] == pytest.approx(0.042)  # seen with stamps up to 2 ms late


def test_a_change_of_exposure_surely_shows_from_the_fifth_frame_on() -> None:
    exposures = ValuesSet(0.030)
    assert exposures.of(0, 10.00) == (0.030, 0.030)
    exposures.change(0.002, 10.50, 10.51)
    assert exposures.of(1, 10.40) == (0.030, 0.030)  # it waited while the change was made
    assert exposures.of(2, 10.505) == (None, 0.030)
    assert [exposures.of(n, 10.4 + 0.04 * n) for n in (3, 4, 6)] == [(None, 0.030)] * 3
    assert exposures.of(7, 10.8) == (0.002, 0.002)


def test_of_several_changes_the_longest_may_still_show() -> None:
    exposures = ValuesSet(0.030)
    exposures.change(0.002, 1.0, 1.0)
    exposures.change(0.010, 1.1, 1.1)
    assert exposures.of(0, 1.05) == (None, 0.030)
    assert exposures.of(3, 1.15) == (None, 0.030)
    assert exposures.of(4, 1.20) == (None, 0.010)
    assert exposures.of(7, 1.30) == (0.010, 0.010)
    exposures.change(None, 2.0, 2.0)
    assert exposures.of(8, 2.1) == (None, None)


def test_uvcvideo_stamps_the_readout_whatever_it_says() -> None:
    assert window(UVC, KNOWN, START) == pytest.approx((99.990, 100.040))


def test_nothing_is_exposed_after_it_was_received() -> None:
    assert window(RULE, KNOWN, START, received_s=100.012) == pytest.approx((99.999, 100.012))


def test_the_true_exposure_lies_in_the_window_for_every_kind_of_stamp() -> None:
    # A rolling shutter: first row exposed [t, t+e], last row [t+r, t+r+e]; readout [t+e, t+e+r].
    begin_s, exposure_s, readout_s = 50.0, 0.010, 0.030
    end_s = begin_s + exposure_s + readout_s
    timing = Timing(exposure_s, exposure_s, 0.040, 0.040)
    for stamp_s, flags, driver in (
        (begin_s, START, ""),
        (begin_s + exposure_s, START, "uvcvideo"),
        (end_s, END, ""),
        (end_s, END, "uvcvideo"),
    ):
        found = exposure_window(StampRule(0.0, driver), timing, flags, stamp_s, end_s + 0.002)
        assert found is not None
        assert found.begin_s <= begin_s + 1e-9 and found.end_s >= end_s - 1e-9, (flags, driver)
        assert abs(found.mid_s - (begin_s + end_s) / 2) <= found.mid_uncertainty_s(exposure_s)


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


def test_a_count_that_begins_again_is_no_gap() -> None:
    check = StampCheck()
    assert [check.dropped_before(n) for n in (1000, 0, 1)] == [0, 0, 0]

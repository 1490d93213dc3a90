"""A short share of the campaign on servos: some episodes of some faults with each driver."""

from __future__ import annotations

import pytest

from hil_tests.support.servo_campaign import WORDS, ReadingJudge, ServoRow, run_word
from hil_tests.support.servo_rigs import in_memory

OTHER = pytest.mark.long(3, "the same of other heads; the bus and session of Feetech's are Dynamixel's")
LATER = [pytest.param(name, marks=OTHER) for name in ("feetech", "feetech_echo")]


@pytest.mark.parametrize("driver", ["dynamixel", "ptu", *LATER])
@pytest.mark.parametrize("word", ["corrupt", "swapped", "hang_up", "voltage_dip", "mixture"])
def test_no_fault_makes_a_driver_report_a_wrong_angle(driver: str, word: str) -> None:
    assert word in WORDS
    row = run_word(driver, word, transactions=60, seed=7)
    assert row.calls >= 60 and row.episodes > 0
    assert row.good, row


def test_the_judge_finds_a_wrong_reading_and_a_passed_limit() -> None:
    row = ServoRow("in_memory", "corrupt")
    with in_memory(turned=True) as rig:
        judge = ReadingJudge(rig, row, lying=False)
        reading = rig.head.read()
        judge.reading(reading, reading.time_s, reading.time_s)
        judge.limits()
        assert row.good
        wrong = type(reading)(reading.pan_rad + 3 * rig.count_rad, reading.tilt_rad, False, reading.time_s)
        judge.reading(wrong, reading.time_s, reading.time_s)
        assert row.wrong == 1 and "away from the truth" in row.complaints[0]
        rig.true_rad = lambda time_s: (5.0, 0.0)
        judge.limits()
        assert row.outside > 0 and not row.good

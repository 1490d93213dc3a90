"""Table I of the paper, as printed, from its equations (1) to (4)."""

from __future__ import annotations

import pytest

from calib.geometry.stereo import stereo_range_error_m, target_approach_budget

HALF_A_PRINTED_DIGIT_CM = 0.0501
PRINTED_CM = {
    # Pancam and Hazcam as printed; the Navcam's first two cells are lost in the text and follow from 4.65 µm.
    "pancam": (9.7, 22.2, 1.5),
    "navcam": (38.8, 43.6, 3.9),
    "hazcam": (202.2, 203.2, 10.1),
}


@pytest.mark.parametrize("name", PRINTED_CM)
def test_every_cell_of_table_one(name: str) -> None:
    [row] = [row for row in target_approach_budget() if row.name == name]
    stereo, untracked, tracked = PRINTED_CM[name]
    assert row.stereo_cm == pytest.approx(stereo, abs=HALF_A_PRINTED_DIGIT_CM)
    assert row.untracked_cm == pytest.approx(untracked, abs=HALF_A_PRINTED_DIGIT_CM)
    assert row.tracked_cm == pytest.approx(tracked, abs=HALF_A_PRINTED_DIGIT_CM)


def test_rows_come_in_the_papers_order() -> None:
    assert [row.name for row in target_approach_budget()] == ["pancam", "navcam", "hazcam"]


def test_range_error_worked_by_hand() -> None:
    # 10 m, f = 1000 px, B = 0.1 m, one pixel: 100 / 100 = 1 m.
    assert stereo_range_error_m(10.0, 1000.0, 0.1, 1.0) == pytest.approx(1.0)

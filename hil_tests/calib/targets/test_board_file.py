"""BOARD.yaml: strict in, and a measured bar that scales."""

from __future__ import annotations

from pathlib import Path

import pytest

from calib.errors import BadFile
from calib.targets.board_file import load_board, save_board
from calib.targets.boards import AnyBoard, AprilGrid, Charuco, Checkerboard, DotBoard

BOARDS: list[AnyBoard] = [
    Charuco(9, 12, 0.02, 0.015, "DICT_4X4_250", first_id=60, legacy=True),
    AprilGrid(6, 5, 0.03, 0.009, "tag36h11", first_id=7, border=1),
    DotBoard(10, 8, 0.02, 0.01, aspect=1.001),
    Checkerboard(10, 7, 0.025),
]

TEXT = """\
schema: mastctl/board/1
name: bench
kind: charuco
columns: 9
rows: 12
square_m: 0.02
marker_m: 0.015
dictionary: DICT_5X5_100
bar_m: {across: 0.15, down: 0.2}
"""


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.kind)
def test_a_board_is_read_as_it_was_written(tmp_path: Path, board: AnyBoard) -> None:
    save_board(tmp_path / "board.yaml", board, (0.1, 0.1), "bench")
    assert load_board(tmp_path / "board.yaml") == board


def test_one_measured_bar_scales_lengths_and_two_give_the_aspect(
    tmp_path: Path,
) -> None:
    path = tmp_path / "board.yaml"
    path.write_text(TEXT + "measured: {across_m: 0.1485}\n")
    assert load_board(path) == Charuco(9, 12, 0.02 * 0.99, 0.015 * 0.99)
    path.write_text(TEXT + "measured: {across_m: 0.1485, down_m: 0.1984}\n")
    assert load_board(path).aspect == pytest.approx(0.1984 / 0.198)


CASES = {
    "schema": ("mastctl/board/1", "mastctl/board/2", "schema: the text 'mastctl/board/2' where"),
    "kind": ("kind: charuco", "kind: chess", "kind: the text 'chess' where one of charuco, aprilgrid, dots"),
    "no kind": ("kind: charuco\n", "", "kind: the key is missing; charuco, aprilgrid"),
    "another kind's key": ("square_m: 0.02", "tag_m: 0.02", "tag_m: unknown key"),
    "metres for millimetres": ("0.02\n", "20\n", "square_m: 20 where a finite number up to 10"),
    "zero": ("marker_m: 0.015", "marker_m: 0", "marker_m: 0 where a number above 0"),
    "large marker": ("marker_m: 0.015", "marker_m: 0.03", "marker_m: 0.03 where less than square_m 0.02"),
    "dictionary": ("DICT_5X5_100", "5X5", "dictionary: the text '5X5' where one of DICT_"),
    "too many markers": (
        "columns: 9",
        "columns: 60",
        "columns: the board needs 360 markers, and DICT_5X5_100",
    ),
    "one row": ("rows: 12", "rows: 1", "rows: 1 where an integer from 2"),
    "legacy": ("bar_m", "legacy: 1\nbar_m", "legacy: 1 where true or false"),
    "one bar": ("across: 0.15, ", "", "bar_m.across: the key is missing"),
    "inches": (
        ", down: 0.2}",
        ", down: 0.2}\nmeasured: {across_m: 5.9}",
        "measured.across_m: 5.9 where 0.105",
    ),
    "lopsided": (
        ", down: 0.2}",
        ", down: 0.2}\nmeasured: {across_m: 0.15, down_m: 0.15}",
        "measured.down_m: 0.15 where 0.194 to 0.206 is expected, 0.2 as drawn",
    ),
    "no bar": (
        "bar_m: {across: 0.15, down: 0.2}",
        "measured: {across_m: 0.15}",
        "measured: there is no bar_m",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_no_board_is_refused_with_its_key(tmp_path: Path, case: str) -> None:
    old, new, expected = CASES[case]
    assert old in TEXT
    path = tmp_path / "board.yaml"
    path.write_text(TEXT.replace(old, new))
    with pytest.raises(BadFile) as error:
        load_board(path)
    assert expected in str(error.value)
    assert "\n" not in str(error.value)

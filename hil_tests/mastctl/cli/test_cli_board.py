"""Boards on paper: drawn by us, rasterised by Poppler, found by OpenCV where BOARD.yaml says."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calib.targets.board_file import load_board
from calib.targets.boards import Charuco
from mastctl.cli.main import main
from mastctl.setup.board_sheet import PAPERS_MM, sheet_of

DPI = 200
PX_PER_MM = DPI / 25.4
PRINTED_PX = 0.25
"""Corners of a rasterised page, against where they were drawn: whole pixels are black or white there."""


def rasterised(path: Path) -> NDArray[np.uint8]:
    """The page as a program from outside draws it."""
    out = path.with_suffix(".png")
    if shutil.which("pdftoppm") is None:
        pytest.skip("pdftoppm is not installed")
    options = ["-r", str(DPI), "-png", "-gray", "-singlefile", str(path), str(out.with_suffix(""))]
    subprocess.run(["pdftoppm", *options], check=True, timeout=120)
    image = cv2.imread(str(out), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return np.asarray(image, dtype=np.uint8)


def made(tmp_path: Path, *options: str) -> tuple[Path, Path]:
    out = tmp_path / "b.pdf"
    assert main(["board", "make", "--out", str(out), *options]) == 0
    return out, out.with_suffix(".yaml")


def test_a_charuco_board_is_on_paper_where_its_file_says(tmp_path: Path) -> None:
    out, yaml = made(tmp_path, "--kind", "charuco", "--square-mm", "22.5")
    image = rasterised(out)
    assert image.shape == pytest.approx((297 * PX_PER_MM, 210 * PX_PER_MM), abs=1.0)
    board = load_board(yaml)
    assert isinstance(board, Charuco)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    theirs = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_m, board.marker_m, dictionary)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(theirs).detectBoard(image)
    found = np.asarray(ids).ravel()
    assert len(found) == len(board.ids)
    middle_mm = np.array(sheet_of(board, PAPERS_MM["A4"], "b").middle_mm)
    wanted = (middle_mm + 1000 * board.in_board_m(found)[:, :2]) * PX_PER_MM - 0.5
    off = np.asarray(corners).reshape(-1, 2) - wanted
    assert float(np.sqrt(np.mean(off**2))) < PRINTED_PX


def test_aprilgrid_and_dots_are_on_paper_where_their_files_say(tmp_path: Path) -> None:
    for kind in ("aprilgrid", "dots"):
        out, yaml = made(tmp_path, "--kind", kind, "--paper", "A3", "--landscape")
        board = load_board(yaml)
        image = rasterised(out)
        middle_mm = np.array(sheet_of(board, PAPERS_MM["A3"][::-1], "b").middle_mm)
        wanted = (middle_mm + 1000 * board.in_board_m(board.ids)[:, :2]) * PX_PER_MM - 0.5
        if kind == "dots":
            spots = cv2.connectedComponentsWithStats((image < 128).astype(np.uint8))
            middles = spots[3][1:]
            away = np.linalg.norm(wanted[:, None] - middles[None], axis=-1).min(axis=1)
            assert away.max() < PRINTED_PX
        else:
            start = wanted.astype(np.float32).reshape(-1, 1, 2)
            stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
            off = cv2.cornerSubPix(image, start.copy(), (9, 9), (-1, -1), stop) - start
            assert float(np.sqrt(np.mean(off**2))) < PRINTED_PX


def test_a_measured_print_has_other_sizes_and_is_not_drawn_over(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, yaml = made(tmp_path, "--kind", "charuco")
    drawn = load_board(yaml)
    assert main(["board", "measured", str(yaml), "--across-mm", "149.4", "--down-mm", "219.56"]) == 0
    board = load_board(yaml)
    assert isinstance(board, Charuco) and isinstance(drawn, Charuco)
    assert board.square_m == pytest.approx(0.996 * drawn.square_m)
    assert board.aspect == pytest.approx(0.998 / 0.996)
    capsys.readouterr()
    assert main(["board", "make", "--kind", "charuco", "--out", str(out)]) == 2
    assert "has a measured board" in capsys.readouterr().err
    assert load_board(yaml) == board


BAD = {
    "of another kind": (
        ["--kind", "charuco", "--tag-mm", "30"],
        "a board of kind charuco, tag_m: unknown key",
    ),
    "too large": (["--kind", "charuco", "--columns", "9", "--rows", "5"], "--square-mm 19.3 would fit"),
    "suffix": (["--kind", "dots", "--out", "board.png"], "ending in .pdf"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_drawn_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    options, words = BAD[case]
    out = [] if "--out" in options else ["--out", str(tmp_path / "b.pdf")]
    assert main(["board", "make", *out, *options]) == 2
    told = capsys.readouterr().err
    assert words in told
    assert told.count("\n") == 1
    assert list(tmp_path.glob("b.yaml")) == []


def test_corners_of_a_picture_are_told_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, yaml = made(tmp_path, "--kind", "charuco")
    rasterised(out)
    dark = tmp_path / "dark.png"
    cv2.imwrite(str(dark), np.zeros((480, 640), np.uint8))
    capsys.readouterr()
    table = tmp_path / "corners.csv"
    pictures = [str(out.with_suffix(".png")), str(dark)]
    assert main(["board", "find", str(yaml), *pictures, "--out", str(table), "--json"]) == 0
    first, second = json.loads(capsys.readouterr().out)["pictures"]
    assert first["corners"] >= 36  # a page without blur has edges of whole pixels
    assert first["of"] == 40
    assert "too dark" in second["reason"]
    assert len(table.read_text().splitlines()) == 1 + first["corners"]
    assert main(["board", "find", str(yaml), str(dark)]) == 1
    assert main(["board", "find", str(yaml), str(yaml)]) == 2
    assert "is no picture" in capsys.readouterr().err

"""The project's fit beside OpenCV's on OpenCV's own stereo sample: same corners, boards free in both."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.adjust.solver import minimise
from calib.files import blind_part
from calib.geometry.cahvor import Kind
from calib.targets.board_file import save_board
from calib.targets.boards import Charuco
from mastctl.cli.output import WrongUse
from tools.against_others import families
from tools.against_others.families import (
    BoardViews,
    FamilyRow,
    boards_problem,
    boards_residuals,
    fit_opencv,
    fit_ours,
    read_views,
    rms,
    sample_terms,
)

WORST_RATIO = 1.02
"""Our rms over OpenCV's, at most."""


@pytest.fixture(scope="module", params=["left", "right"])
def views(request: pytest.FixtureRequest, reference_data: Path) -> BoardViews:
    folder = reference_data / "opencv_stereo"
    return read_views(folder, request.param)


def test_every_picture_of_the_sample_shows_its_corners(views: BoardViews) -> None:
    assert views.pixels_px.shape == (13, 54, 2)


@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_rms_is_no_worse_than_opencvs(views: BoardViews, factor: float) -> None:
    """Against k1 k2 p1 p2 k3, OpenCV's usual and here better lens; from a focal length 20 % off."""
    theirs, camera = fit_opencv("OPENCV5", views.size_px, sample_terms(views))
    matrix = camera.camera_matrix
    problem, start = boards_problem(views, factor * float(matrix[0, 0]))
    fit = minimise(problem, start, weak=problem.weak)
    assert fit.settled
    assert rms(boards_residuals(problem, fit.state)) <= WORST_RATIO * theirs
    height, width = (float(np.linalg.norm(np.cross(fit.state.cameras["camera"].A, v)))
                     for v in (fit.state.cameras["camera"].V, fit.state.cameras["camera"].H))  # fmt: skip
    assert width == pytest.approx(matrix[0, 0], rel=0.01)
    assert height == pytest.approx(matrix[1, 1], rel=0.01)


def test_a_family_that_ours_does_not_fit_and_opencv_does_is_no_success() -> None:
    row = FamilyRow("left", "OPENCV8", 0.4, 0.4, 1.0, None, 0.1)
    assert row.verdict == "met"
    for ours_px in (0.5, None):
        assert replace(row, ours_px=ours_px).verdict == "NOT MET"
        assert replace(row, ours_px=ours_px, opencv_image=0.44).verdict == "", "their lens has a pole"
    for note in ("ours not settled", "3 corners unseen"):
        assert replace(row, note=note).verdict == "NOT MET"
    assert replace(row, opencv_px=None, opencv_image=0.0).verdict == "", "OpenCV's own fit failed"


def test_a_folder_without_the_board_is_named(tmp_path: Path) -> None:
    save_board(tmp_path / "board.yaml", Charuco(10, 7, 0.055, 0.042))
    wanted = f"{tmp_path}: 0 pictures show 8 corners of the board or more, 3 are expected"
    with pytest.raises(WrongUse, match=re.escape(wanted)), pytest.MonkeyPatch.context() as patched:
        patched.setattr("sys.argv", ["families", "--board", str(tmp_path / "board.yaml"), str(tmp_path)])
        families.main()


@pytest.mark.parametrize("kind", ["OPENCV8", "OPENCV12", "OPENCV_FISHEYE"])
def test_a_family_settles_within_one_percent_of_opencvs_where_that_lens_serves_the_picture(
    views: BoardViews, kind: Kind
) -> None:
    """Else within 1 % of OpenCV's five numbers: its own of the family then have a pole in the picture."""
    terms = sample_terms(views)
    ours_px, note = fit_ours(kind, views.size_px, terms)
    theirs_px, camera = fit_opencv(kind, views.size_px, terms)
    if blind_part(camera) > 0.0 and kind != "OPENCV_FISHEYE":
        theirs_px, camera = fit_opencv("OPENCV5", views.size_px, terms)
        assert blind_part(camera) == 0.0
    assert note == ""
    assert ours_px <= 1.01 * theirs_px

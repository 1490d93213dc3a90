"""The project's fit beside OpenCV's on OpenCV's own stereo sample: same corners, boards free in both."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.adjust.solver import minimise
from calib.files import blind_part
from calib.geometry.cahvor import Kind
from tools.against_others.calibration import WORST_RATIO, boards_problem, boards_residuals, rms
from tools.against_others.families import fit_opencv, fit_ours, sample_terms
from tools.against_others.points import BoardViews, opencv_views, read_views


@pytest.fixture(scope="module", params=["left", "right"])
def views(request: pytest.FixtureRequest, shared_data: Path) -> BoardViews:
    folder = shared_data / "opencv_stereo"
    if not folder.is_dir():
        pytest.skip("OpenCV's stereo sample, shared/data/opencv_stereo, is not beside this checkout")
    return read_views(folder, request.param)


def test_every_picture_of_the_sample_shows_its_corners(views: BoardViews) -> None:
    assert views.pixels_px.shape == (13, 54, 2)


@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_rms_is_no_worse_than_opencvs(views: BoardViews, factor: float) -> None:
    """Against k1 k2 p1 p2 k3, OpenCV's usual and here better lens; from a focal length 20 % off."""
    theirs, matrix, *_ = opencv_views(views, 0)
    problem, start = boards_problem(views, factor * float(matrix[0, 0]))
    fit = minimise(problem, start, weak=problem.weak)
    assert fit.settled
    assert rms(boards_residuals(problem, fit.state)) <= WORST_RATIO * theirs
    height, width = (float(np.linalg.norm(np.cross(fit.state.cameras["camera"].A, v)))
                     for v in (fit.state.cameras["camera"].V, fit.state.cameras["camera"].H))  # fmt: skip
    assert width == pytest.approx(matrix[0, 0], rel=0.01)
    assert height == pytest.approx(matrix[1, 1], rel=0.01)


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

"""The project's fit beside OpenCV's on OpenCV's own stereo sample: same corners, boards free in both."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.adjust.solver import minimise
from tools.against_others.calibration import WORST_RATIO, boards_problem, boards_residuals, rms
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

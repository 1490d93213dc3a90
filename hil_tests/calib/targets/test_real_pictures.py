"""OpenCV's stereo sample: its own camera model fits our corners better than those that it finds itself."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.targets.boards import Checkerboard, Corners
from calib.targets.corners import find_corners

BOARD = Checkerboard(10, 7, 0.025)
SIZE_PX = (640, 480)


@pytest.mark.parametrize("side", ["left", "right"])
def test_opencvs_camera_fits_our_corners_better_than_its_own(reference_data: Path, side: str) -> None:
    pictures = sorted((reference_data / "opencv_stereo").glob(f"{side}*.jpg"))
    ours, theirs = [], []
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    for path in pictures:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        found = find_corners(BOARD, image.astype(np.uint8))
        assert isinstance(found, Corners), path.name
        assert found.ids.tolist() == list(range(54)), path.name
        ours.append(found.pixels_px.astype(np.float32).reshape(-1, 1, 2))
        _, corners = cv2.findChessboardCorners(image, (9, 6))
        theirs.append(cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), stop))
    places = [BOARD.in_board_m(BOARD.ids).astype(np.float32)] * len(pictures)
    rms = [cv2.calibrateCamera(places, points, SIZE_PX, None, None)[0] for points in (ours, theirs)]
    assert rms[0] < 0.17
    assert rms[0] < 0.9 * rms[1]

"""Finds a board's corners in a picture."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from calib.boards import AnyBoard, Charuco, Corners
from calib.errors import CalibError
from calib.pictures.warp import grey
from drivers.interfaces import Image

SIGMA_PX = 0.05


def finder(board: AnyBoard) -> Callable[[Image], Corners]:
    """Return what finds a ChArUco board.

    Raises
    ------
    CalibError
        For another kind.
    """
    if not isinstance(board, Charuco):
        raise CalibError(f"a board of kind {board.kind} is not found yet; a charuco board is expected")
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    drawn = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_m, board.marker_m, dictionary)

    def find(image: Image) -> Corners:
        picture = np.asarray(grey(image)).astype(np.uint8)
        pixels, ids, _, _ = cv2.aruco.CharucoDetector(drawn).detectBoard(picture)
        if ids is None or len(ids) < 6:
            return Corners(np.empty(0, np.int64), np.empty((0, 2)), np.empty(0))
        cv2.cornerSubPix(picture, pixels, (4, 4), (-1, -1), (3, 50, 1e-4))
        return Corners(
            ids.ravel().astype(np.int64),
            pixels.reshape(-1, 2).astype(np.float64),
            np.full(len(ids), SIGMA_PX),
        )

    return find

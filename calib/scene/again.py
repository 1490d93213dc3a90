"""A picture taken again from the same rest: where its features are now."""

from __future__ import annotations

import cv2
import numpy as np

from calib.camera.cahvor import CameraModel
from calib.errors import CalibError
from calib.pictures.patch_match import match_patch
from calib.pictures.patch_verdict import MatchSettings
from calib.pictures.warp import Grey, facing_plane
from calib.rigid import FloatArray

MOST_FEATURES = 60
QUALITY, APART_PX, MARGIN_PX = 0.02, 40, 26
SEARCH_PX = 30.0
"""How far a feature is looked for: a bump or slip of some 20 mrad in a Navcam."""

FLOOR_PX = 0.03
_RANGE_M = 5.0
_SETTINGS = MatchSettings(half_px=14, roughness=0.0)


def seen_again(camera: CameraModel, then: Grey, now: Grey) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return features of a picture (n, 2), how far they have moved (n, 2) and its sigma (n,), all in pixels.

    Parameters
    ----------
    camera
        That took both, in any frame.
    then, now
        (h, w) grey.
    """
    image = np.clip(np.rint(then), 0, 255).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(image, 4 * MOST_FEATURES, QUALITY, APART_PX, blockSize=15)
    pixels: list[FloatArray] = []
    moved: list[FloatArray] = []
    sigmas: list[float] = []
    width, height = camera.size_px
    for corner in [] if corners is None else np.rint(corners[:, 0].astype(np.float64)):
        if len(pixels) == MOST_FEATURES:
            break
        if not (MARGIN_PX <= corner[0] < width - MARGIN_PX and MARGIN_PX <= corner[1] < height - MARGIN_PX):
            continue
        try:
            plane = facing_plane(camera, corner, _RANGE_M)
            match = match_patch(then, camera, corner, plane, now, camera, SEARCH_PX, _SETTINGS)
        except CalibError:
            continue
        if match.verdict == "good":
            pixels.append(corner)
            moved.append(match.pixel_px - corner)
            sigmas.append(float(np.hypot(np.sqrt(np.trace(match.covariance_px2) / 2.0), FLOOR_PX)))
    count = len(pixels)
    return np.reshape(pixels, (count, 2)), np.reshape(moved, (count, 2)), np.array(sigmas)

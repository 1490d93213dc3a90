"""Whether a place of a picture can be told from its surroundings, before a track begins there.

What correlates with its own neighbourhood will be confused with it: an edge along its length, a pattern with
its repetition. And a patch with little texture is found again only as long as the light stays: what else it
shows is shading, and the edges of shadows, which move with the sun.
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np

from calib.camera.cahvor import CameraModel
from calib.pictures.least_squares_matching import gaussian
from calib.pictures.patch_match import near_covariance, near_half_px
from calib.pictures.patch_verdict import MatchSettings, texture_lacks
from calib.pictures.warp import Grey, Plane, patch_grid
from calib.rigid import FloatArray

AROUND_PX = 80
"""How far around is compared: as far as a heading that is wrong by 1.2 degrees puts a target in a Pancam."""
MOST_ALIKE = 0.9
"""Correlation with another place: the simulated rover's rocks and ground were seen to stay below 0.86,
edges of its shadows to have 0.97."""
WORST_SIGMA_PX = 0.2
"""In the worst direction, of what grey noise alone would leave."""


def indistinct(
    image: Grey, camera: CameraModel, pixel_px: FloatArray, plane: Plane, settings: MatchSettings
) -> str:
    """Return why a target could not be told from what surrounds it, empty if it can.

    Parameters
    ----------
    image
        (h, w) float32 grey.
    pixel_px
        (2,) the target.
    plane
        The surface there, at an angle to the pixel's ray.
    settings
        Of the matching that will look for it; ``near_px`` sizes and weighs the patch.
    """
    near_px2 = near_covariance(plane, camera, pixel_px, settings.near_px)
    half = near_half_px(near_px2)
    middle = np.rint(pixel_px).astype(int)
    low, high = middle - half, middle + half + 1
    if (low < 0).any() or (high > image.shape[::-1]).any():
        return "the patch around it is cut by the picture's border"
    patch = image[low[1] : high[1], low[0] : high[0]]
    counts = gaussian(patch_grid((int(half[0]), int(half[1]))) + (middle - pixel_px), near_px2)
    lacking = texture_lacks(patch, replace(settings, flat_sigma_px=WORST_SIGMA_PX), counts)
    if lacking:
        return lacking
    first = np.maximum(low - AROUND_PX, 0)
    around = image[first[1] : high[1] + AROUND_PX, first[0] : high[0] + AROUND_PX]
    scores = cv2.matchTemplate(np.ascontiguousarray(around), patch, cv2.TM_CCOEFF_NORMED)
    x, y = low - first
    beside = settings.apart_px
    scores[max(0, y - beside) : y + beside + 1, max(0, x - beside) : x + beside + 1] = -1.0
    _, alike, _, where = cv2.minMaxLoc(np.nan_to_num(scores, nan=-1.0, posinf=-1.0, neginf=-1.0))
    if alike > MOST_ALIKE:
        away = math.dist(where, (x, y))
        return (
            f"an edge, a smooth place or a repeated pattern: what is {away:.0f} px beside it correlates by "
            f"{alike:.2f}, at most {MOST_ALIKE:g} is allowed"
        )
    return ""

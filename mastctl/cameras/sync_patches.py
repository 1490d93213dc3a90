"""Patches of a picture taken at rest, found again in the pictures that are taken while the head turns."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from drivers.interfaces import Image
from mastctl.cameras.sync_motion import CannotTell

HALF_PX = 15
MOST_PATCHES = 12
LEAST_CORRELATION = 0.6  # motion blurs the pictures that are compared with one at rest
LEAST_LEAD = 0.05  # before the best place elsewhere
APART_PX = 6
PAD_PX = 12
NEAR = 1.4  # so much further than infinitely distant things do near ones move
FAR_M = 1e5


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches of one camera's picture, with where each is looked for.

    Attributes
    ----------
    templates
        (2 HALF_PX + 1) squares of grey.
    centres_px
        (p, 2) their places in the picture at rest.
    windows_px
        (p, 4) corners (x0, y0, x1, y1) of where their centres may come to lie, inclusive.
    ways
        (p, 2) unit vectors along which they move.
    rows
        (p,) their rows, picture heights from the middle.
    """

    templates: tuple[Image, ...]
    centres_px: FloatArray
    windows_px: FloatArray
    ways: FloatArray
    rows: FloatArray

    def places_px(self, image: Image) -> FloatArray:
        """Return the (p,) places along their ways in a picture; not-a-number where a patch is not found."""
        picture = grey_bytes(image)
        return np.array([self._place_px(picture, number) for number in range(len(self.templates))])

    def _place_px(self, picture: Image, number: int) -> float:
        x0, y0, x1, y1 = self.windows_px[number].astype(int)
        part = picture[y0 - HALF_PX : y1 + HALF_PX + 1, x0 - HALF_PX : x1 + HALF_PX + 1]
        score = cv2.matchTemplate(part, self.templates[number], cv2.TM_CCOEFF_NORMED)
        _, best, _, (x, y) = cv2.minMaxLoc(score)
        height, width = score.shape
        if best < LEAST_CORRELATION or not (0 < x < width - 1 and 0 < y < height - 1):
            return np.nan
        offset = np.array([_peak(*score[y, x - 1 : x + 2]), _peak(*score[y - 1 : y + 2, x])])
        place = np.array([x0 + x, y0 + y]) + offset - self.centres_px[number]
        score[max(0, y - APART_PX) : y + APART_PX + 1, max(0, x - APART_PX) : x + APART_PX + 1] = -1.0
        if best - float(score.max()) < LEAST_LEAD:
            return np.nan
        return float(place @ self.ways[number])


def grey_bytes(image: Image) -> Image:
    """Return a picture's grey levels, bytes, (h, w)."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def choose_patches(
    image: Image, rig: Rig, camera: str, joints_rad: tuple[float, float], amplitude_rad: float
) -> Patches:
    """Choose textured patches that stay in the picture while pan goes ``amplitude_rad`` to either side.

    Parameters
    ----------
    image
        A picture at rest, at ``joints_rad`` (pan, tilt).
    rig
        For roughly where things go; the measurement itself does not use it.

    Raises
    ------
    CannotTell
        If nothing in it can be told from its surroundings.
    """
    picture = grey_bytes(image)
    height, width = picture.shape
    corners = cv2.goodFeaturesToTrack(picture, 400, 0.02, 2 * HALF_PX, blockSize=9, useHarrisDetector=False)
    if corners is None:
        raise CannotTell("the scene is too plain: nothing in the picture can be followed")
    centres = np.rint(corners.reshape(-1, 2)).astype(np.float64)
    ends = np.stack([moved_px(rig, camera, joints_rad, side * amplitude_rad, centres) for side in (-1, 1)])
    moves = NEAR * (ends - centres)
    low = np.floor(np.minimum(centres + moves.min(axis=0), centres) - PAD_PX)
    high = np.ceil(np.maximum(centres + moves.max(axis=0), centres) + PAD_PX)
    inside = np.isfinite(moves).all(axis=(0, 2))
    inside &= (low >= HALF_PX).all(axis=1) & (high <= np.array([width, height]) - 1 - HALF_PX).all(axis=1)
    chosen = _spread(centres, np.flatnonzero(inside), height)
    if not len(chosen):
        raise CannotTell(
            "nothing that can be followed stays in the picture; a smaller --amplitude, or a view with more "
            "texture in its middle, is expected"
        )
    ways = (ends[1] - ends[0])[chosen]
    return Patches(
        templates=tuple(_square(picture, centre) for centre in centres[chosen]),
        centres_px=centres[chosen],
        windows_px=np.hstack([low, high])[chosen],
        ways=ways / np.linalg.norm(ways, axis=1, keepdims=True),
        rows=(centres[chosen, 1] - (height - 1) / 2) / height,
    )


def moved_px(
    rig: Rig, camera: str, joints_rad: tuple[float, float], pan_by_rad: float, pixels_px: FloatArray
) -> FloatArray:
    """Return where far things at (n, 2) pixels come to lie when pan goes further; nan out of reach."""
    model = rig.cameras[camera].model
    pan_rad, tilt_rad = joints_rad
    rays = model.ray(pixels_px)
    far = rig.mast.rover_from_head(pan_rad, tilt_rad).points(rays.origins_m + FAR_M * rays.directions)
    back = rig.mast.rover_from_head(pan_rad + pan_by_rad, tilt_rad).inverse.points(far)
    found: FloatArray = model.project(back)[0]
    return found


def _spread(centres_px: FloatArray, allowed: NDArray[np.intp], height: int) -> NDArray[np.intp]:
    """Choose the best corners (they come best first) of each of four strips of rows by turns."""
    strips = [[i for i in allowed if int(4 * centres_px[i, 1] / height) == strip] for strip in range(4)]
    chosen: list[int] = []
    while len(chosen) < MOST_PATCHES and any(strips):
        for strip in strips:
            if strip and len(chosen) < MOST_PATCHES:
                chosen.append(strip.pop(0))
    return np.array(chosen, dtype=np.intp)


def _square(picture: Image, centre_px: FloatArray) -> Image:
    x, y = centre_px.astype(int)
    return picture[y - HALF_PX : y + HALF_PX + 1, x - HALF_PX : x + HALF_PX + 1].copy()


def _peak(before: float, at: float, after: float) -> float:
    """Where a parabola through three neighbours has its top, from the middle one."""
    bend = before - 2 * at + after
    return 0.0 if bend >= 0 else 0.5 * (before - after) / bend

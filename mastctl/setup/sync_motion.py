"""What joints and pictures of a sweep say by themselves: how the head moved, how far patches did."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from drivers.interfaces import Image
from mastctl.errors import MastctlError

LEAST_FRAMES = 30  # and readings
LEAST_REVERSAL_RAD = 5e-4
LEAST_WAY_RAD = 0.010  # after a turn back: until then the gears of a plain servo are not all on one side
LARGEST_GAP_S = 0.1  # between the readings around a frame; beyond it the angle is a guess
LEAST_SPEED_RAD_PER_S = 0.06
SMOOTHING_S = 0.065  # readings so far to either side even each other out; short beside a ramp of the speed


class CannotTell(MastctlError):
    """The images do not determine the offset; the message says why."""

    code = "cannot_tell"


class JointMotion:
    """The joint angle over time by its readings (m,), cut into legs between turns back."""

    def __init__(self, times_s: FloatArray, angles_rad: FloatArray) -> None:
        self.times_s, first = np.unique(times_s, return_index=True)
        self.angles_rad = angles_rad[first]
        if len(self.times_s) < LEAST_FRAMES:
            raise CannotTell(f"the head was read {len(self.times_s)} times, {LEAST_FRAMES} are needed")
        self._turns, self._signs = _legs(self.angles_rad)
        self._curve = _smoothed(self.times_s, self.angles_rad)
        self._speed = self._curve.derivative()

    def at(self, times_s: FloatArray) -> FloatArray:
        """Return the angle, radians, on a curve through the readings that evens their counts out."""
        return np.asarray(self._curve(np.clip(times_s, self.times_s[0], self.times_s[-1])))

    def slope(self, times_s: FloatArray) -> FloatArray:
        """Return the speed, rad/s."""
        return np.asarray(self._speed(np.clip(times_s, self.times_s[0], self.times_s[-1])))

    def leg(self, times_s: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
        """Return which leg a moment is of (-1: of none) and the sign of that leg's motion."""
        turns_s = self.times_s[self._turns]
        leg = np.searchsorted(turns_s, times_s, side="right") - 1
        after = np.clip(np.searchsorted(self.times_s, times_s), 1, len(self.times_s) - 1)
        sure = (leg >= 0) & (times_s < self.times_s[-1])
        sure &= self.times_s[after] - self.times_s[after - 1] <= LARGEST_GAP_S
        known = np.clip(leg, 0, len(self._turns) - 1)
        sure &= np.abs(self.slope(times_s)) >= LEAST_SPEED_RAD_PER_S  # one at rest does not depend on time
        sure &= np.abs(self.at(times_s) - self.angles_rad[self._turns[known]]) >= LEAST_WAY_RAD
        return np.where(sure, leg, -1), self._signs[known]


def _smoothed(times_s: FloatArray, angles_rad: FloatArray) -> CubicHermiteSpline:
    """A curve with, at each reading, the place and speed of the parabola that fits its neighbours best."""
    place, speed = np.empty(len(times_s)), np.empty(len(times_s))
    first = np.searchsorted(times_s, times_s - SMOOTHING_S)
    last = np.searchsorted(times_s, times_s + SMOOTHING_S, side="right")
    for number, (begin, end) in enumerate(zip(first, last, strict=True)):
        if end - begin < 4:
            begin, end = max(0, number - 2), min(len(times_s), number + 3)
        since_s = times_s[begin:end] - times_s[number]
        parabola = np.linalg.lstsq(np.vander(since_s, 3), angles_rad[begin:end], rcond=None)[0]
        place[number], speed[number] = parabola[2], parabola[1]
    return CubicHermiteSpline(times_s, place, speed)


def _legs(angles_rad: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
    """Where the motion turns back (indices), and its sign from there on; dither of a count is no turn."""
    steps = np.abs(np.diff(np.unique(angles_rad)))
    count_rad = float(steps.min()) if len(steps) else 0.0
    threshold_rad = max(LEAST_REVERSAL_RAD, 2.5 * count_rad if count_rad < LEAST_WAY_RAD / 3 else 0.0)
    turns, signs = [0], [0.0]
    extreme = 0
    for index, angle_rad in enumerate(angles_rad):
        way_rad = angle_rad - angles_rad[extreme]
        if signs[-1] == 0.0:
            if abs(way_rad) > threshold_rad:
                signs[-1] = np.sign(way_rad)
                extreme = index
        elif way_rad * signs[-1] >= 0:
            extreme = index
        elif abs(way_rad) > threshold_rad:
            turns.append(extreme)
            signs.append(-signs[-1])
            extreme = index
    return np.array(turns), np.array(signs)


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
    """Patches of one camera's image, (2 HALF_PX + 1) squares of grey, and where each is searched.

    ``centres_px`` (p, 2) are their places in the image at rest, ``windows_px`` (p, 4) the corners (x0, y0,
    x1, y1), inclusive, of where their centres may come to lie, ``ways`` (p, 2) the unit vectors along which
    they move, and ``rows`` (p,) their rows in image heights from the middle.
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
    """Choose textured patches that stay in the image while pan goes ``amplitude_rad`` to either side.

    ``image`` is of a head at rest at ``joints_rad`` (pan, tilt). ``rig`` predicts roughly where things go;
    the measurement does not use it. Raises CannotTell if nothing differs from its surroundings.
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

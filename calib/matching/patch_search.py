"""Textured patches of a reduced picture, and where other pictures show them: quick, to a fraction of a pixel.

What `calib.matching.patch` does for one target with care, this does for some twenty places at once in a
millisecond or two: enough to find which view a picture shows, not enough to measure a target. Pictures are
reduced to some 256 columns by area, so that noise hardly matters and differences of scale and slope stay
small.

Each found patch is a vote for pan and tilt; most of them are right, and the view is that on which they agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.geometry.rigid import FloatArray
from calib.matching.warp import Grey, Mask, square_grid, summit

HALF = 7
"""Half of a patch's side, reduced pixels: 15 of them are 60 of a picture of 1024 columns."""
CELL = 22
"""One patch, the best textured, of each square of this side, reduced pixels."""
NOISE_DN = 1.0
"""Grey noise of a reduced picture: a sixteenth of a pixel's variance, and rounding."""


@dataclass(frozen=True, eq=False)
class Reduced:
    """A picture reduced ``step`` times along each side by area."""

    grey: Grey
    step: int

    @classmethod
    def of(cls, image: Grey) -> Reduced:
        """Reduce a picture (h, w) to about `COLUMNS` columns; what fills no whole pixel is left out."""
        # 256: about as wide are the reduced pictures.
        step = max(1, round(image.shape[1] / 256))
        height, width = (n // step for n in image.shape)
        cut = image[: height * step, : width * step]
        return cls(np.asarray(cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA)), step)

    @property
    def size(self) -> NDArray[np.intp]:
        """(2,) width and height."""
        return np.array(self.grey.shape[::-1])

    def from_full(self, pixels_px: FloatArray) -> FloatArray:
        """Return places (..., 2) of the full picture as places of the reduced one."""
        return np.asarray((pixels_px - (self.step - 1) / 2) / self.step)

    def to_full(self, places: FloatArray) -> FloatArray:
        """Return places (..., 2) of the reduced picture as pixels of the full one."""
        return np.asarray(places * self.step + (self.step - 1) / 2)

    def holds(self, places: FloatArray, margin: float) -> Mask:
        """Return which places (..., 2) lie at least ``margin`` inside the reduced picture."""
        with np.errstate(invalid="ignore"):
            return np.asarray(((places >= margin) & (places <= self.size - 1 - margin)).all(axis=-1))


def textured(picture: Reduced) -> FloatArray:
    """Return the best textured place of each cell that holds one (n, 2), reduced pixels, row by row.

    Texture enough means that the smaller eigenvalue of the patch's summed gradient products is at least what
    `FLAT_SIGMA` needs.
    """
    side = 2 * HALF + 1
    eigen = cv2.cornerMinEigenVal(picture.grey, side, ksize=3)
    # OpenCV scales its Sobel by 1 / (4 side), which is a difference per pixel times 8 / (4 side).
    summed = eigen * (side**2 / 4.0) - 0.1875 * NOISE_DN**2 * side**2
    # 0.3: a patch whose texture cannot hold this in its worst direction, reduced pixels, is too plain.
    strength = summed[HALF:-HALF, HALF:-HALF] / (2.0 * NOISE_DN**2 / 0.3**2)
    rows, columns = (n // CELL for n in strength.shape)
    if min(rows, columns) == 0:
        return np.empty((0, 2))
    cells = strength[: rows * CELL, : columns * CELL].reshape(rows, CELL, columns, CELL)
    flat = cells.transpose(0, 2, 1, 3).reshape(rows * columns, CELL * CELL)
    best = np.argmax(flat, axis=1)
    corner_y, corner_x = np.divmod(np.arange(rows * columns), columns)
    places = np.stack([corner_x * CELL + best % CELL, corner_y * CELL + best // CELL], axis=1) + float(HALF)
    return np.asarray(places[flat.max(axis=1) >= 1.0])


def cut(
    picture: Reduced, places: FloatArray, shapes: FloatArray, centres: NDArray[np.intp], expected: FloatArray
) -> NDArray[np.float32]:
    """Return the patches (n, 15, 15) as another picture of the same reduction should show them.

    ``places`` (n, 2) are their middles in this picture, reduced pixels; ``shapes`` (n, 2, 2) how offsets of
    this picture become offsets of the other; ``centres`` (n, 2) the whole pixels of the other picture that
    the patches are cut for, and ``expected`` (n, 2) where their middles are there.
    """
    offsets = square_grid(HALF) + (centres - expected)[:, None, None]
    maps = places[:, None, None] + np.einsum("nij,nyxj->nyxi", np.linalg.inv(shapes), offsets)
    side = 2 * HALF + 1
    stacked = maps.astype(np.float32).reshape(-1, side, 2)
    values = cv2.remap(
        picture.grey, stacked[..., 0], stacked[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(values.reshape(-1, side, side))


def found(
    patch: NDArray[np.float32], picture: Reduced, centre: NDArray[np.intp], reach: NDArray[np.intp]
) -> tuple[FloatArray, float]:
    """Return the place (2,) where the picture shows a patch best, reduced pixels, and the correlation there.

    Searched are whole pixels up to ``reach`` (x, y) from the centre, as far as the picture goes; the summit
    is a parabola's. Not-a-number and -1 if the picture holds no place.
    """
    low = np.maximum(centre - reach - HALF, 0)
    high = np.minimum(centre + reach + HALF + 1, picture.size)
    if (high - low < 2 * HALF + 1).any():
        return np.full(2, np.nan), -1.0
    searched = picture.grey[low[1] : high[1], low[0] : high[0]]
    scores = cv2.matchTemplate(searched, patch, cv2.TM_CCOEFF_NORMED)
    _, best, _, (x, y) = cv2.minMaxLoc(scores)
    if not np.isfinite(best):
        return np.full(2, np.nan), -1.0
    place = np.array([x, y], dtype=np.float64)
    for axis, (at, line) in enumerate(((x, scores[y]), (y, scores[:, x]))):
        if 0 < at < len(line) - 1:
            place[axis] += summit(*line[at - 1 : at + 2].astype(np.float64))
    return low + HALF + place, float(best)


SEARCH_SIGMA = 0.15
"""Of one patch's place, reduced pixels; a smaller scatter of few patches is luck."""


@dataclass(frozen=True, eq=False)
class AgreedView:
    """A view, pan and tilt (2,), by the patches that agree on it."""

    angles_rad: FloatArray
    sigma_rad: FloatArray
    parallax_rad: FloatArray  # (2,) the largest error by ranges that are not known
    rate_px_per_rad: FloatArray  # (n, 2, 2) of the agreeing patches
    agreeing: int
    expected: int  # patches that the view should show
    correlation: float  # mean of the agreeing ones


def agreed_view(
    view: FloatArray,
    off_px: FloatArray,
    rates: FloatArray,
    open_px: FloatArray,
    scores: FloatArray,
    step: int,
    expected: int,
) -> AgreedView | None:
    """Return the view on which most patches agree, None for fewer than two.

    ``view`` (2,), pan and tilt, is where the patches were searched for. ``off_px`` (n, 2) is where they were
    found, from where that view has them; ``rates`` (n, 2, 2) how they move with pan and tilt, px/rad;
    ``open_px`` (n, 2) half of the line along which they may lie, since their ranges are not known; ``step``
    how many pixels of the full picture make one of the reduced.
    """
    if len(off_px) < 2:
        return None
    votes = (np.linalg.pinv(rates) @ off_px[..., None])[..., 0]  # near the pan axis one patch shows no pan
    rest = off_px[None] - np.einsum("nij,mj->mni", rates, votes)
    length2 = np.maximum((open_px**2).sum(axis=1), 1e-12)
    along = np.clip(np.einsum("mni,ni->mn", rest, open_px) / length2, -1.0, 1.0)
    apart = np.linalg.norm(rest - along[..., None] * open_px, axis=2)
    # 1.2: patches agree whose places differ by no more, reduced pixels: relief, shape, and the search itself.
    agree = apart <= 1.2 * step
    best = int(np.argmax(agree.sum(axis=1) - 1e-3 * np.where(agree, apart / step, 0.0).sum(axis=1)))
    which = agree[best]
    # What has a range says more than what has none.
    weights = 1.0 / (1.0 + length2[which] / (SEARCH_SIGMA * step) ** 2)
    weights /= weights.max()
    weighted = rates[which] * weights[:, None, None]
    inverse = np.linalg.pinv(np.einsum("nij,nik->jk", weighted, rates[which]))
    change = inverse @ np.einsum("nij,ni->j", weighted, off_px[which])
    left = off_px[which] - rates[which] @ change
    freedom = max(2.0 * float(weights.sum()) - 2.0, 1.0)
    variance_px2 = float(weights @ (left**2).sum(axis=1)) / freedom
    covariance = inverse * max(variance_px2, (SEARCH_SIGMA * step) ** 2)
    parallax = np.abs(np.einsum("jk,nik,ni->nj", inverse, weighted, open_px[which])).sum(axis=0)
    return AgreedView(
        view + change,
        np.sqrt(np.diag(covariance)),
        parallax,
        rates[which],
        int(which.sum()),
        expected,
        float(scores[which].mean()),
    )

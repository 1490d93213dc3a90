"""Find the dot board in an image: which dots, where to a few hundredths of a pixel, and how surely.

Spots that look like dots (``dot_candidates``) are grown into a grid (``dot_grid``), counted in the order
that the prediction tells (``dot_order``), fitted to the grey levels (``dot_refine``), and corrected for the
difference between the middle of a circle's image and the image of its centre (``dot_shape``).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.cahvor import CameraModel
from calib.dot_candidates import UNEVEN, UNEVEN_AT_MOST, Candidates, contrasts, dot_candidates
from calib.dot_grid import Lattice, grow_lattices
from calib.dot_map import PlaneMap, fit_plane_map
from calib.dot_order import Ordered, expected_steps_px, order_by_gravity, order_by_steps
from calib.dot_refine import centred, refine_dots
from calib.dot_shape import bias_through
from calib.rigid import FloatArray, Rigid
from calib.survey import Board, Dots

Image = NDArray[np.uint8]
IntArray = NDArray[np.int64]

PREDICTED_WITHIN_M = 0.25
PREDICTED_WITHIN_RAD = np.radians(12.0)
"""How wrong a prediction may be: rough cameras are good to 20 cm and 10 degrees."""

SIZE_WITHIN = 0.12
"""Relative error of the rough focal length, and what threshold and blur do to a spot's width."""

DIAMETERS_PX = (7.0, 12.0, 20.0, 34.0, 58.0, 100.0)
"""Widths of dots looked for where nothing is predicted, each good for dots down to half of it."""

SMALLEST_DOT_PX = 3.5
MOST_MISSING = 0.2
"""Share of dots that may be hidden; then the others are still counted safely."""

LEAST_SIGMA_PX = 0.003
"""What aliasing and whole grey levels leave at best."""

FAR_OFF = 6.0
"""Sigmas from the map of all dots, beyond which a dot is dropped."""


class DotsFound(NamedTuple):
    """Dots of one image.

    rows, columns (n,) from 0; pixels_px (n, 2), the images of the dots' centres; sigma_px (n,), one standard
    deviation per axis; residual_px, rms distance per axis to a smooth map of the board.
    """

    rows: IntArray
    columns: IntArray
    pixels_px: FloatArray
    sigma_px: FloatArray
    residual_px: float

    def as_dots(self) -> Dots:
        """Return what a survey holds of an image."""
        return Dots(self.rows, self.columns, self.pixels_px, self.sigma_px)


class DetectionFailure(NamedTuple):
    """Why there are no dots: one plain sentence."""

    reason: str


@dataclass(frozen=True, eq=False)
class Predicted:
    """Where the board should be: a rough camera, and the board's pose in the frame of its vectors."""

    camera: CameraModel
    frame_from_board: Rigid


@dataclass(frozen=True, eq=False)
class Upright:
    """Only that the camera stands upright.

    ``camera`` is a rough one in its own frame (x right, y down, z along A); ``down_in_board`` (3,) the
    direction in the board's frame that is down in an upright camera's image.
    """

    camera: CameraModel
    down_in_board: FloatArray


def find_dots(
    image: Image, board: Board, expected: Predicted | Upright | None = None
) -> DotsFound | DetectionFailure:
    """Return the dots of the board in an image, or why there are none.

    Parameters
    ----------
    image
        (h, w) grey levels; the centre of the top-left pixel is (0, 0).
    board
        Rows, columns, spacing and diameter.
    expected
        ``Predicted``, good to 20 cm and 10 degrees, gives the part of the image that is searched (the whole
        image after that), the size of dots and the order of rows and columns. Without it the whole image is
        searched for dots of any size, and rows and columns are counted so that the camera stands upright
        (``Upright``), or rows run to the right in the image (None). An order that is not sure is a failure.

    Raises
    ------
    ValueError
        If the image is not a (h, w) array of uint8.
    """
    if image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"an image of {image.shape} {image.dtype} where (h, w) uint8 is expected")
    steps_px = None
    if isinstance(expected, Predicted):
        hopeless = _hopeless(expected)
        if hopeless:
            return DetectionFailure(hopeless)
        steps_px = expected_steps_px(expected.camera, expected.frame_from_board)
    failure = DetectionFailure("no spot of the image looks like a dot of the board")
    furthest = -1
    for search in _searches(image, board, expected):
        left, top, right, bottom = search.box_px
        found = dot_candidates(image[top:bottom, left:right], *search.size_px, search.uneven)
        found = Candidates(found.middles_px + np.array([left, top]), found.shapes_px)
        grid, reached = _best_grid(image, found, board)
        if isinstance(grid, _Grid):
            ordered = _ordered(grid, board, expected, steps_px)
            result = (
                DetectionFailure(_unsure(steps_px))
                if ordered is None
                else _measured(image, board, grid, ordered)
            )
            if isinstance(result, DotsFound):
                return result
            reached += 1
        else:
            result = grid
        # The search that came furthest tells best what is wrong.
        if reached > furthest:
            furthest, failure = reached, result
    return failure


def _unsure(steps_px: FloatArray | None) -> str:
    """A sentence about an order that could be another."""
    against = "the upright" if steps_px is None else "the predicted pose"
    return f"the grid is found but not which corner is the first: it stands aslant against {against}"


class _Search(NamedTuple):
    box_px: tuple[int, int, int, int]  # left, top, right, bottom; the last two exclusive
    size_px: tuple[float, tuple[float, float]]  # diameter, and least and most area
    uneven: float


class _Grid(NamedTuple):
    """Dots with places 0 to counts - 1 along i and j, and their middles to some tenths of a pixel."""

    places: IntArray
    middles_px: FloatArray
    counts: tuple[int, int]
    map: PlaneMap  # from places to pixels


def _hopeless(expected: Predicted) -> str:
    """Say why the board cannot be seen where it is predicted, or nothing."""
    in_board = expected.frame_from_board.inverse
    eye = in_board.points(expected.camera.C)
    away = float(np.arctan2(-eye[2], np.hypot(eye[0], eye[1])))
    if away < -PREDICTED_WITHIN_RAD:
        return "by the survey the camera sees the back of the board"
    if expected_steps_px(expected.camera, expected.frame_from_board) is None:
        return "by the survey the board is outside what the camera's lens can see"
    return ""


def _searches(image: Image, board: Board, expected: Predicted | Upright | None) -> Iterator[_Search]:
    """Where to look and for what, the likeliest first."""
    height, width = image.shape
    whole = (0, 0, width, height)
    if isinstance(expected, Predicted):
        box, size = _predicted_search(board, expected, width, height)
        if size is not None:
            yield _Search(box, size, UNEVEN)
            diameter, (least, most) = size
            yield _Search(whole, (1.25 * diameter, (0.5 * least, 2.0 * most)), UNEVEN_AT_MOST)
    for diameter in DIAMETERS_PX:
        yield _Search(whole, (diameter, (0.12 * diameter**2, 1.2 * diameter**2)), UNEVEN)


def _predicted_search(
    board: Board, expected: Predicted, width: int, height: int
) -> tuple[tuple[int, int, int, int], tuple[float, tuple[float, float]] | None]:
    """The part of the image that must hold the dots, and their size; no size where they have no image."""
    camera, pose = expected.camera, expected.frame_from_board
    rows, columns = (a.ravel() for a in np.mgrid[0 : board.rows, 0 : board.columns])
    dots = pose.points(board.dots_in_board_m(rows, columns))
    pixels, jacobian, valid = camera.project_jacobian(dots)
    whole = (0, 0, width, height)
    if not valid.any():
        return whole, None
    shapes = jacobian[valid] @ pose.rotation[:, :2] * (board.dot_diameter_m / 2)
    lengths = np.linalg.svd(shapes, compute_uv=False)
    range_m = float(np.linalg.norm(dots - camera.C, axis=-1).min())
    near = 1.0 + PREDICTED_WITHIN_M / max(range_m, 2 * PREDICTED_WITHIN_M) + SIZE_WITHIN
    tilt = 1.3  # the board's tilt against the line of sight is wrong by the angle that the camera is
    areas = np.pi * lengths[:, 0] * lengths[:, 1]
    size = (
        2.0 * float(lengths[:, 0].max()) * near,
        (float(areas.min()) / near**2 / tilt / 1.3, float(areas.max()) * near**2 * tilt + 8.0),
    )
    if not valid.all():
        return whole, size
    px_per_rad = float(lengths[:, 0].max()) / (board.dot_diameter_m / 2) * range_m
    slack = px_per_rad * (PREDICTED_WITHIN_RAD + PREDICTED_WITHIN_M / range_m) + size[0] * 2
    low = np.floor(pixels.min(axis=0) - slack).astype(int)
    high = np.ceil(pixels.max(axis=0) + slack).astype(int) + 1
    box = (max(0, low[0]), max(0, low[1]), min(width, high[0]), min(height, high[1]))
    if box[2] - box[0] < 16 or box[3] - box[1] < 16:
        return whole, size
    return (int(box[0]), int(box[1]), int(box[2]), int(box[3])), size


def _best_grid(image: Image, found: Candidates, board: Board) -> tuple[_Grid | DetectionFailure, int]:
    """The board's grid, grown, else by OpenCV's clustering; and how many spots hang together."""
    wanted = board.rows * board.columns
    lattices = grow_lattices(found, 2.0 * board.spacing_m / board.dot_diameter_m)
    largest = len(lattices[0].spots) if lattices else 0
    grids = [
        _complete(image, found, lattice, board) for lattice in lattices[:3] if len(lattice.spots) > wanted / 3
    ]
    whole: list[_Grid] = []
    for grid in grids:
        # Two pieces of one board are both filled up to the same grid.
        if isinstance(grid, _Grid) and not any(_same(grid, other) for other in whole):
            whole.append(grid)
    if len(whole) > 1:
        told = f"{len(whole)} grids of {board.rows} x {board.columns} dots are in the image"
        return DetectionFailure(told), largest
    if whole:
        return whole[0], largest
    clustered = _clustered(found, board)
    if clustered is not None:
        grid = _complete(image, found, clustered, board)
        if isinstance(grid, _Grid):
            return grid, wanted
    if grids:
        return grids[0], largest
    spots = len(found.middles_px)
    told = (
        f"{spots} spots look like dots, and at most {largest} of them stand in a grid, "
        f"where {wanted} are expected"
    )
    return DetectionFailure(told), largest


def _same(one: _Grid, other: _Grid) -> bool:
    """Whether two grids stand at the same place."""
    apart = np.linalg.norm(one.middles_px.mean(axis=0) - other.middles_px.mean(axis=0))
    return bool(apart < 0.25 * np.ptp(one.middles_px, axis=0).max())


def _clustered(found: Candidates, board: Board) -> Lattice | None:
    """OpenCV's grid finder on the candidates, if they are few enough for it to end soon."""
    wanted = board.rows * board.columns
    if not wanted <= len(found.middles_px) <= 1.5 * wanted:
        return None
    points = found.middles_px.astype(np.float32).reshape(-1, 1, 2)
    flags = cv2.CALIB_CB_SYMMETRIC_GRID + cv2.CALIB_CB_CLUSTERING
    size = (board.columns, board.rows)
    # Without a detector OpenCV takes the picture for the points; its type hints do not know.
    finder: Any = cv2.findCirclesGrid
    done, corners = finder(points, size, flags, None, cv2.CirclesGridFinderParameters())
    if not done or corners is None:
        return None
    corners = corners.reshape(-1, 2)
    spots = np.linalg.norm(found.middles_px[None] - corners[:, None], axis=-1).argmin(axis=1)
    rows, columns = np.divmod(np.arange(wanted), board.columns)
    return Lattice(spots, np.stack([columns, rows], axis=-1))


def _complete(image: Image, found: Candidates, lattice: Lattice, board: Board) -> _Grid | DetectionFailure:
    """Fill the gaps of a lattice and cut the board out of it, or say what is missing."""
    places, middles = lattice.places, found.middles_px[lattice.spots]
    radius = board.dot_diameter_m / 2 / board.spacing_m
    contrast = float(np.median(contrasts(image, middles, found.shapes_px[lattice.spots])[0]))
    for _ in range(3):
        plane_map = _consistent_map(places, middles)
        if plane_map is None:
            return DetectionFailure("spots that look like dots do not make a flat grid")
        at = plane_map.pixels(places.astype(np.float64))
        step = np.sqrt(np.abs(np.linalg.det(plane_map.jacobian(places.astype(np.float64)))))
        fits = np.linalg.norm(middles - at, axis=-1) < 0.15 * step
        places, middles = places[fits], middles[fits]
        more, at = _gaps(image, places, plane_map, radius, contrast)
        if not len(more):
            break
        places, middles = np.concatenate([places, more]), np.concatenate([middles, at])
    return _cut_out(image, places, middles, board)


def _consistent_map(places: IntArray, middles: FloatArray) -> PlaneMap | None:
    """The map from places to pixels, fitted again without spots that do not fit it."""
    points = places.astype(np.float64)
    plane_map = fit_plane_map(points, middles)
    if plane_map is None:
        return None
    off = np.linalg.norm(plane_map.pixels(points) - middles, axis=-1)
    good = off <= max(0.5, 4.0 * float(np.median(off)))
    return plane_map if good.all() else fit_plane_map(points[good], middles[good])


def _gaps(
    image: Image, places: IntArray, plane_map: PlaneMap, radius: float, contrast_dn: float
) -> tuple[IntArray, FloatArray]:
    """Places inside and one beyond the lattice without a spot that hold a dot after all, and where."""
    low, high = places.min(axis=0) - 1, places.max(axis=0) + 1
    i, j = (a.ravel() for a in np.mgrid[low[0] : high[0] + 1, low[1] : high[1] + 1])
    known = set(map(tuple, places.tolist()))
    free = np.array([p for p in zip(i.tolist(), j.tolist(), strict=True) if p not in known], dtype=np.int64)
    if not len(free):
        return np.empty((0, 2), dtype=np.int64), np.empty((0, 2))
    points = free.astype(np.float64)
    at, shapes = plane_map.pixels(points), plane_map.jacobian(points) * radius
    darker, spread = contrasts(image, at, shapes)
    with np.errstate(invalid="ignore"):
        dots = (darker > 0.5 * contrast_dn) & (spread < UNEVEN_AT_MOST * darker)
    at = at[dots]
    return free[dots], centred(image, at, shapes[dots]) if len(at) else at


def _cut_out(image: Image, places: IntArray, middles: FloatArray, board: Board) -> _Grid | DetectionFailure:
    """The window of the lattice that is the board, if there is only one."""
    wanted = board.rows * board.columns
    low, high = places.min(axis=0), places.max(axis=0)
    windows = []
    for counts in sorted({(board.columns, board.rows), (board.rows, board.columns)}):
        for i in range(low[0], max(low[0], high[0] - counts[0] + 1) + 1):
            for j in range(low[1], max(low[1], high[1] - counts[1] + 1) + 1):
                inside = ((places >= [i, j]) & (places < [i + counts[0], j + counts[1]])).all(axis=1)
                windows.append((int(inside.sum()), (i, j), counts, inside))
    windows.sort(key=lambda window: -window[0])
    number, origin, counts, inside = windows[0]
    spans = high - low + 1
    if number < (1.0 - MOST_MISSING) * wanted or min(spans) < min(counts) or max(spans) < max(counts):
        return DetectionFailure(_too_few(image, number, spans, middles, board))
    own = places[inside] - np.array(origin)
    for axis in (0, 1):
        for line in (0, counts[axis] - 1):
            # An outer line that is hardly there could as well be the one beyond the other side.
            if (own[:, axis] == line).sum() < counts[1 - axis] / 2:
                return DetectionFailure(_too_few(image, number, spans, middles, board))
    if len(windows) > 1 and windows[1][0] > number - 3:
        return DetectionFailure(f"the grid is larger than {board.rows} x {board.columns} dots")
    plane_map = fit_plane_map(own.astype(np.float64), middles[inside])
    if plane_map is None:
        return DetectionFailure("spots that look like dots do not make a flat grid")
    return _Grid(own, middles[inside], counts, plane_map)


def _too_few(image: Image, number: int, spans: IntArray, middles: FloatArray, board: Board) -> str:
    """A sentence about a part of a board."""
    height, width = image.shape
    step = np.sqrt(np.prod(np.ptp(middles, axis=0) + 1) / np.prod(spans))
    low, high = middles.min(axis=0), middles.max(axis=0)
    beyond = [
        side
        for side, near in (
            ("left", low[0] < step),
            ("top", low[1] < step),
            ("right", high[0] > width - 1 - step),
            ("bottom", high[1] > height - 1 - step),
        )
        if near
    ]
    told = f"only {number} dots in a grid of {min(spans)} x {max(spans)} are seen"
    told += f" where {board.rows} x {board.columns} are expected"
    return told + (f"; the board reaches over the {' and '.join(beyond)} edge of the image" if beyond else "")


def _ordered(
    grid: _Grid,
    board: Board,
    expected: Predicted | Upright | None,
    steps_px: FloatArray | None,
) -> Ordered | None:
    """Rows and columns of the grid's dots, or None if not sure."""
    if isinstance(expected, Upright):
        return order_by_gravity(
            grid.places, grid.counts, grid.middles_px, board, expected.camera, expected.down_in_board
        )
    steps = grid.map.jacobian((np.array(grid.counts) - 1) / 2)
    return order_by_steps(grid.places, grid.counts, steps, board, np.eye(2) if steps_px is None else steps_px)


def _measured(image: Image, board: Board, grid: _Grid, ordered: Ordered) -> DotsFound | DetectionFailure:
    """Fit every dot of the grid and correct for the shape of circles."""
    points = board.dots_in_board_m(ordered.rows, ordered.columns)[:, :2]
    radius = board.dot_diameter_m / 2
    first = fit_plane_map(points, grid.middles_px)
    if first is None:
        return DetectionFailure("spots that look like dots do not make a flat grid")
    shapes = first.jacobian(points) * radius
    if float(np.linalg.svd(shapes, compute_uv=False)[:, 0].max()) < SMALLEST_DOT_PX / 2:
        return DetectionFailure(
            f"the dots are smaller than {SMALLEST_DOT_PX:g} px across: the board is too far away"
        )
    fit = refine_dots(image, grid.middles_px, shapes)
    height, width = image.shape
    reach = np.linalg.norm(shapes, axis=-1)  # of each dot's outline in x and y
    inside = ((fit.middles_px > reach) & (fit.middles_px < [width - 1, height - 1] - reach)).all(axis=1)
    if not np.isfinite(fit.sizes).any():
        return DetectionFailure("the grid is found but its spots do not look like dots from near")
    with np.errstate(invalid="ignore"):
        good = inside & (fit.contrast_dn > 0.4 * np.nanmedian(fit.contrast_dn))
        good &= np.abs(fit.sizes / np.nanmedian(fit.sizes) - 1.0) < 0.25
    least = (1.0 - MOST_MISSING) * board.rows * board.columns
    sigma = np.hypot(fit.sigma_px, LEAST_SIGMA_PX)
    for _ in range(5):
        if good.sum() < least:
            return DetectionFailure(
                f"only {int(good.sum())} of {board.rows * board.columns} dots can be measured well"
            )
        centres = fit.middles_px - bias_through(first.pixels, points, radius)
        plane_map = fit_plane_map(points[good], centres[good])
        if plane_map is None:
            return DetectionFailure("spots that look like dots do not make a flat grid")
        centres = fit.middles_px - bias_through(plane_map.pixels, points, radius)
        off = plane_map.pixels(points) - centres
        first = plane_map
        # Where the noise alone explains too little, the spread of the residuals is the honest sigma.
        freedom = max(1, 2 * int(good.sum()) - plane_map.parameters)
        excess = np.sqrt(float(np.sum((off[good] / sigma[good, None]) ** 2)) / freedom)
        scale = max(1.0, excess)
        far = good & (np.linalg.norm(off, axis=-1) > FAR_OFF * scale * sigma)
        if not far.any():
            break
        good &= ~far
    return DotsFound(
        ordered.rows[good],
        ordered.columns[good],
        centres[good],
        scale * sigma[good],
        float(np.sqrt(np.mean(off[good] ** 2))),
    )

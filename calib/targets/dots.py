"""Find the dot board in an image: which dots, where to a few hundredths of a pixel, and how surely.

Spots that look like dots are grown into a grid, out of which the board is cut (`calib.targets.dot_grid`).
All four sides of a grid look the same: the direction of the rows in the image decides which row and column is
the first, against the board's predicted pose, or against a camera taken as upright. Whether rows and columns
are mirrored is known from the side that the board is seen from. The dots are then fitted to the grey levels
(`calib.targets.dot_middles`), and a correction leads from the middle of a circle's image to the image of its
centre.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray, IntArray, Rigid
from calib.targets.boards import CornersNotFound, DotBoard, Dots, Grey8, Levels
from calib.targets.dot_grid import (
    MOST_MISSING,
    UNEVEN,
    UNEVEN_AT_MOST,
    BoardGrid,
    Candidates,
    best_grid,
    dot_candidates,
    fit_plane_map,
    homography,
)
from calib.targets.dot_middles import bias_through, fit_ellipses

SMALLEST_DOT_PX = 3.5

SURE_RAD = np.radians(32.0)
"""The nearest order is taken if it is off by less than this; the next is then 58 degrees off or more."""

PREDICTED_WITHIN_M = 0.25
PREDICTED_WITHIN_RAD = np.radians(12.0)
"""How wrong a prediction may be: rough cameras are good to 20 cm and 10 degrees."""


def find_dots(
    image: Levels, board: DotBoard, expected: PredictedBoard | Upright | None = None
) -> Dots | CornersNotFound:
    """Return the dots of the board in an image, or why there are none.

    ``image`` is (h, w) grey levels of 8 or 16 bits (else ValueError); the centre of the top-left pixel is (0,
    0). Of 16 bits all count where dots are measured; they are looked for in what 8 bits hold of the levels
    that occur.

    A ``PredictedBoard``, good to 20 cm and 10 degrees, gives the part of the image that is searched first,
    the size of dots and the order of rows and columns. Without it the whole image is searched for dots of any
    size. Rows and columns are then counted so that the camera stands upright (``Upright``), or rows run to
    the right in the image (None). An order that is not sure is a failure.
    """
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"an image of {image.shape} {image.dtype} where (h, w) uint8 or uint16 is expected")
    levels, image = image, in_8_bits(image)
    steps_px = None
    if isinstance(expected, PredictedBoard):
        no_hope = hopeless(expected)
        if no_hope:
            return CornersNotFound(no_hope)
        steps_px = expected_steps_px(expected.camera, expected.frame_from_board)
    failure = CornersNotFound("no spot of the image looks like a dot of the board")
    furthest = -1
    for search in searches(image, board, expected):
        left, top, right, bottom = search.box_px
        found = dot_candidates(image[top:bottom, left:right], *search.size_px, search.uneven)
        found = Candidates(found.middles_px + np.array([left, top]), found.shapes_px)
        grid, reached = best_grid(image, found, board)
        if isinstance(grid, BoardGrid):
            if isinstance(expected, Upright):
                ordered = order_by_gravity(grid, board, expected)
            else:
                ordered = order_by_steps(grid, board, np.eye(2) if steps_px is None else steps_px)
            result = (
                CornersNotFound(
                    "the grid is found but not which corner is the first: it stands aslant against "
                    + ("the upright" if steps_px is None else "the predicted pose")
                )
                if ordered is None
                else _measured(levels, board, grid, ordered)
            )
            if isinstance(result, Dots):
                return result
            reached += 1
        else:
            result = grid
        # The search that came furthest tells best what is wrong.
        if reached > furthest:
            furthest, failure = reached, result
    return failure


def in_8_bits(image: Levels) -> Grey8:
    """Return an image in 8 bits: its levels but the darkest and brightest thousandth, spread over them."""
    if image.dtype == np.uint8:
        return image.astype(np.uint8, copy=False)
    dark, bright = np.percentile(image, (0.1, 99.9))
    spread = (image - dark) * (255.0 / max(bright - dark, 1.0))
    return np.asarray(np.clip(np.rint(spread), 0, 255), dtype=np.uint8)


def _measured(
    image: Levels, board: DotBoard, grid: BoardGrid, ordered: tuple[IntArray, IntArray]
) -> Dots | CornersNotFound:
    """Fit every dot of the grid and correct for the shape of circles."""
    rows, columns = ordered
    points = board.dots_in_board_m(rows, columns)[:, :2]
    radius = board.dot_diameter_m / 2
    first = fit_plane_map(points, grid.middles_px)
    if first is None:
        return CornersNotFound("spots that look like dots do not make a flat grid")
    shapes = first.jacobian(points) * radius
    if float(np.linalg.svd(shapes, compute_uv=False)[:, 0].max()) < SMALLEST_DOT_PX / 2:
        return CornersNotFound(
            f"the dots are smaller than {SMALLEST_DOT_PX:g} px across: the board is too far away"
        )
    fit = fit_ellipses(image, grid.middles_px, shapes)
    height, width = image.shape
    reach = np.linalg.norm(shapes, axis=-1)  # of each dot's outline in x and y
    inside = ((fit.middles_px > reach) & (fit.middles_px < [width - 1, height - 1] - reach)).all(axis=1)
    if not np.isfinite(fit.sizes).any():
        return CornersNotFound("the grid is found but its spots do not look like dots from near")
    with np.errstate(invalid="ignore"):
        good = inside & (fit.contrast_dn > 0.4 * np.nanmedian(fit.contrast_dn))
        good &= np.abs(fit.sizes / np.nanmedian(fit.sizes) - 1.0) < 0.25
    least = (1.0 - MOST_MISSING) * board.rows * board.columns
    sigma = np.hypot(fit.sigma_px, 0.003)  # the best that aliasing and whole grey levels allow
    for _ in range(5):
        if good.sum() < least:
            return CornersNotFound(
                f"only {int(good.sum())} of {board.rows * board.columns} dots can be measured well"
            )
        centres = fit.middles_px - bias_through(first.pixels, points, radius)
        plane_map = fit_plane_map(points[good], centres[good])
        if plane_map is None:
            return CornersNotFound("spots that look like dots do not make a flat grid")
        centres = fit.middles_px - bias_through(plane_map.pixels, points, radius)
        off = plane_map.pixels(points) - centres
        first = plane_map
        # Where the noise alone explains too little, the spread of the residuals is the honest sigma.
        freedom = max(1, 2 * int(good.sum()) - plane_map.parameters)
        excess = np.sqrt(float(np.sum((off[good] / sigma[good, None]) ** 2)) / freedom)
        scale = max(1.0, excess)
        far = good & (np.linalg.norm(off, axis=-1) > 6.0 * scale * sigma)
        if not far.any():
            break
        good &= ~far
    return Dots(
        rows[good],
        columns[good],
        centres[good],
        scale * sigma[good],
    )


def order_by_steps(
    grid: BoardGrid, board: DotBoard, expected_px: FloatArray
) -> tuple[IntArray, IntArray] | None:
    """Return rows and columns (n,) so that their directions in the image are nearest to the expected ones.

    ``expected_px`` (2, 2) is where the steps of columns and rows should point, as columns. None if no way to
    count fits within ``SURE_RAD``.
    """
    steps_px = grid.map.jacobian((np.array(grid.counts) - 1) / 2)

    def turn_rad(order: _Counting) -> float | None:
        found = steps_px @ np.linalg.inv(order.step_from_ij)
        if np.linalg.det(found) * np.linalg.det(expected_px) <= 0.0:
            return None
        turn = found @ np.linalg.inv(expected_px)  # the angle of the nearest rotation
        return float(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))

    return _surest(grid, board, turn_rad)


def order_by_gravity(grid: BoardGrid, board: DotBoard, upright: Upright) -> tuple[IntArray, IntArray] | None:
    """Return rows and columns (n,) so that the camera that took the picture stands upright.

    None as of `order_by_steps`, and if the camera looks down so steeply that its uprightness shows nothing.
    """
    from_places = _camera_from_places(upright.camera, grid.places, grid.middles_px)
    if from_places is None:
        return None

    def turn_rad(order: _Counting) -> float | None:
        affine = np.eye(3)  # from metres on the board to (i, j)
        undo = np.linalg.inv(order.step_from_ij)
        shift = np.array([order.columns[0], order.rows[0]]) - order.step_from_ij @ grid.places[0]
        middle = np.array([board.columns - 1, board.rows - 1]) / 2
        affine[:2, :2], affine[:2, 2] = undo / board.spacing_m, undo @ (middle - shift)
        H = from_places @ affine
        H = H / np.linalg.norm(H[:, 0])
        if np.linalg.det(H) <= 0.0:  # seen from behind
            return None
        U, _, Vt = np.linalg.svd(np.column_stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])]))
        down = U @ Vt @ upright.down_in_board
        if np.hypot(down[0], down[1]) < 0.3:  # so little of the vertical in the image shows nothing
            return None
        return float(np.arctan2(-down[0], down[1]))

    return _surest(grid, board, turn_rad)


class _Counting(NamedTuple):
    """A way to count: columns and rows (n,), and (2, 2) from steps of (i, j) to steps of these."""

    columns: IntArray
    rows: IntArray
    step_from_ij: FloatArray


def _surest(
    grid: BoardGrid, board: DotBoard, turn_rad: Callable[[_Counting], float | None]
) -> tuple[IntArray, IntArray] | None:
    """Rows and columns of the way to count that is turned least, if it is near enough."""
    turned: list[tuple[float, _Counting]] = []
    last = np.array(grid.counts) - 1
    for swap in (False, True):
        if (grid.counts[::-1] if swap else grid.counts) != (board.columns, board.rows):
            continue
        for flips in ((0, 0), (0, 1), (1, 0), (1, 1)):
            flipped = np.where(flips, last - grid.places, grid.places)
            columns, rows = flipped.T[::-1] if swap else flipped.T
            signs = np.diag([-1.0 if flip else 1.0 for flip in flips])
            order = _Counting(columns, rows, signs[::-1] if swap else signs)
            if (turn := turn_rad(order)) is not None:
                turned.append((abs(turn), order))
    least = min(turned, key=lambda one: one[0], default=None)
    return None if least is None or least[0] >= SURE_RAD else (least[1].rows, least[1].columns)


def _camera_from_places(camera: CameraModel, places: IntArray, middles_px: FloatArray) -> FloatArray | None:
    """(3, 3) that carries (i, j, 1) to points ahead of the camera, up to one positive factor."""
    rays = camera.ray(middles_px)
    if not rays.valid.all():
        return None
    ahead = rays.directions.mean(axis=0)
    # Slopes are taken about the board's own direction, so that a board far aside is as good as one in front.
    across = np.linalg.svd(ahead[None])[2][1:]
    frame = np.array([*across, ahead / np.linalg.norm(ahead)])
    turned = rays.directions @ frame.T
    H = homography(places.astype(np.float64), turned[:, :2] / turned[:, 2:])
    if H is None:
        return None
    depth = places.mean(axis=0) @ H[2, :2] + H[2, 2]
    return np.asarray(frame.T @ H * np.sign(depth), dtype=np.float64)


def expected_steps_px(camera: CameraModel, frame_from_board: Rigid) -> FloatArray | None:
    """Return the predicted steps of columns and rows at the board's middle, px/m, as columns of (2, 2)."""
    _, jacobian, valid = camera.project_jacobian(frame_from_board.translation_m)
    return np.asarray(jacobian @ frame_from_board.rotation[:, :2]) if valid else None


@dataclass(frozen=True, eq=False)
class PredictedBoard:
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


class DotSearch(NamedTuple):
    box_px: tuple[int, int, int, int]  # left, top, right, bottom; the last two exclusive
    size_px: tuple[float, tuple[float, float]]  # diameter, and least and most area
    uneven: float


def hopeless(expected: PredictedBoard) -> str:
    """Say why the board cannot be seen where it is predicted, or nothing."""
    in_board = expected.frame_from_board.inverse
    camera_m = in_board.points(expected.camera.C)
    away = float(np.arctan2(-camera_m[2], np.hypot(camera_m[0], camera_m[1])))
    if away < -PREDICTED_WITHIN_RAD:
        return "by the survey the camera sees the back of the board"
    if expected_steps_px(expected.camera, expected.frame_from_board) is None:
        return "by the survey the board is outside what the camera's lens can see"
    return ""


def searches(image: Grey8, board: DotBoard, expected: PredictedBoard | Upright | None) -> Iterator[DotSearch]:
    """Where to look and for what, the likeliest first."""
    height, width = image.shape
    whole = (0, 0, width, height)
    if isinstance(expected, PredictedBoard):
        box, size = _predicted_search(board, expected, width, height)
        if size is not None:
            yield DotSearch(box, size, UNEVEN)
            diameter, (least, most) = size
            yield DotSearch(whole, (1.25 * diameter, (0.5 * least, 2.0 * most)), UNEVEN_AT_MOST)
    for diameter in (7.0, 12.0, 20.0, 34.0, 58.0, 100.0):  # each good for dots down to half of it
        yield DotSearch(whole, (diameter, (0.12 * diameter**2, 1.2 * diameter**2)), UNEVEN)


def _predicted_search(
    board: DotBoard, expected: PredictedBoard, width: int, height: int
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
    # 0.12: the error of the rough focal length, and what threshold and blur do to a spot's width
    near = 1.0 + PREDICTED_WITHIN_M / max(range_m, 2 * PREDICTED_WITHIN_M) + 0.12
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

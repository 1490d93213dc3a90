"""Find the dot board in an image: which dots, where to a few hundredths of a pixel, and how surely.

Spots that look like dots (`calib.targets.dot_spots`) are grown into a grid, out of which the board is cut
(`calib.targets.dot_grid`). They are counted in the predicted order (`calib.targets.dot_order`) and fitted to
the grey levels (`calib.targets.dot_middles`). A correction leads from the middle of a circle's image to the
image of its centre.
"""

from __future__ import annotations

import numpy as np

from calib.geometry.rigid import FloatArray
from calib.targets.boards import Board, CornersNotFound, Dots, Grey8, Levels
from calib.targets.dot_grid import MOST_MISSING, BoardGrid, best_grid, fit_plane_map
from calib.targets.dot_middles import bias_through, fit_ellipses
from calib.targets.dot_order import (
    Ordered,
    PredictedBoard,
    Upright,
    expected_steps_px,
    hopeless,
    order_by_gravity,
    order_by_steps,
    searches,
)
from calib.targets.dot_spots import Candidates, dot_candidates

UNSURE = "the grid is found but not which corner is the first: it stands aslant against"
SMALLEST_DOT_PX = 3.5


def find_dots(
    image: Levels, board: Board, expected: PredictedBoard | Upright | None = None
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
            ordered = _ordered(grid, board, expected, steps_px)
            result = (
                CornersNotFound(f"{UNSURE} {'the upright' if steps_px is None else 'the predicted pose'}")
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


def _ordered(
    grid: BoardGrid,
    board: Board,
    expected: PredictedBoard | Upright | None,
    steps_px: FloatArray | None,
) -> Ordered | None:
    """Rows and columns of the grid's dots, or None if not sure."""
    if isinstance(expected, Upright):
        return order_by_gravity(
            grid.places, grid.counts, grid.middles_px, board, expected.camera, expected.down_in_board
        )
    steps = grid.map.jacobian((np.array(grid.counts) - 1) / 2)
    return order_by_steps(grid.places, grid.counts, steps, board, np.eye(2) if steps_px is None else steps_px)


def _measured(image: Levels, board: Board, grid: BoardGrid, ordered: Ordered) -> Dots | CornersNotFound:
    """Fit every dot of the grid and correct for the shape of circles."""
    points = board.dots_in_board_m(ordered.rows, ordered.columns)[:, :2]
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
        ordered.rows[good],
        ordered.columns[good],
        centres[good],
        scale * sigma[good],
        float(np.sqrt(np.mean(off[good] ** 2))),
    )

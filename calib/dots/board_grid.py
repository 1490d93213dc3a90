"""The board's whole grid out of spots that may be its dots, or what is missing of it."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np

from calib.dots.candidates import UNEVEN_AT_MOST, Candidates, Image, contrasts
from calib.dots.ellipses import centred
from calib.dots.lattice import IntArray, Lattice, grow_lattices
from calib.dots.plane_map import PlaneMap, fit_plane_map
from calib.rigid import FloatArray
from calib.survey import Board

MOST_MISSING = 0.2
"""Share of dots that may be hidden; then the others are still counted safely."""


class DetectionFailure(NamedTuple):
    """Why there are no dots: one plain sentence."""

    reason: str


class BoardGrid(NamedTuple):
    """Dots with places 0 to counts - 1 along i and j, and their middles to some tenths of a pixel."""

    places: IntArray
    middles_px: FloatArray
    counts: tuple[int, int]
    map: PlaneMap  # from places to pixels


def best_grid(image: Image, found: Candidates, board: Board) -> tuple[BoardGrid | DetectionFailure, int]:
    """The board's grid, grown, else by OpenCV's clustering; and how many spots hang together."""
    wanted = board.rows * board.columns
    lattices = grow_lattices(found, 2.0 * board.spacing_m / board.dot_diameter_m)
    largest = len(lattices[0].spots) if lattices else 0
    grids = [
        _complete(image, found, lattice, board) for lattice in lattices[:3] if len(lattice.spots) > wanted / 3
    ]
    whole: list[BoardGrid] = []
    for grid in grids:
        # Two pieces of one board are both filled up to the same grid.
        if isinstance(grid, BoardGrid) and not any(_same(grid, other) for other in whole):
            whole.append(grid)
    if len(whole) > 1:
        told = f"{len(whole)} grids of {board.rows} x {board.columns} dots are in the image"
        return DetectionFailure(told), largest
    if whole:
        return whole[0], largest
    clustered = _clustered(found, board)
    if clustered is not None:
        grid = _complete(image, found, clustered, board)
        if isinstance(grid, BoardGrid):
            return grid, wanted
    if grids:
        return grids[0], largest
    spots = len(found.middles_px)
    told = (
        f"{spots} spots look like dots, and at most {largest} of them stand in a grid, "
        f"where {wanted} are expected"
    )
    return DetectionFailure(told), largest


def _same(one: BoardGrid, other: BoardGrid) -> bool:
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


def _complete(
    image: Image, found: Candidates, lattice: Lattice, board: Board
) -> BoardGrid | DetectionFailure:
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
    points = free.astype(np.float64)
    at, shapes = plane_map.pixels(points), plane_map.jacobian(points) * radius
    darker, spread = contrasts(image, at, shapes)
    with np.errstate(invalid="ignore"):
        dots = (darker > 0.5 * contrast_dn) & (spread < UNEVEN_AT_MOST * darker)
    at = at[dots]
    return free[dots], centred(image, at, shapes[dots]) if len(at) else at


def _cut_out(
    image: Image, places: IntArray, middles: FloatArray, board: Board
) -> BoardGrid | DetectionFailure:
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
    return BoardGrid(own, middles[inside], counts, plane_map)


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

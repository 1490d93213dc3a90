"""The dots of a board in an image: spots that may be some, neighbours linked, the whole board cut out.

A loose blob detector finds thousands of blobs on gravel, and a grid search among them takes half a minute.
Here each spot must be a filled ellipse with an even ring of paper around it, which gravel hardly ever offers.

The shape of a dot's image gives the local tilt: undone, the four neighbours of a dot stand at one spacing in
two directions at right angles. From neighbour to neighbour the grid grows over the board; each step adapts to
the last, so perspective and lens distortion bend it freely.

The map from the board's plane to the image needs no camera model: it is a homography and a polynomial in the
place on the board, for the lens. It carries dots that were missed to where they must be, gives every dot's
shape and the bias of its centre, and finds dots that do not fit the others.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from calib.geometry.rigid import FloatArray, IntArray
from calib.targets.boards import CornersNotFound, DotBoard, Grey8
from calib.targets.dot_middles import centred


@dataclass(frozen=True, eq=False)
class PlaneMap:
    """Places on the board, metres, to pixels.

    ``homography`` (3, 3) acts on metres; ``bend`` (terms, 2), px, on the powers of metres / ``scale_m`` (of
    none: a plane without a lens).
    """

    homography: FloatArray
    bend: FloatArray
    scale_m: float

    def pixels(self, points_m: ArrayLike) -> FloatArray:
        """Return pixels (..., 2) of points (..., 2), metres in the board's plane."""
        points = np.asarray(points_m, dtype=np.float64)
        pixels = carried(self.homography, points)
        if len(self.bend):
            pixels = pixels + _powers(points / self.scale_m, len(self.bend)) @ self.bend
        return np.asarray(pixels)

    def jacobian(self, points_m: ArrayLike) -> FloatArray:
        """Return d pixel / d point (..., 2, 2), px/m."""
        points = np.asarray(points_m, dtype=np.float64)
        step = 1e-4 * self.scale_m
        sides = [
            (self.pixels(points + step * axis) - self.pixels(points - step * axis)) / (2 * step)
            for axis in np.eye(2)
        ]
        return np.stack(sides, axis=-1)

    @property
    def parameters(self) -> int:
        """How many numbers were fitted."""
        return 8 + 2 * max(0, len(self.bend) - 4)


def carried(matrix: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (..., 2) after a homography (3, 3)."""
    whole = points @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(whole[..., :2] / whole[..., 2:])


def homography(points: FloatArray, pixels: FloatArray, within_px: float = 0.0) -> FloatArray | None:
    """Return the (3, 3) that carries points (n, 2) to pixels (n, 2); None if they determine none.

    Where some may be wrong, ``within_px`` is how far off the others are at most.
    """
    method = cv2.RANSAC if within_px else 0
    H, _ = cv2.findHomography(points, pixels, method, within_px or 3.0, maxIters=4000)
    return None if H is None or not np.isfinite(H).all() else np.asarray(H, dtype=np.float64)


def fit_plane_map(points_m: FloatArray, pixels_px: FloatArray) -> PlaneMap | None:
    """Return the map that fits the dots (n, 2) best, or None where they determine none (fewer than 6)."""
    if len(points_m) < 6:
        return None
    scale = float(np.abs(points_m).max())
    middle = pixels_px.mean(axis=0)
    H = homography(points_m / scale, pixels_px - middle)
    if H is None:
        return None
    back = np.array([[1.0, 0.0, middle[0]], [0.0, 1.0, middle[1]], [0.0, 0.0, 1.0]])
    whole = np.asarray(back @ H @ np.diag([1 / scale, 1 / scale, 1.0]), dtype=np.float64)
    flat = PlaneMap(whole, np.empty((0, 2)), scale)
    terms = 21 if len(points_m) >= 90 else 10 if len(points_m) >= 40 else 0  # of degree 5 and 3
    if not terms:
        return flat
    powers = _powers(points_m / scale, terms)
    bend, _, rank, _ = np.linalg.lstsq(powers, pixels_px - flat.pixels(points_m), rcond=1e-9)
    return PlaneMap(whole, np.asarray(bend, dtype=np.float64), scale) if rank == terms else flat


def _powers(points: FloatArray, terms: int) -> FloatArray:
    """x**i y**j along the last axis: i + j up to 3 for 10 terms, up to 5 for 21."""
    x, y, degree = points[..., 0], points[..., 1], {10: 3, 21: 5}[terms]
    return np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=-1)


WIDEST_RATIO = 3.5  # major to minor axis: a board seen more flatly has dots that cannot be distinguished
UNEVEN = 0.22  # spread of the ring of paper, in units of its contrast to the dot
UNEVEN_AT_MOST = 0.4  # the same where the strict search found no grid
RING_POINTS = 16
LEAST_CONTRAST_DN = 14.0


class Candidates(NamedTuple):
    """Spots: middles (n, 2) px, and shapes (n, 2, 2) that carry the unit circle to each spot's outline."""

    middles_px: FloatArray
    shapes_px: FloatArray

    def some(self, good: NDArray[np.bool_]) -> Candidates:
        """Return some of them."""
        return Candidates(self.middles_px[good], self.shapes_px[good])


def dot_candidates(
    image: Grey8, diameter_px: float, area_px2: tuple[float, float], uneven: float = UNEVEN
) -> Candidates:
    """Return the spots that look like dots.

    ``diameter_px`` is that of the largest dot to be found, along its longer axis; it sets the window in which
    paper is looked for. ``area_px2`` are a dot's smallest and largest area, ``uneven`` how uneven the paper
    around it may be, in units of its contrast to the dot.
    """
    smooth = np.asarray(cv2.GaussianBlur(image, (0, 0), min(0.8, 0.08 * diameter_px)), dtype=np.uint8)
    window = 2 * int(np.ceil(0.8 * diameter_px + 1)) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (window, window))
    paper = cv2.morphologyEx(smooth, cv2.MORPH_CLOSE, kernel)
    dark = cv2.erode(smooth, kernel)
    middle = cv2.addWeighted(paper, 0.5, dark, 0.5, 0.0)
    contrast = cv2.subtract(paper, dark)
    mask = ((smooth < middle) & (contrast > LEAST_CONTRAST_DN)).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    area = stats[:, cv2.CC_STAT_AREA]
    width, height = stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]
    longest = np.maximum(width, height)
    good = (area >= max(6, area_px2[0])) & (area <= area_px2[1])
    good &= (longest <= 1.6 * diameter_px + 3) & (longest <= WIDEST_RATIO * np.minimum(width, height))
    good[0] = False
    found = _ellipses(np.asarray(labels, dtype=np.int32), np.flatnonzero(good), count)
    if not len(found.middles_px):
        return found
    contrast_dn, spread_dn = contrasts(smooth, *found)
    with np.errstate(invalid="ignore"):
        in_paper = (contrast_dn > LEAST_CONTRAST_DN) & (spread_dn < uneven * contrast_dn)
    return found.some(in_paper & (in_paper.sum() <= 3000))  # more are gravel


def _ellipses(labels: NDArray[np.int32], wanted: NDArray[np.int64], count: int) -> Candidates:
    """Return the components that fill the ellipse of their second moments."""
    number = np.full(count, -1)
    number[wanted] = np.arange(len(wanted))
    y, x = np.nonzero(labels)
    which = number[labels[y, x]]
    inside = which >= 0
    which, x, y = which[inside], x[inside].astype(np.float64), y[inside].astype(np.float64)

    def mean(values: NDArray[Any]) -> FloatArray:
        return np.bincount(which, values, len(wanted)) / area

    area = np.bincount(which, minlength=len(wanted)).astype(np.float64)
    mx, my = mean(x), mean(y)
    dx, dy = x - mx[which], y - my[which]
    xx, xy, yy = mean(dx * dx) + 1 / 12, mean(dx * dy), mean(dy * dy) + 1 / 12
    root = np.sqrt(np.maximum(xx * yy - xy * xy, 1e-12))
    fill = area / (4.0 * np.pi * root)
    # The square root of a symmetric 2x2 matrix S is (S + sqrt(det S) I) / sqrt(trace S + 2 sqrt(det S)).
    scale = 2.0 / np.sqrt(xx + yy + 2.0 * root)
    shapes = scale[:, None, None] * np.stack(
        [np.stack([xx + root, xy], axis=-1), np.stack([xy, yy + root], axis=-1)], axis=-2
    )
    spread = np.sqrt(np.maximum((xx + yy) ** 2 / 4 - root**2, 0.0))
    flat = np.sqrt(((xx + yy) / 2 + spread) / np.maximum((xx + yy) / 2 - spread, 1e-9))
    good = (fill > 0.80) & (fill < 1.15) & (flat < WIDEST_RATIO)
    return Candidates(np.stack([mx, my], axis=-1), shapes).some(good)


def contrasts(smooth: Grey8, middles_px: FloatArray, shapes_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how much darker each middle is than the ring around it, and the ring's spread, grey levels.

    Not-a-number where more than a third of the ring is outside the image.
    """
    angle = np.arange(RING_POINTS) * (2 * np.pi / RING_POINTS)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    # 1.6 radii, for neighbours begin at 3, and half a pixel: the paper next to a dot is darkened by the lens
    length = np.sqrt(np.abs(np.linalg.det(shapes_px)))[:, None, None]
    ring = middles_px[:, None, :] + ((1.6 + 0.5 / length) * (shapes_px @ circle)).transpose(0, 2, 1)
    points = np.concatenate([middles_px[:, None, :], ring], axis=1)
    columns, rows = np.moveaxis(points.astype(np.float32), -1, 0)
    grey = smooth.astype(np.float32)
    pieces = [  # OpenCV wants fewer than 32767 rows
        cv2.remap(grey, columns[k : k + 30000], rows[k : k + 30000], cv2.INTER_LINEAR)
        for k in range(0, len(columns), 30000)
    ]
    values = np.concatenate(pieces).astype(np.float64)
    height, width = smooth.shape
    inside = (columns >= 0) & (rows >= 0) & (columns <= width - 1) & (rows <= height - 1)
    seen = inside[:, 1:].sum(axis=1)
    paper = np.where(inside[:, 1:], values[:, 1:], 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.where(inside[:, 0] & (seen >= 2 / 3 * RING_POINTS), paper.sum(axis=1) / seen, np.nan)
        spread = np.where(inside[:, 1:], paper - mean[:, None], 0.0)
        return mean - values[:, 0], np.sqrt((spread**2).sum(axis=1) / seen)


NEAR = 0.35  # how far a neighbour may be from where it is expected, in spacings


class Lattice(NamedTuple):
    """Spots with whole coordinates: ``spots`` (n,) index the candidates, ``places`` (n, 2) count i and j."""

    spots: IntArray
    places: IntArray


def grow_lattices(found: Candidates, spacing_over_radius: float) -> list[Lattice]:
    """Return the grids among the candidates, the largest first.

    ``spacing_over_radius`` is that of the board: distance of neighbours over the radius of a dot.
    """
    links = _links(found, spacing_over_radius)
    free = set(range(len(found.middles_px)))
    lattices = []
    # Dots with four neighbours are the surest to start from.
    for start in sorted(free, key=lambda i: -len(links[i])):
        if start in free and len(links[start]) >= 2:
            lattice = _grown(found.middles_px, links, start)
            if lattice is not None:
                free -= set(lattice.spots.tolist())
                lattices.append(lattice)
    return sorted(lattices, key=lambda lattice: -len(lattice.spots))


def _links(found: Candidates, spacing_over_radius: float) -> list[list[int]]:
    """For each spot, those that could be its four neighbours, judged from both sides."""
    count = len(found.middles_px)
    if count < 2:
        return [[] for _ in range(count)]
    nearest = cKDTree(found.middles_px).query(found.middles_px, k=min(11, count))[1]
    near = np.asarray(nearest)[:, 1:]
    offsets = found.middles_px[near] - found.middles_px[:, None, :]
    undo = np.linalg.inv(found.shapes_px)
    steps = [  # in dot radii with the tilt undone, as either of the two has it
        np.linalg.norm(np.einsum("...ij,...j->...i", tilt, offsets), axis=-1) / spacing_over_radius
        for tilt in (undo[:, None], undo[near])
    ]
    area = np.abs(np.linalg.det(found.shapes_px))
    ratio = area[near] / area[:, None]
    off = np.abs(np.array(steps) - 1.0).max(axis=0)
    good = (off < NEAR) & (ratio > 0.5) & (ratio < 2.0)
    return [near[i][good[i]].tolist() for i in range(count)]


def _grown(middles: FloatArray, links: list[list[int]], start: int) -> Lattice | None:
    """Give whole coordinates to everything that is linked with ``start``."""
    basis = _first_basis(middles, links, start)
    if basis is None:
        return None
    place = {start: (0, 0)}
    taken = {(0, 0)}
    bases = {start: basis}
    queue = deque([start])
    while queue:
        i = queue.popleft()
        undo = np.linalg.inv(bases[i])
        for j in links[i]:
            step = middles[j] - middles[i]
            local = undo @ step
            whole = np.rint(local)
            if abs(whole).sum() != 1 or abs(local - whole).max() > NEAR:
                continue
            there = (place[i][0] + int(whole[0]), place[i][1] + int(whole[1]))
            if j in place or there in taken:
                continue
            place[j] = there
            taken.add(there)
            axis = int(whole[1] != 0)
            bases[j] = bases[i].copy()
            bases[j][:, axis] = step * whole[axis]
            queue.append(j)
    if len(place) < 6:
        return None
    return Lattice(np.array(list(place)), _unsheared(np.array(list(place.values()))))


def _unsheared(places: IntArray) -> IntArray:
    """The same lattice counted so that it fills the smallest box, from 0.

    A small dot seen at a slant is blurred round, and a neighbour across the diagonal taken for the one
    beside: such a grid is whole but counted aslant.
    """
    turns = [np.array([[1, k], [m, 1]]) for k, m in ((0, 0), (-1, 0), (0, -1), (1, 0), (0, 1))]
    while True:
        box = [int(np.prod(np.ptp(places @ turn.T, axis=0) + 1)) for turn in turns]
        best = int(np.argmin(box))
        if best == 0:
            return np.asarray(places - places.min(axis=0))
        places = places @ turns[best].T


def _first_basis(middles: FloatArray, links: list[list[int]], start: int) -> FloatArray | None:
    """Two steps to neighbours as columns: those that span the smallest cell, nearest to a right angle."""
    steps = [middles[j] - middles[start] for j in links[start]]
    pairs = []
    for k, a in enumerate(steps):
        for b in steps[:k]:
            cell = abs(a[0] * b[1] - a[1] * b[0])
            lengths = np.linalg.norm(a) * np.linalg.norm(b)
            if cell > 0.3 * lengths:
                pairs.append((cell, cell / lengths, np.stack([a, b], axis=-1)))
    if not pairs:
        return None
    smallest = min(pair[0] for pair in pairs)
    return max((pair for pair in pairs if pair[0] < 1.4 * smallest), key=lambda pair: pair[1])[2]


MOST_MISSING = 0.2
"""Share of dots that may be hidden; then the others are still counted safely."""


class BoardGrid(NamedTuple):
    """Dots with places 0 to counts - 1 along i and j, and their middles to some tenths of a pixel."""

    places: IntArray
    middles_px: FloatArray
    counts: tuple[int, int]
    map: PlaneMap  # from places to pixels


def best_grid(image: Grey8, found: Candidates, board: DotBoard) -> tuple[BoardGrid | CornersNotFound, int]:
    """The board's grid, and how many spots are connected."""
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
        reason = f"{len(whole)} grids of {board.rows} x {board.columns} dots are in the image"
        return CornersNotFound(reason), largest
    if whole:
        return whole[0], largest
    if grids:
        return grids[0], largest
    spots = len(found.middles_px)
    reason = (
        f"{spots} spots look like dots, and at most {largest} of them stand in a grid, "
        f"where {wanted} are expected"
    )
    return CornersNotFound(reason), largest


def _same(one: BoardGrid, other: BoardGrid) -> bool:
    """Whether two grids stand at the same place."""
    apart = np.linalg.norm(one.middles_px.mean(axis=0) - other.middles_px.mean(axis=0))
    return bool(apart < 0.25 * np.ptp(one.middles_px, axis=0).max())


def _complete(
    image: Grey8, found: Candidates, lattice: Lattice, board: DotBoard
) -> BoardGrid | CornersNotFound:
    """Fill the gaps of a lattice and cut the board out of it, or say what is missing."""
    places, middles = lattice.places, found.middles_px[lattice.spots]
    radius = board.dot_diameter_m / 2 / board.spacing_m
    contrast = float(np.median(contrasts(image, middles, found.shapes_px[lattice.spots])[0]))
    for _ in range(3):
        points = places.astype(np.float64)
        plane_map = fit_plane_map(points, middles)
        if plane_map is not None:  # again, without spots that do not fit it
            off = np.linalg.norm(plane_map.pixels(points) - middles, axis=-1)
            good = off <= max(0.5, 4.0 * float(np.median(off)))
            plane_map = fit_plane_map(points[good], middles[good])
        if plane_map is None:
            return CornersNotFound("spots that look like dots do not make a flat grid")
        at = plane_map.pixels(points)
        step = np.sqrt(np.abs(np.linalg.det(plane_map.jacobian(points))))
        fits = np.linalg.norm(middles - at, axis=-1) < 0.15 * step
        places, middles = places[fits], middles[fits]
        more, at = _gaps(image, places, plane_map, radius, contrast)
        if not len(more):
            break
        places, middles = np.concatenate([places, more]), np.concatenate([middles, at])
    return _cut_out(image, places, middles, board)


def _gaps(
    image: Grey8, places: IntArray, plane_map: PlaneMap, radius: float, contrast_dn: float
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
    image: Grey8, places: IntArray, middles: FloatArray, board: DotBoard
) -> BoardGrid | CornersNotFound:
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
        return CornersNotFound(_too_few(image, number, spans, middles, board))
    own = places[inside] - np.array(origin)
    for axis in (0, 1):
        for line in (0, counts[axis] - 1):
            # An outer line that is hardly there could as well be the one beyond the other side.
            if (own[:, axis] == line).sum() < counts[1 - axis] / 2:
                return CornersNotFound(_too_few(image, number, spans, middles, board))
    if len(windows) > 1 and windows[1][0] > number - 3:
        return CornersNotFound(f"the grid is larger than {board.rows} x {board.columns} dots")
    plane_map = fit_plane_map(own.astype(np.float64), middles[inside])
    if plane_map is None:
        return CornersNotFound("spots that look like dots do not make a flat grid")
    return BoardGrid(own, middles[inside], counts, plane_map)


def _too_few(image: Grey8, number: int, spans: IntArray, middles: FloatArray, board: DotBoard) -> str:
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
    reason = f"only {number} dots in a grid of {min(spans)} x {max(spans)} are seen"
    reason += f" where {board.rows} x {board.columns} are expected"
    edges = " and ".join(beyond)
    return f"{reason}; the board reaches over the {edges} edge of the image" if beyond else reason

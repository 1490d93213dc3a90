"""Neighbourly dots put into rows and columns.

The shape of a dot's image tells the local tilt: undone, the four neighbours of a dot stand at one spacing in
two directions at right angles. From neighbour to neighbour the grid grows over the board; each step adapts to
the last, so perspective and lens distortion bend it freely.
"""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calib.dots.candidates import Candidates
from calib.rigid import FloatArray

IntArray = NDArray[np.int64]

NEAR = 0.35  # how far a neighbour may be from where it is expected, in spacings
SIZES = (0.5, 2.0)  # areas of neighbours, one to the other
LOOK_AT = 10  # nearest spots looked at for each
LEAST_GRID = 6


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
    nearest = cKDTree(found.middles_px).query(found.middles_px, k=min(LOOK_AT + 1, count))[1]
    near = np.asarray(nearest)[:, 1:]
    offsets = found.middles_px[near] - found.middles_px[:, None, :]
    there = _in_circles(np.linalg.inv(found.shapes_px)[:, None], offsets)
    back = _in_circles(np.linalg.inv(found.shapes_px)[near], offsets)
    area = np.abs(np.linalg.det(found.shapes_px))
    ratio = area[near] / area[:, None]
    off = np.maximum(abs(there / spacing_over_radius - 1.0), abs(back / spacing_over_radius - 1.0))
    good = (off < NEAR) & (ratio > SIZES[0]) & (ratio < SIZES[1])
    return [near[i][good[i]].tolist() for i in range(count)]


def _in_circles(undo: NDArray[Any], offsets: FloatArray) -> FloatArray:
    """Lengths of offsets with the tilt undone, in dot radii."""
    return np.asarray(np.linalg.norm(np.einsum("...ij,...j->...i", undo, offsets), axis=-1))


def _grown(middles: FloatArray, links: list[list[int]], start: int) -> Lattice | None:
    """Give whole coordinates to everything that hangs together with ``start``."""
    basis = _first_basis(middles, links, start)
    if basis is None:
        return None
    place = {start: (0, 0)}
    taken = {(0, 0): start}
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
            place[j], taken[there] = there, j
            axis = int(whole[1] != 0)
            bases[j] = bases[i].copy()
            bases[j][:, axis] = step * whole[axis]
            queue.append(j)
    if len(place) < LEAST_GRID:
        return None
    return Lattice(np.array(list(place)), _unsheared(np.array(list(place.values()))))


def _unsheared(places: IntArray) -> IntArray:
    """The same lattice counted so that it fills the smallest box, from 0.

    A small dot seen at a slant is blurred round, and a neighbour across the diagonal taken for the one
    beside: such a grid is whole but counted aslant.
    """
    turns = [np.eye(2, dtype=np.int64)]
    for k in (-1, 1):
        turns += [np.array([[1, k], [0, 1]]), np.array([[1, 0], [k, 1]])]
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

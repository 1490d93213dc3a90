"""Terms that have unknowns of the same kinds in a row: one pass over all is far quicker than one over each.

A fit spends its time on the Jacobians of some hundred images of some hundred dots. Numpy takes as long to
begin an operation on a hundred numbers as to carry it out. So all images of a camera go through each
operation together, and only their normal equations are summed one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.adjust.terms import ImageTerm, StationTerm
from calib.adjust.unknowns import Key, Unknowns
from calib.geometry.rigid import FloatArray

Keys = tuple[Key, ...]


@dataclass(frozen=True, eq=False)
class _Stack:
    """Terms in a row, of n points in all, and the unknowns of each: as many, in the same order.

    Attributes
    ----------
    keys, sizes
        The unknowns of each term, and how many numbers each of these has.
    columns
        The indices (k,) of these numbers, by term.
    counts
        How many points each term has.
    """

    keys: tuple[Keys, ...]
    sizes: tuple[int, ...]
    columns: tuple[np.ndarray, ...]
    counts: tuple[int, ...]

    @cached_property
    def parts(self) -> tuple[slice, ...]:
        """Where the points of each term stand."""
        return _slices(self.counts)

    def places_of(self, at: int) -> Mapping[Key, slice]:
        """Return where the numbers of each unknown stand among those of a term."""
        return dict(zip(self.keys[at], _slices(self.sizes), strict=True))


@dataclass(frozen=True, eq=False)
class ImageStack(_Stack):
    """Images of one camera: the points (n, 3), pixels (n, 2), sigma (n,) and bend (n, 2) of those dots that
    count."""

    terms: tuple[ImageTerm, ...]
    in_board_m: FloatArray
    pixels_px: FloatArray
    sigma_px: FloatArray
    bend: FloatArray


@dataclass(frozen=True, eq=False)
class StationStack(_Stack):
    """Prisms, or tapes, and their sigma (n,)."""

    terms: tuple[StationTerm, ...]
    sigma_m: FloatArray


AnyStack = ImageStack | StationStack


def image_stack(
    images: Sequence[ImageTerm], unknowns: Unknowns, keys_of: Callable[[ImageTerm], Iterable[Key]]
) -> ImageStack:
    """Return images of one camera in a row."""
    bends = [t.bend if len(t.bend) else np.zeros((len(t.keep), 2)) for t in images]
    return ImageStack(
        *_unknowns(unknowns, [tuple(keys_of(t)) for t in images]),
        tuple(int(t.keep.sum()) for t in images),
        tuple(images),
        np.concatenate([t.in_board_m[t.keep] for t in images]),
        np.concatenate([t.pixels_px[t.keep] for t in images]),
        np.concatenate([t.sigma_px[t.keep] for t in images]),
        np.concatenate([bend[t.keep] for t, bend in zip(images, bends, strict=True)]),
    )


def station_stack(
    points: Sequence[StationTerm], unknowns: Unknowns, keys_of: Callable[[StationTerm], Iterable[Key]]
) -> StationStack:
    """Return points of the station in a row."""
    keys = [tuple(keys_of(p)) for p in points]
    sigma_m = np.array([p.sigma_m for p in points])
    return StationStack(*_unknowns(unknowns, keys), (1,) * len(points), tuple(points), sigma_m)


def _unknowns(
    unknowns: Unknowns, keys: Sequence[Keys]
) -> tuple[tuple[Keys, ...], tuple[int, ...], tuple[np.ndarray, ...]]:
    """The first three of a stack."""
    sizes = tuple(len(unknowns.at(key)) for key in keys[0])
    return tuple(keys), sizes, tuple(np.concatenate([unknowns.at(key) for key in mine]) for mine in keys)


def _slices(sizes: Sequence[int]) -> tuple[slice, ...]:
    """Where parts of some sizes stand, one after another."""
    ends = np.cumsum(sizes).tolist()
    return tuple(slice(end - size, end) for end, size in zip(ends, sizes, strict=True))

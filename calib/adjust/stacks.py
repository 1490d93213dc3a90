"""Terms that have unknowns of the same kinds in a row: one pass over all is far quicker than one over each.

A fit spends its time on the Jacobians of some hundred images of some hundred dots. Numpy takes as long to
begin an operation on a hundred numbers as to carry it out. So all images of a camera go through each
operation together, and only their normal equations are summed one by one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np

from calib.adjust.terms import ImageTerm, StationTerm
from calib.adjust.unknowns import Key, Unknowns
from calib.geometry.rigid import FloatArray


@dataclass(frozen=True, eq=False)
class _Stack:
    """Terms in a row, of n points in all, and by term its unknowns and the indices (k,) of their numbers: as
    many for each, in the same order."""

    terms: tuple[Any, ...]
    keys: tuple[tuple[Key, ...], ...]
    columns: tuple[np.ndarray, ...]
    sizes: tuple[int, ...]

    @classmethod
    def of(cls, terms: Sequence[Any], keys: Sequence[tuple[Key, ...]], unknowns: Unknowns) -> Self:
        """Return terms with unknowns of the same kinds in a row."""
        columns = tuple(np.concatenate([unknowns.at(key) for key in mine]) for mine in keys)
        return cls(tuple(terms), tuple(keys), columns, tuple(len(unknowns.at(key)) for key in keys[0]))

    @property
    def counts(self) -> Sequence[int]:
        """How many points each term has."""
        return [1] * len(self.terms)

    @cached_property
    def parts(self) -> tuple[slice, ...]:
        """Where the points of each term stand."""
        return _slices(self.counts)

    def places_of(self, at: int) -> Mapping[Key, slice]:
        """Return where the numbers of each unknown stand among those of a term."""
        return dict(zip(self.keys[at], _slices(self.sizes), strict=True))


class ImageStack(_Stack):
    """Images of one camera: the points (n, 3), pixels (n, 2), sigma (n,) and bend (n, 2) of those dots that
    count."""

    terms: tuple[ImageTerm, ...]

    @property
    def counts(self) -> Sequence[int]:
        return [int(t.keep.sum()) for t in self.terms]

    @cached_property
    def in_board_m(self) -> FloatArray:
        return np.concatenate([t.in_board_m[t.keep] for t in self.terms])

    @cached_property
    def pixels_px(self) -> FloatArray:
        return np.concatenate([t.pixels_px[t.keep] for t in self.terms])

    @cached_property
    def sigma_px(self) -> FloatArray:
        return np.concatenate([t.sigma_px[t.keep] for t in self.terms])

    @cached_property
    def bend(self) -> FloatArray:
        bends = [t.bend if len(t.bend) else np.zeros((len(t.keep), 2)) for t in self.terms]
        return np.concatenate([bend[t.keep] for bend, t in zip(bends, self.terms, strict=True)])


class StationStack(_Stack):
    """Prisms, or tapes, and their sigma (n,)."""

    terms: tuple[StationTerm, ...]

    @cached_property
    def sigma_m(self) -> FloatArray:
        return np.array([p.sigma_m for p in self.terms])


AnyStack = ImageStack | StationStack


def _slices(sizes: Sequence[int]) -> tuple[slice, ...]:
    """Where parts of some sizes stand, one after another."""
    ends = np.cumsum(sizes).tolist()
    return tuple(slice(end - size, end) for end, size in zip(ends, sizes, strict=True))

"""A mapping read strictly: every key known, every value of the right kind, each refusal with its place."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from calib.errors import BadFile
from calib.files.yaml_text import kind_of
from calib.rigid import FloatArray


def nearest(word: str, known: Sequence[str]) -> str:
    """Return the end of a refusal: the nearest known word, or all of them."""
    near = get_close_matches(word, known, n=1, cutoff=0.5)
    return f"the nearest known is '{near[0]}'" if near else f"known are {', '.join(known)}"


class Section:
    """One mapping of a file, with known keys.

    Parameters
    ----------
    path, place
        The file, and the key path to this mapping ('' for the whole file).
    value
        What the file holds there.
    required, optional
        The keys that must and may be there.

    Raises
    ------
    BadFile
        If it is no mapping, a key is unknown, or a required key is missing.
    """

    def __init__(
        self,
        path: str | Path,
        place: str,
        value: Any,
        required: Sequence[str] = (),
        optional: Sequence[str] = (),
    ) -> None:
        self.path = path
        self.place = place
        known = (*required, *optional)
        if not isinstance(value, dict):
            raise self.bad("", f"{kind_of(value)} where a mapping with {', '.join(known)} is expected")
        self.values: dict[str, Any] = value
        for key in value:
            if key not in known:
                raise self.bad(key, f"unknown key; {nearest(key, known)}")
        for key in required:
            if key not in value:
                raise self.bad(key, "the key is missing")

    def at(self, key: str) -> str:
        """Return the key path of a key in here."""
        return f"{self.place}.{key}" if self.place and key else self.place or key

    def bad(self, key: str, reason: str) -> BadFile:
        """Return the refusal of a key's value."""
        return BadFile(self.path, self.at(key), reason)

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def text(self, key: str) -> str:
        """Return a value that must be text, not empty, on one line."""
        value = self.values[key]
        if not isinstance(value, str):
            raise self.bad(key, f"{kind_of(value)} where text is expected")
        if not value.strip() or not value.isprintable():
            raise self.bad(key, f"{value[:40]!r} where text on one line is expected")
        return value

    def choice(self, key: str, choices: Sequence[str]) -> str:
        """Return a value that must be one of the given words."""
        value = self.values[key]
        if value not in choices or not isinstance(value, str):
            raise self.bad(key, f"{kind_of(value)} where one of {', '.join(choices)} is expected")
        return value

    def number(self, key: str, limit: float = 1e9) -> float:
        """Return a value that must be a finite number of at most ``limit`` in size."""
        return self._number(key, self.values[key], limit)

    def integer(self, key: str, low: int, high: int) -> int:
        """Return a value that must be an integer from low to high."""
        return self._integer(key, self.values[key], low, high)

    def integers(self, key: str, count: int, low: int, high: int) -> tuple[int, ...]:
        """Return a value that must be a list of ``count`` integers from low to high."""
        return tuple(
            self._integer(f"{key}[{i}]", item, low, high)
            for i, item in enumerate(self._list(key, count, "integers"))
        )

    def vector(self, key: str, limit: float = 1e9, count: int = 3) -> FloatArray:
        """Return a value that must be a list of ``count`` finite numbers, as (count,)."""
        items = self._list(key, count, "numbers")
        return np.array([self._number(f"{key}[{i}]", item, limit) for i, item in enumerate(items)])

    def pairs(self, key: str, most: int, limit: float = 1e9) -> tuple[tuple[float, float], ...]:
        """Return a value that must be a list of at most ``most`` pairs of finite numbers."""
        value = self.values[key]
        if not isinstance(value, list) or len(value) > most:
            raise self.bad(key, f"{kind_of(value)} where a list of up to {most} pairs of numbers is expected")
        found = []
        for i, pair in enumerate(value):
            if not isinstance(pair, list) or len(pair) != 2:
                raise self.bad(f"{key}[{i}]", f"{kind_of(pair)} where a pair of numbers is expected")
            one, other = (self._number(f"{key}[{i}][{j}]", part, limit) for j, part in enumerate(pair))
            found.append((one, other))
        return tuple(found)

    def covariance(self, key: str, count: int, limit: float = 1e9) -> FloatArray:
        """Return a value that must be ``count`` lists of as many numbers, and a covariance."""
        rows = Section(self.path, self.place, {}, (), ())
        rows.values = {f"{key}[{i}]": row for i, row in enumerate(self._list(key, count, "rows"))}
        matrix = np.array([rows.vector(row, limit, count) for row in rows.values])
        if not np.allclose(matrix, matrix.T) or np.linalg.eigvalsh(matrix)[0] < 0.0:
            raise self.bad(key, "no covariance: it must be symmetric, with no variance below zero")
        return matrix

    def section(self, key: str, required: Sequence[str] = (), optional: Sequence[str] = ()) -> Section:
        """Return a value that must be a mapping with known keys."""
        return Section(self.path, self.at(key), self.values[key], required, optional)

    def mapping(self, key: str) -> Mapping[str, Any]:
        """Return a value that must be a mapping with any keys; {} if the key is not there."""
        value = self.values.get(key, {})
        if not isinstance(value, dict):
            raise self.bad(key, f"{kind_of(value)} where a mapping is expected")
        return value

    def free(self, key: str) -> Mapping[str, Any]:
        """Return a mapping of any content in which every number is finite; {} if the key is not there."""
        value = self.mapping(key)
        self._all_finite(key, value)
        return value

    def _all_finite(self, key: str, value: Any) -> None:
        if isinstance(value, dict):
            for inner_key, inner in value.items():
                self._all_finite(f"{key}.{inner_key}", inner)
        elif isinstance(value, list):
            for i, inner in enumerate(value):
                self._all_finite(f"{key}[{i}]", inner)
        elif isinstance(value, float) and not math.isfinite(value):
            raise self.bad(key, f"{value} where a finite number is expected")

    def _list(self, key: str, count: int, what: str) -> list[Any]:
        value = self.values[key]
        if not isinstance(value, list) or len(value) != count:
            raise self.bad(key, f"{kind_of(value)} where a list of {count} {what} is expected")
        return value

    def _number(self, key: str, value: Any, limit: float) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self.bad(key, f"{kind_of(value)} where a number is expected")
        if not math.isfinite(value) or abs(value) > limit:
            raise self.bad(key, f"{kind_of(value)} where a finite number up to {limit:g} is expected")
        return float(value)

    def _integer(self, key: str, value: Any, low: int, high: int) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self.bad(key, f"{kind_of(value)} where an integer from {low} to {high} is expected")
        return value

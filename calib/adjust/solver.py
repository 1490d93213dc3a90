"""Levenberg and Marquardt's method on normal equations, for unknowns that are not plain vectors.

A camera, a rotation or a rig is moved by a *step*; the problem says how, and gives the normal equations of
its weighted residuals at a state. Columns are scaled to one, so that metres, radians and pixels mix.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calib.geometry.rigid import FloatArray

State = TypeVar("State")

FIRST_DAMPING, LARGEST_DAMPING = 1e-4, 1e9

POOR, FAIR = 0.25, 0.5
"""Parts of the expected gain: a step that brings less than the first is damped more the next time, one that
brings more than the second less (Marquardt 1963; Moré 1978). Where residuals are large, undamped steps
overshoot from one side of the minimum to the other, each a little better: that took more than 500 steps."""

NOTHING = 1e-18
"""A gain in the weighted sum of squares that is none, whatever the cost: noise-free data have none left."""


class Normal(NamedTuple):
    """Cost (weighted sum of squares), JᵀJ (p, p) and Jᵀr (p,) at a state."""

    cost: float
    matrix: FloatArray
    gradient: FloatArray


class LeastSquaresProblem(Protocol[State]):
    """The input of a fit; costs are infinite where a state is impossible."""

    def normal(self, state: State) -> Normal:
        """Return cost and normal equations."""
        ...

    def cost(self, state: State) -> float:
        """Return the cost alone."""
        ...

    def stepped(self, state: State, step: FloatArray) -> State:
        """Return the state moved by a step (p,); ValueError if there is no such state."""
        ...


@dataclass(frozen=True, eq=False)
class Minimum(Generic[State]):
    """Where a fit ended: its state, the normal equations there, and what was added to their diagonal."""

    state: State
    normal: Normal
    settled: bool
    steps: int
    weak: FloatArray

    @cached_property
    def covariance(self) -> FloatArray:
        """(p, p) of the unknowns; one that the data leave open keeps the variance 1 / ``weak``."""
        return covariance_of(self.normal.matrix, self.weak)


def minimise(
    problem: LeastSquaresProblem[State],
    start: State,
    *,
    weak: FloatArray | None = None,
    steps: int = 200,
    gain: float = 1e-10,
) -> Minimum[State]:
    """Minimise a problem's cost from a start.

    ``weak`` (p,) is added to the diagonal of JᵀJ without any pull: unknowns that the data leave open stay
    where they are. A fit takes ``steps`` at most, and has settled when a step is expected to lower the cost
    by less than the part ``gain`` of it.
    """
    state, normal = start, problem.normal(start)
    damping = FIRST_DAMPING
    extra = np.zeros(len(normal.gradient)) if weak is None else weak
    for count in range(steps):
        if not np.isfinite(normal.cost):
            break
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal.matrix) + extra, 1e-300))
        scaled = (normal.matrix + np.diag(extra)) * np.outer(scale, scale)
        scaled_gradient = scale * normal.gradient
        moved, expected = None, np.inf
        least = gain * normal.cost + NOTHING
        while moved is None and damping <= LARGEST_DAMPING:
            try:
                step, expected = _step(scaled, scaled_gradient, damping)
                # Or is it the damping that keeps the step short?
                nothing_left = expected <= least and (
                    damping <= FIRST_DAMPING or _step(scaled, scaled_gradient, FIRST_DAMPING)[1] <= least
                )
            except np.linalg.LinAlgError:
                damping = max(10 * damping, 1e-12)
                continue
            cost = np.inf
            try:
                moved = problem.stepped(state, scale * step)
                cost = problem.cost(moved)
            except ValueError:
                pass
            moved = moved if cost < normal.cost else None
            if nothing_left:
                if moved is not None:
                    state, normal = moved, problem.normal(moved)
                return Minimum(state, normal, True, count, extra)
            if moved is None:
                damping = max(10 * damping, 1e-12)
            elif normal.cost - cost < POOR * expected:
                damping = 10 * damping
            elif normal.cost - cost > FAIR * expected and damping > 1e-14:
                damping = damping / 10
        if moved is None:
            # No step of any size lowers the cost any more: rounding, or a place where it has a kink.
            return Minimum(state, normal, _as_good(expected, normal), count, extra)
        before, state, normal = normal, moved, problem.normal(moved)
        if normal.cost >= before.cost and _as_good(expected, before):
            # The trial's cost was lower by rounding alone, and would be again and again.
            return Minimum(state, normal, True, count, extra)
    return Minimum(state, normal, False, steps, extra)


def _as_good(expected: float, normal: Normal) -> bool:
    """Whether what a step was expected to gain, and did not, is as little as rounding may hide."""
    return expected <= 1e-6 * normal.cost + 1e6 * NOTHING


def _step(matrix: FloatArray, gradient: FloatArray, damping: float) -> tuple[FloatArray, float]:
    """A damped step, and by how much it lowers a cost that is quadratic; LinAlgError if there is none."""
    factor = cho_factor(matrix + damping * np.eye(len(gradient)), check_finite=False)
    step = -cho_solve(factor, gradient, check_finite=False)
    return step, float(-step @ (2 * gradient + matrix @ step))


def covariance_of(matrix: FloatArray, weak: FloatArray | None = None) -> FloatArray:
    """Return the inverse of JᵀJ (p, p), with ``weak`` (p,) added to its diagonal as in ``minimise``.

    An unknown that the data leave open so keeps the variance 1 / weak. Columns are scaled to one first.
    """
    whole = matrix if weak is None else matrix + np.diag(weak)
    scale = 1.0 / np.sqrt(np.diag(whole))
    return np.asarray(np.linalg.inv(whole * np.outer(scale, scale)) * np.outer(scale, scale))

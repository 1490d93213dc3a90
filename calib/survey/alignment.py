"""Rigid alignment of measured points with points of a design, and which of them was mis-measured.

The pose is closed form: the rotation from the weighted singular value decomposition (Kabsch 1976; Umeyama
1991 for the sign). Its covariance is of a small turn and shift in frame b. They move the pose (R, t) to
Exp(turn) R and t + shift, and a point by turn x (R x_in_a) + shift.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from calib.errors import CalibError
from calib.geometry.rigid import FloatArray, Rigid, rigid_rates
from calib.geometry.significance import Level
from calib.survey.records import Survey


class NotAligned(CalibError):
    """Points that no pose follows from: fewer than three, or on one line."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """The pose that carries points of frame a onto points of frame b.

    ``covariance`` (6, 6) is of its turn (rotation vector in b, radians) and shift (metres), from the stated
    sigmas. ``residuals_m`` (n, 3) are what was measured in b less what the pose says, also of the
    ``rejected`` points, which were left out: with them the rest is off, without them it fits. ``doubt`` is ''
    where all that was used agrees, else a sentence that says which points disagree, and how much. ``chi2``
    and ``degrees_of_freedom`` are of the points that were used.
    """

    b_from_a: Rigid
    covariance: FloatArray
    names: tuple[str, ...]
    residuals_m: FloatArray
    rejected: tuple[str, ...]
    doubt: str
    chi2: float
    degrees_of_freedom: int


def align(
    points_in_a_m: ArrayLike,
    points_in_b_m: ArrayLike,
    sigma_m: ArrayLike,
    names: Sequence[str],
    *,
    false_alarm: float = Level.WHOLE,
) -> Alignment:
    """Fit the pose between the same points (n, 3) in two frames, metres, without those mis-measured.

    With four points or more, if chi-square is beyond chance, one point is left out: the only one without
    which the others fit. If there is no such point, and with three points, the distances between points say
    which disagree, and nothing is left out. ``sigma_m`` is the standard deviation of the difference of a
    point, one axis, one number or (n,); ``false_alarm`` how often points without a blunder may be called in
    doubt.

    Raises NotAligned if there are fewer than three points, they stand on one line, or a number is not finite;
    ValueError if the lists are not equally long, or a sigma is not above 0.
    """
    a, b = (np.asarray(points, dtype=np.float64).reshape(-1, 3) for points in (points_in_a_m, points_in_b_m))
    if not len(a) == len(b) == len(names):
        raise ValueError(f"{len(a)} points, {len(b)} points and {len(names)} names do not go together")
    for name, one, other in zip(names, a, b, strict=True):
        if not (np.isfinite(one).all() and np.isfinite(other).all()):
            raise NotAligned(f"point {name} is at {one.tolist()} and {other.tolist()}, which is no place")
    sigma = _sigma(sigma_m, len(a))
    used = np.ones(len(a), dtype=bool)
    rejected: list[str] = []
    while True:
        pose = _pose(a[used], b[used], sigma[used], [n for n, use in zip(names, used, strict=True) if use])
        total = _chi2(pose, a[used], b[used], sigma[used])
        freedom = 3 * int(used.sum()) - 6
        doubt = ""
        if total <= _limit(freedom, false_alarm):
            break
        culprit = _culprit(a, b, sigma, used, false_alarm)
        if culprit is None:
            doubt = _doubt(a, b, sigma, used, names, false_alarm)
            break
        used[culprit] = False
        rejected.append(names[culprit])
    return Alignment(
        pose,
        _covariance(pose, a[used], sigma[used]),
        tuple(names),
        b - pose.points(a),
        tuple(rejected),
        doubt,
        total,
        freedom,
    )


def mirrored(points_in_a_m: ArrayLike, points_in_b_m: ArrayLike, sigma_m: float) -> bool:
    """Return whether only a mirror image of a fits b: two coordinates swapped, or one with the wrong sign."""
    a, b = (np.asarray(points, dtype=np.float64).reshape(-1, 3) for points in (points_in_a_m, points_in_b_m))
    if len(a) < 4:
        return False
    sigma = _sigma(sigma_m, len(a))
    image = a * np.array([1.0, 1.0, -1.0])
    try:
        fits = [_chi2(_pose(c, b, sigma, []), c, b, sigma) for c in (a, image)]
    except NotAligned:
        return False
    return fits[1] <= _limit(3 * len(a) - 6, Level.WHOLE) < fits[0]


def poses(
    survey: Survey, kind: Literal["prism", "tape"], false_alarm: float = Level.WHOLE
) -> dict[tuple[str, str], Alignment | NotAligned]:
    """Return by set-up and placement how its prisms lie in the rover, or its board's tapes in the station.

    Measured points that are not on the design are left out. Where no pose follows, the reason is its error.
    """
    of_prisms = kind == "prism"
    design = survey.prisms_in_rover_m if of_prisms else survey.board.tapes_in_board_m
    sigma_m = float(np.hypot(survey.sigma.station_m, survey.sigma.prism_cad_m if of_prisms else 0.0))
    measured = survey.measured(kind)
    keys = dict.fromkeys((p.setup, "") for p in survey.station) if of_prisms else measured
    found: dict[tuple[str, str], Alignment | NotAligned] = {}
    for setup, placement in keys:
        points = {n: at for n, at in measured.get((setup, placement), {}).items() if n in design}
        drawn, seen = [design[name] for name in points], list(points.values())
        one, other = (seen, drawn) if of_prisms else (drawn, seen)
        try:
            found[setup, placement] = align(one, other, sigma_m, list(points), false_alarm=false_alarm)
        except NotAligned as error:
            place = f"placement {placement} in set-up {setup}" if placement else f"set-up {setup}"
            found[setup, placement] = NotAligned(f"{kind}s of {place}: {error}")
    return found


def rover_from_station(survey: Survey, *, false_alarm: float = Level.WHOLE) -> dict[str, Alignment]:
    """Return the pose of every set-up from its prisms. Raises NotAligned for one with fewer than three."""
    found: dict[str, Alignment] = {}
    for (setup, _), pose in poses(survey, "prism", false_alarm).items():
        if isinstance(pose, NotAligned):
            raise pose
        found[setup] = pose
    return found


def station_from_board(
    survey: Survey, *, false_alarm: float = Level.WHOLE
) -> dict[tuple[str, str], Alignment]:
    """Return the pose of every placement with three tapes, by set-up and placement.

    Raises NotAligned for tapes on one line.
    """
    enough = {key for key, seen in survey.measured("tape").items() if len(seen) > 2}
    found: dict[tuple[str, str], Alignment] = {}
    for key, pose in poses(survey, "tape", false_alarm).items():
        if isinstance(pose, Alignment):
            found[key] = pose
        elif key in enough:
            raise pose
    return found


def _sigma(sigma_m: ArrayLike, count: int) -> FloatArray:
    """One sigma for each point; ValueError if it is none."""
    sigma = np.broadcast_to(np.asarray(sigma_m, dtype=np.float64), count)
    if not ((sigma > 0.0) & np.isfinite(sigma)).all():
        raise ValueError(f"sigma_m is {sigma.tolist()} where finite numbers above 0 are expected")
    return sigma


def _pose(a: FloatArray, b: FloatArray, sigma: FloatArray, names: Sequence[str]) -> Rigid:
    """The pose of least weighted squares."""
    if len(a) < 3:
        raise NotAligned(f"{len(a)} points ({', '.join(names)}) where at least three are expected")
    weight = (1 / sigma**2) / np.sum(1 / sigma**2)
    middle_a, middle_b = weight @ a, weight @ b
    from_a, from_b = a - middle_a, b - middle_b
    for points in (from_a, from_b):
        spread = np.linalg.svd(points, compute_uv=False)
        if not spread[1] > 1e-3 * spread[0]:  # across the line, and along it
            raise NotAligned(f"the points {', '.join(names)} stand on one line, or in one place")
    u, _, vt = np.linalg.svd(from_b.T @ (weight[:, None] * from_a))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
    return Rigid(rotation, middle_b - rotation @ middle_a)


def _chi2(pose: Rigid, a: FloatArray, b: FloatArray, sigma: FloatArray) -> float:
    return float(np.sum(((b - pose.points(a)) / sigma[:, None]) ** 2))


def _limit(freedom: int, false_alarm: float) -> float:
    return float(chdtri(freedom, false_alarm))


def _covariance(pose: Rigid, a: FloatArray, sigma: FloatArray) -> FloatArray:
    """Inverse of the weighted normal matrix of turn and shift."""
    rates = rigid_rates(np.eye(3)[None], pose.vectors(a), np.zeros(3)) / sigma[:, None, None]
    return np.asarray(np.linalg.inv(np.einsum("nip,niq->pq", rates, rates)))


def _culprit(
    a: FloatArray, b: FloatArray, sigma: FloatArray, used: np.ndarray, false_alarm: float
) -> int | None:
    """The one point without which the rest fits; None if there is none, or more than one may be it."""
    indices = np.flatnonzero(used)
    if len(indices) < 4:
        return None
    left: dict[int, float] = {}
    for index in indices:
        rest = indices[indices != index]
        try:
            left[int(index)] = _chi2(_pose(a[rest], b[rest], sigma[rest], []), a[rest], b[rest], sigma[rest])
        except NotAligned:
            left[int(index)] = np.inf
    best, second = sorted(left, key=left.__getitem__)[:2]
    limit = _limit(3 * (len(indices) - 1) - 6, false_alarm)
    # With five points or more a second blunder may still be among the rest: the next round looks for it.
    fits = left[best] <= limit or len(indices) > 5
    alone = left[second] > limit and left[second] > left[best] + _limit(1, false_alarm)
    return best if fits and alone else None


def _doubt(
    a: FloatArray,
    b: FloatArray,
    sigma: FloatArray,
    used: np.ndarray,
    names: Sequence[str],
    false_alarm: float,
) -> str:
    """Say which distances between points disagree."""
    lines: list[tuple[float, int, int, float, float]] = []
    for i, j in combinations(map(int, np.flatnonzero(used)), 2):
        in_a, in_b = (float(np.linalg.norm(points[i] - points[j])) for points in (a, b))
        lines.append((abs(in_a - in_b) / float(np.hypot(sigma[i], sigma[j])), i, j, in_a, in_b))
    lines.sort(reverse=True)
    limit = float(np.sqrt(chdtri(1, false_alarm)))
    off = [line for line in lines if line[0] > limit]
    if not off:
        one = [name for name, use in zip(names, used, strict=True) if use]
        return f"the distances agree but the shape does not; any of {', '.join(one)} may be off"
    size, first, second, in_a, in_b = lines[0]
    sentence = (
        f"{names[first]} and {names[second]} are {in_a:.4f} m apart in one list and {in_b:.4f} m in the other"
        f" ({1000 * abs(in_a - in_b):.1f} mm, {size:.0f} sigma)"
    )
    shared = set(off[0][1:3]).intersection(*(line[1:3] for line in off[1:]))
    if len(off) > 1 and len(shared) == 1:
        sentence += f"; every distance that disagrees is one of {names[shared.pop()]}"
    return sentence

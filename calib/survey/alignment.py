"""Rigid alignment of measured points with points of a design, and which of them was mis-measured.

The pose is closed form: the rotation from the singular value decomposition (Kabsch 1976; Umeyama 1991 for the
sign).
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
from calib.geometry.rigid import FloatArray, Rigid
from calib.geometry.significance import Level
from calib.survey.records import Survey


class NotAligned(CalibError):
    """Points that no pose follows from: fewer than three, or on one line."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """The pose that carries points of frame a onto points of frame b.

    ``residuals_m`` (n, 3) are what was measured in b less what the pose says, of the ``rejected`` points too,
    which were left out: with them the rest is off, without them it fits. ``doubt`` is '' where all that was
    used agrees, else a sentence that says which points disagree, and how much.
    """

    b_from_a: Rigid
    names: tuple[str, ...]
    residuals_m: FloatArray
    rejected: tuple[str, ...]
    doubt: str

    @property
    def agrees(self) -> bool:
        """Whether all points fit."""
        return not self.rejected and not self.doubt


def align(
    points_in_a_m: ArrayLike,
    points_in_b_m: ArrayLike,
    sigma_m: float,
    names: Sequence[str],
    *,
    false_alarm: float = Level.WHOLE,
) -> Alignment:
    """Fit the pose between the same points (n, 3) in two frames, metres, without those mis-measured.

    With four points or more, if chi-square is beyond chance, one point is left out: the only one without
    which the others fit. If there is no such point, and with three points, the distances between points say
    which disagree, and nothing is left out. ``sigma_m`` is the standard deviation of the difference of a
    point, one axis; ``false_alarm`` how often points without a blunder may be called in doubt.

    Raises NotAligned if there are fewer than three points, or they stand on one line.
    """
    a, b = (np.asarray(points, dtype=np.float64).reshape(-1, 3) for points in (points_in_a_m, points_in_b_m))
    used, rejected, doubt = list(range(len(a))), list[str](), ""
    while True:
        pose = _pose(a[used], b[used], [names[at] for at in used])
        if _chi2(pose, a[used], b[used], sigma_m) <= _limit(len(used), false_alarm):
            break
        culprit = _culprit(a, b, sigma_m, used, false_alarm)
        if culprit is None:
            doubt = _doubt(a[used], b[used], sigma_m, [names[at] for at in used], false_alarm)
            break
        used.remove(culprit)
        rejected.append(names[culprit])
    return Alignment(pose, tuple(names), b - pose.points(a), tuple(rejected), doubt)


def mirrored(points_in_a_m: ArrayLike, points_in_b_m: ArrayLike, sigma_m: float) -> bool:
    """Return whether only a mirror image of a fits b: two coordinates swapped, or one with the wrong sign."""
    a, b = (np.asarray(points, dtype=np.float64).reshape(-1, 3) for points in (points_in_a_m, points_in_b_m))
    if len(a) < 4:
        return False
    try:
        fits = [_chi2(_pose(c, b, []), c, b, sigma_m) for c in (a, a * np.array([1.0, 1.0, -1.0]))]
    except NotAligned:
        return False
    return fits[1] <= _limit(len(a), Level.WHOLE) < fits[0]


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


def _pose(a: FloatArray, b: FloatArray, names: Sequence[str]) -> Rigid:
    """The pose of least squares."""
    if len(a) < 3:
        raise NotAligned(f"{len(a)} points ({', '.join(names)}) where at least three are expected")
    middle_a, middle_b = a.mean(axis=0), b.mean(axis=0)
    from_a, from_b = a - middle_a, b - middle_b
    for points in (from_a, from_b):
        spread = np.linalg.svd(points, compute_uv=False)
        if not spread[1] > 1e-3 * spread[0]:  # across the line, and along it
            raise NotAligned(f"the points {', '.join(names)} stand on one line, or in one place")
    u, _, vt = np.linalg.svd(from_b.T @ from_a)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
    return Rigid(rotation, middle_b - rotation @ middle_a)


def _chi2(pose: Rigid, a: FloatArray, b: FloatArray, sigma_m: float) -> float:
    return float(np.sum(((b - pose.points(a)) / sigma_m) ** 2))


def _limit(points: int, false_alarm: float) -> float:
    """The chi-square of so many points that chance exceeds so often."""
    return float(chdtri(3 * points - 6, false_alarm))


def _culprit(a: FloatArray, b: FloatArray, sigma_m: float, used: list[int], false_alarm: float) -> int | None:
    """The one point without which the rest fits; None if there is none, or more than one may be it."""
    if len(used) < 4:
        return None
    left: dict[int, float] = {}
    for index in used:
        rest = [other for other in used if other != index]
        try:
            left[index] = _chi2(_pose(a[rest], b[rest], []), a[rest], b[rest], sigma_m)
        except NotAligned:
            left[index] = np.inf
    best, second = sorted(left, key=left.__getitem__)[:2]
    limit = _limit(len(used) - 1, false_alarm)
    # With five points or more a second blunder may still be among the rest: the next round looks for it.
    fits = left[best] <= limit or len(used) > 5
    alone = left[second] > limit and left[second] > left[best] + float(chdtri(1, false_alarm))
    return best if fits and alone else None


def _doubt(a: FloatArray, b: FloatArray, sigma_m: float, names: Sequence[str], false_alarm: float) -> str:
    """Say which distances between points disagree."""
    lines: list[tuple[float, int, int, float, float]] = []
    for i, j in combinations(range(len(names)), 2):
        in_a, in_b = (float(np.linalg.norm(points[i] - points[j])) for points in (a, b))
        lines.append((abs(in_a - in_b) / (np.sqrt(2.0) * sigma_m), i, j, in_a, in_b))
    lines.sort(reverse=True)
    off = [line for line in lines if line[0] > float(np.sqrt(chdtri(1, false_alarm)))]
    if not off:
        return f"the distances agree but the shape does not; any of {', '.join(names)} may be off"
    size, first, second, in_a, in_b = lines[0]
    sentence = (
        f"{names[first]} and {names[second]} are {in_a:.4f} m apart in one list and {in_b:.4f} m in the other"
        f" ({1000 * abs(in_a - in_b):.1f} mm, {size:.0f} sigma)"
    )
    shared = set(off[0][1:3]).intersection(*(line[1:3] for line in off[1:]))
    if len(off) > 1 and len(shared) == 1:
        sentence += f"; every distance that disagrees is one of {names[shared.pop()]}"
    return sentence

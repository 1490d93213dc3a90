"""Attitudes of the head that show a board, and the most informative one among them.

One picture of a board and a rig that is known roughly show where the board is.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.adjust.solver import covariance_of
from calib.errors import CalibError, Unreachable
from calib.geometry.cahvor import CameraModel
from calib.geometry.pointing import Solution, choose, solve
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid
from calib.plan.knowledge import BenchShot, BoardView, ExpectedPointing, Knowledge

PLACES = (-0.05, 0.12, 0.31, 0.5, 0.69, 0.88, 1.05)
"""Where in a camera's picture the board's middle is tried, in parts of its width and of its height."""

EDGE_PX = 6.0
"""Corners nearer to the picture's edge are not relied on."""


@dataclass(frozen=True, eq=False)
class Sought:
    """The requirements of a shot, and the head's limits."""

    in_board_m: FloatArray  # (n, 3) all corners of the board
    sigma_px: float  # of one
    least: int  # corners that a picture must show to be used; all for a board whose parts look alike
    pan_limits_rad: tuple[float, float]
    tilt_limits_rad: tuple[float, float]
    one_sided: bool = False  # whether the head itself approaches from one side, whichever is requested


@dataclass(frozen=True, eq=False)
class AttitudeChoice:
    """The next shot, and the rms per axis of pointing that is expected after it, pixels."""

    shot: BenchShot
    expected_px: float


def seen(
    known: Knowledge, sought: Sought, shot: BenchShot, cameras: Collection[str] = ()
) -> BenchShot | None:
    """Return the shot with the corners that some cameras, by default all, are expected to see; None if none
    sees enough."""
    views = []
    for name in cameras or known.rig.cameras:
        inside = shown(known, sought, shot, name)
        if int(inside.sum()) >= sought.least:
            corners = sought.in_board_m[inside]
            views.append(BoardView(name, corners, np.full(len(corners), sought.sigma_px)))
    return replace(shot, views=tuple(views)) if views else None


def shown(
    known: Knowledge, sought: Sought, shot: BenchShot, name: str, edge_px: float = EDGE_PX
) -> NDArray[np.bool_]:
    """Return which of the board's corners (n,) a camera is expected to see, farther than ``edge_px`` from its
    picture's edges; negative: those too that lie so far outside."""
    board, camera = known.boards[shot.placement], known.rig.cameras[name]
    here, normal = board.points(sought.in_board_m), board.rotation[:, 2]
    if camera.on == "head":
        head = known.head(shot)
        here, normal = (here - head.translation_m) @ head.rotation, normal @ head.rotation
    sight = here.mean(axis=0) - camera.model.C
    # At a flatter angle between a board and the line of sight no corner is relied on.
    if sight @ normal < 0.35 * float(np.linalg.norm(sight)):
        return np.zeros(len(here), dtype=bool)
    pixels, valid = camera.model.project(here)
    size = np.array(camera.model.size_px)
    return np.asarray(valid & ((pixels > edge_px) & (pixels < size - 1 - edge_px)).all(axis=1))


def readings(
    rig: Rig,
    sought: Sought,
    camera: CameraModel,
    point_in_rover_m: FloatArray,
    pixel_px: tuple[float, float] | None = None,
) -> tuple[float, float]:
    """Return what the joints read, within the head's limits, when a head camera has a point at a pixel.

    By default that is the image's centre. Raises Unreachable, CalibError or ValueError if no reading does.
    """

    def read_rad(angles: Solution) -> tuple[float, float]:
        return rig.joints.read_rad((angles.pan_rad, angles.tilt_rad))

    found = solve(rig.mast, camera, point_in_rover_m, pixel_px)
    return read_rad(choose(found, sought.pan_limits_rad, sought.tilt_limits_rad, read=read_rad))


def _attitudes(known: Knowledge, sought: Sought, placement: str) -> Iterator[tuple[float, float]]:
    """Yield joint readings, radians, that bring the board's middle to places all over each head camera."""
    middle = known.boards[placement].translation_m
    models = [camera.model for camera in known.rig.cameras.values() if camera.on == "head"]
    for model, x, y in product(models, PLACES, PLACES):
        width, height = model.size_px
        try:
            yield readings(known.rig, sought, model, middle, (x * width, y * height))
        except (Unreachable, CalibError, ValueError):
            continue


def next_shot(
    known: Knowledge,
    sought: Sought,
    shots: Sequence[BenchShot],
    placement: str,
    aim: ExpectedPointing,
    avoid: Collection[tuple[float, float]] = (),
    ahead: int = 1,
) -> AttitudeChoice | None:
    """Return the next shot of a placed board for pointing to be best in the end; None if none shows it.

    ``shots`` were taken, of every placement. Attitudes (pan, tilt), radians, to ``avoid`` are no use, as
    where the board was not found. ``ahead`` is how many more shots there will be of this placement, this one
    among them. They are chosen together: the best one by itself is seldom the beginning of the best few.
    """
    base = with_board(known, shots, placement)
    here = [shot for shot in shots if shot.placement == placement]
    choices = list(candidates(known, sought, here, placement, avoid))
    if not choices:
        return None
    added = np.array([known.of_shot(shot) for shot in choices])
    plan = _together(base, added, aim, ahead)
    first = min(plan, key=dict(zip(plan, _left_px(base, added[plan], aim), strict=True)).__getitem__)
    others = [index for index in plan if index != first]
    if not sought.one_sided:
        # From which side a joint comes shows its backlash alone: it is tried for the best attitudes only.
        beside = base + added[others].sum(axis=0)
        # Of so many of the best attitudes every side of approach is tried.
        best = [i for i in np.argsort(_left_px(beside, added, aim)) if i not in others][:8]
        sides = [
            replace(
                choices[i],
                pan_approach=a * choices[i].pan_approach,
                tilt_approach=b * choices[i].tilt_approach,
            )
            for i in best
            for a, b in ((-1, 1), (1, -1), (-1, -1))
        ]
        choices += sides
        added = np.concatenate([added, [known.of_shot(shot) for shot in sides]])
        tried = [*best, *range(len(choices) - len(sides), len(choices))]
        first = tried[int(np.argmin(_left_px(beside, added[tried], aim)))]
    return AttitudeChoice(choices[first], float(_left_px(base, added[[first]], aim)[0]))


def _together(base: FloatArray, added: FloatArray, aim: ExpectedPointing, count: int) -> list[int]:
    """Which of some shots (n, p + 6, p + 6) show most together beside ``base``: one after the other, then
    each exchanged for a better one while there is any (Fedorov's exchange)."""
    plan: list[int] = []
    whole = base.copy()
    for _ in range(min(count, len(added))):
        left = _left_px(whole, added, aim)
        left[plan] = np.inf
        plan.append(int(np.argmin(left)))
        whole = whole + added[plan[-1]]
    # Rounds in which each of the shots that are chosen together may give way to a better one.
    for _ in range(2 if len(plan) > 1 else 0):
        before = list(plan)
        for place, index in enumerate(before):
            rest = whole - added[index]
            left = _left_px(rest, added, aim)
            left[[other for other in plan if other != index]] = np.inf
            plan[place] = int(np.argmin(left))
            whole = rest + added[plan[place]]
        if plan == before:
            break
    return plan


def _left_px(base: FloatArray, added: FloatArray, aim: ExpectedPointing) -> FloatArray:
    """Return the rms per axis (n,) of pointing that each of some shots (n, p + 6, p + 6) beside ``base``
    would leave, pixels."""
    whole = base + added
    # 1e-6: the prior of a board's pose before any picture: it is within some kilometre (1/m², 1/rad²).
    whole[:, -6:, -6:] += 1e-6 * np.eye(6)
    scale = 1.0 / np.sqrt(np.einsum("nii->ni", whole))
    whole *= scale[:, :, None] * scale[:, None, :]
    covariance = np.linalg.inv(whole) * scale[:, :, None] * scale[:, None, :]
    return np.array([aim.rms_px(one) for one in covariance[:, :-6, :-6]])


def with_board(known: Knowledge, shots: Sequence[BenchShot], placement: str) -> FloatArray:
    """Return the information of shots about the rig and one placement's board: (p + 6, p + 6)."""
    size = len(known.names)
    information = np.zeros((size + 6, size + 6))
    information[:size, :size] = known.information(shot for shot in shots if shot.placement != placement)
    return sum((known.of_shot(shot) for shot in shots if shot.placement == placement), information)


def candidates(
    known: Knowledge,
    sought: Sought,
    here: Sequence[BenchShot],
    placement: str,
    avoid: Collection[tuple[float, float]] = (),
) -> Iterator[BenchShot]:
    """Yield shots that show the board, apart from those taken, each from the side that is on the way.

    A head that does not choose its side comes from the attitude of the last shot. Cameras on the body see the
    board alike from every attitude: they are left out.
    """
    cameras = [name for name, camera in known.rig.cameras.items() if camera.on == "head"]
    useless = [*avoid, *((shot.pan_rad, shot.tilt_rad) for shot in here)]
    last = (here[-1].pan_rad, here[-1].tilt_rad) if here else (0.0, 0.0)
    for pan, tilt in _attitudes(known, sought, placement):
        # Attitudes near one that did not show the board, or was taken already, are not tried again.
        if any(max(abs(a - pan), abs(b - tilt)) < 0.02 for a, b in useless):
            continue
        sides = (0, 0) if sought.one_sided else (1 if pan > last[0] else -1, 1 if tilt > last[1] else -1)
        shot = seen(known, sought, BenchShot(placement, pan, tilt, (), *sides), cameras)
        if shot is not None:
            yield shot


def expected_px(known: Knowledge, shots: Sequence[BenchShot], aim: ExpectedPointing) -> float:
    """Return the rms per axis of pointing, pixels, that shots leave on paper."""
    return aim.rms_px(covariance_of(known.information(shots)))


FEWEST = 4


def rover_from_board(
    rig: Rig, camera: str, pan_rad: float, tilt_rad: float, in_board_m: FloatArray, pixels_px: FloatArray
) -> Rigid:
    """Return the pose of a flat board in the rover frame, seen by a camera at true joint angles.

    ``in_board_m`` and ``pixels_px`` are (n, 3) and (n, 2), at least four corners that are not in one line.
    Raises CalibError if they do not fix a pose in front of the camera.
    """
    mounted = rig.cameras[camera]
    model = mounted.model
    axes = model.rotation.T
    rays = model.ray(pixels_px).directions @ axes
    if len(rays) < FEWEST:
        raise CalibError(f"{len(rays)} corners where {FEWEST} at least fix a board")
    flat = np.ascontiguousarray(rays[:, :2] / rays[:, 2:])
    try:
        done, turn, place = cv2.solvePnP(
            np.ascontiguousarray(in_board_m), flat, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        done = False
    if not done or not np.isfinite(place).all() or place[2, 0] <= 0.0:
        raise CalibError(f"the corners in the picture of {camera} fix no board")
    left, _, right = np.linalg.svd(axes @ cv2.Rodrigues(turn)[0])  # to the nearest rotation
    pose = Rigid(left @ right, axes @ place[:, 0] + model.C)
    return pose if mounted.on == "rover" else rig.mast.rover_from_head(pan_rad, tilt_rad) @ pose

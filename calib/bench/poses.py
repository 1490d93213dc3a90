"""Attitudes of the head that show a board, and the one among them that tells most."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.bench.knowledge import Knowledge, Shot, View, without_board
from calib.bench.workspace import Pointing
from calib.camera.cahvor import CameraModel
from calib.errors import CalibError, Unreachable
from calib.fit.least_squares import covariance_of
from calib.mast.pointing import solve
from calib.mast.rig import Rig
from calib.mast.solutions import Solution, choose
from calib.rigid import FloatArray

PLACES = (-0.05, 0.12, 0.31, 0.5, 0.69, 0.88, 1.05)
"""Where in a camera's picture the board's middle is tried, in parts of its width and of its height."""

EDGE_PX = 6.0
"""Corners nearer to the picture's edge are not counted on."""

FLATTEST = 0.35
"""Cosine of the angle between a board's normal and the line of sight below which no corner is counted on."""

APART_RAD = 0.02
"""Attitudes nearer to one that did not show the board, or was taken already, are not tried again."""


SIDES_TRIED = 8
"""Of how many of the best attitudes every way to approach them is tried."""


@dataclass(frozen=True, eq=False)
class Sought:
    """What a shot has to show, and where the head may look.

    Attributes
    ----------
    in_board_m
        (n, 3) all corners of the board.
    sigma_px
        Of a corner.
    least
        Corners that a picture must show to count; all of them for a board whose parts cannot be told apart.
    pan_limits_rad, tilt_limits_rad
        The head's.
    one_sided
        Whether the head itself approaches from one side: from which one then makes no difference.
    """

    in_board_m: FloatArray
    sigma_px: float
    least: int
    pan_limits_rad: tuple[float, float]
    tilt_limits_rad: tuple[float, float]
    one_sided: bool = False


@dataclass(frozen=True, eq=False)
class Choice:
    """The next shot, and the rms per axis of pointing that is expected after it, pixels."""

    shot: Shot
    expected_px: float


def seen(known: Knowledge, sought: Sought, shot: Shot) -> Shot | None:
    """Return the shot with the corners that each camera is expected to see, or None if none sees enough."""
    board = known.boards[shot.placement]
    points = board.points(sought.in_board_m)
    head = known.head(shot)
    views = []
    for name, camera in known.rig.cameras.items():
        here = points if camera.on == "rover" else (points - head.translation_m) @ head.rotation
        normal = board.rotation[:, 2] if camera.on == "rover" else board.rotation[:, 2] @ head.rotation
        sight = here.mean(axis=0) - camera.model.C
        if sight @ normal < FLATTEST * float(np.linalg.norm(sight)):
            continue
        pixels, valid = camera.model.project(here)
        size = np.array(camera.model.size_px)
        inside = valid & ((pixels > EDGE_PX) & (pixels < size - 1 - EDGE_PX)).all(axis=1)
        if int(inside.sum()) >= sought.least:
            corners = sought.in_board_m[inside]
            views.append(View(name, corners, np.full(len(corners), sought.sigma_px)))
    return replace(shot, views=tuple(views)) if views else None


def readings(
    rig: Rig,
    sought: Sought,
    camera: CameraModel,
    point_in_rover_m: FloatArray,
    pixel_px: tuple[float, float] | None = None,
) -> tuple[float, float]:
    """Return what the joints read, within the head's limits, when a head camera has a point at a pixel.

    By default that is the image's centre.

    Raises
    ------
    Unreachable, CalibError, ValueError
        If no reading does.
    """

    def read_rad(angles: Solution) -> tuple[float, float]:
        return rig.joints.read_rad((angles.pan_rad, angles.tilt_rad))

    found = solve(rig.mast, camera, point_in_rover_m, pixel_px)
    return read_rad(choose(found, sought.pan_limits_rad, sought.tilt_limits_rad, read=read_rad))


def attitudes(known: Knowledge, sought: Sought, placement: str) -> Iterator[tuple[float, float]]:
    """Yield joint readings, radians, that bring the board's middle to places all over each head camera."""
    middle = known.boards[placement].translation_m
    for camera in known.rig.cameras.values():
        if camera.on != "head":
            continue
        width, height = camera.model.size_px
        for x in PLACES:
            for y in PLACES:
                try:
                    yield readings(known.rig, sought, camera.model, middle, (x * width, y * height))
                except (Unreachable, CalibError, ValueError):
                    continue


def next_shot(
    known: Knowledge,
    sought: Sought,
    shots: Sequence[Shot],
    placement: str,
    aim: Pointing,
    avoid: Collection[tuple[float, float]] = (),
) -> Choice | None:
    """Return the shot of a placed board after which pointing is expected to be best; None if none shows it.

    Parameters
    ----------
    known
        The present estimate, with the board's pose.
    sought
        What a shot has to show.
    shots
        What was taken, of every placement.
    placement
        Where the board stands now.
    aim
        What the rig is for.
    avoid
        Attitudes (pan, tilt), radians, that are no use, as where the board was not found.
    """
    here = [shot for shot in shots if shot.placement == placement]
    base = with_board(known, shots, placement)

    def judged(shot: Shot) -> Choice:
        return Choice(shot, aim.rms_px(covariance_of(without_board(base + known.of_shot(shot)))))

    choices = [judged(shot) for shot in candidates(known, sought, here, placement, avoid)]
    choices.sort(key=lambda one: one.expected_px)
    # From which side a joint comes tells its backlash alone: that is asked of the best attitudes only.
    for one in [] if sought.one_sided else choices[:SIDES_TRIED]:
        shot = one.shot
        sides = [(-shot.pan_approach, shot.tilt_approach), (shot.pan_approach, -shot.tilt_approach)]
        sides.append((-shot.pan_approach, -shot.tilt_approach))
        choices += [judged(replace(shot, pan_approach=pan, tilt_approach=tilt)) for pan, tilt in sides]
    return min(choices, key=lambda one: one.expected_px, default=None)


def with_board(known: Knowledge, shots: Sequence[Shot], placement: str) -> FloatArray:
    """Return what shots tell of the rig and of one placement's board: information (p + 6, p + 6)."""
    size = len(known.names)
    told = np.zeros((size + 6, size + 6))
    told[:size, :size] = known.information(shot for shot in shots if shot.placement != placement)
    return sum((known.of_shot(shot) for shot in shots if shot.placement == placement), told)


def candidates(
    known: Knowledge,
    sought: Sought,
    here: Sequence[Shot],
    placement: str,
    avoid: Collection[tuple[float, float]] = (),
) -> Iterator[Shot]:
    """Yield shots that show the board, apart from those taken, each from the side that is on the way.

    A head that does not choose its side comes from where it stands: from the attitude of the last shot.
    """
    useless = [*avoid, *((shot.pan_rad, shot.tilt_rad) for shot in here)]
    last = (here[-1].pan_rad, here[-1].tilt_rad) if here else (0.0, 0.0)
    for pan, tilt in attitudes(known, sought, placement):
        if any(max(abs(a - pan), abs(b - tilt)) < APART_RAD for a, b in useless):
            continue
        sides = (0, 0) if sought.one_sided else (1 if pan > last[0] else -1, 1 if tilt > last[1] else -1)
        shown = seen(known, sought, Shot(placement, pan, tilt, (), *sides))
        if shown is not None:
            yield shown


def expected_px(known: Knowledge, shots: Sequence[Shot], aim: Pointing) -> float:
    """Return the rms per axis of pointing, pixels, that shots leave on paper."""
    return aim.rms_px(covariance_of(known.information(shots)))

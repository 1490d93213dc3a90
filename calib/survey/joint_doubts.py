"""Joint angles with the wrong sign, or exchanged: the boards then stand where the head does not look.

A mast whose tilt counts downwards fits a survey as well as the true one, with its head turned by half a
turn: no residual shows it. The station does.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from calib.rigid import FloatArray
from calib.survey import Finding, Survey
from calib.survey.mixups import eyes_in_rover_m, rover_from_boards

FEWEST_IMAGES = 4
"""Of a camera; its mounting is taken out by their mean."""

BETTER = 0.6
"""Another reading of a column is believed if it leaves less than this part of the spread."""

STILL_RAD = 0.1
"""A spread so small says nothing: boards stand anywhere in the picture."""


def joint_doubts(survey: Survey) -> Iterator[Finding]:
    """Yield one error if pan and tilt, with another sign or exchanged, look far better at the boards."""
    joints, boards = _joints_and_boards(survey)
    if not joints:
        return
    # Right of the board, then up: how far boards spread about +pan, -pan, +tilt, -tilt.
    spreads = [
        {
            (column, sign): _spread_rad([sign * j[:, column] for j in joints], [b[:, axis] for b in boards])
            for column, sign in product((0, 1), (1, -1))
        }
        for axis in (0, 1)
    ]
    best = [min(spread, key=spread.__getitem__) for spread in spreads]
    if [column for column, _ in best] != [1, 0]:
        best = [min(((axis, 1), (axis, -1)), key=spreads[axis].__getitem__) for axis in (0, 1)]
    given = [spreads[axis][axis, 1] for axis in (0, 1)]
    better = [spreads[axis][best[axis]] for axis in (0, 1)]
    wrong = [g > STILL_RAD and b < BETTER * g for g, b in zip(given, better, strict=True)]
    if best[0][0] == 1:
        told = ["pan_rad and tilt_rad are exchanged"] if all(wrong) else []
    else:
        told = [f"the sign of {n} is wrong" for n, w in zip(("pan_rad", "tilt_rad"), wrong, strict=True) if w]
    if told:
        axis = wrong.index(True)
        yield Finding(
            "error",
            "images.csv",
            f"{' and '.join(told)}: the boards are spread by {np.degrees(given[axis]):.0f} degrees about "
            f"where the head looks as written, and by {np.degrees(better[axis]):.0f} degrees the other way",
            "Write radians; positive pan turns right, positive tilt looks up",
        )


def _joints_and_boards(survey: Survey) -> tuple[list[FloatArray], list[FloatArray]]:
    """By head camera: (n, 2) pan and tilt, and (n, 2) right and up of the boards as seen from there.

    Of the images for which the head was turned to the board; those for the camera show boards in corners.
    """
    poses, eyes = rover_from_boards(survey), eyes_in_rover_m(survey)
    joints, boards = [], []
    for name in survey.cameras:
        mine = [
            (image.pan_rad, image.tilt_rad, *poses[image.setup, image.placement].translation_m - eyes[name])
            for image in survey.images
            if image.camera == name
            and image.purpose != "camera"
            and image.pan_rad is not None
            and (image.setup, image.placement) in poses
        ]
        if len(mine) < FEWEST_IMAGES:
            continue
        table = np.array(mine, dtype=np.float64)
        x, y, z = table[:, 2:].T
        joints.append(table[:, :2])
        boards.append(np.column_stack([np.arctan2(y, x), np.arctan2(-z, np.hypot(x, y))]))
    return joints, boards


def _spread_rad(joints_rad: list[FloatArray], boards_rad: list[FloatArray]) -> float:
    """Rms angle between boards and joints (n,) about each camera's mean."""
    off = []
    for turned, seen in zip(joints_rad, boards_rad, strict=True):
        aside = np.exp(1j * (seen - turned))
        middle = aside.mean()
        off.append(np.angle(aside * np.conj(middle / max(abs(middle), 1e-12))))
    return float(np.sqrt(np.mean(np.concatenate(off) ** 2)))

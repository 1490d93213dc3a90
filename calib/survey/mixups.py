"""Images that cannot show the board they name, and joint angles with the wrong sign, or exchanged.

A mast whose tilt counts downwards fits a survey as well as the true one, with its head turned by half a
turn: no residual shows it. The station does: the boards then stand where the head does not look.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product
from typing import NamedTuple

import numpy as np

from calib.geometry.rigid import FloatArray, Rigid
from calib.survey.alignment import Alignment, poses
from calib.survey.disagreements import pixels_per_metre
from calib.survey.records import Survey, SurveyCamera, SurveyFinding, SurveyImage

CAMERA_OFF_M, ROUGH_OFF_M = 1.0, 0.25
"""How far a camera may be from where it is assumed: the middle of the prisms, or its rough place."""

SIZE = 1.45
"""How much lens, lean and focal length may change the size of a board."""

Placement = tuple[str, str]


class BoardBearing(NamedTuple):
    """Where an image's board is, seen from about where its camera is: to the right, upwards, and how far."""

    image: SurveyImage
    right_rad: float
    up_rad: float
    range_m: float


def sights(survey: Survey) -> dict[str, list[BoardBearing]]:
    """Return by camera the images whose board's place prisms and tapes determine."""
    boards, cameras_m = _rover_from_boards(survey), _cameras_in_rover_m(survey)
    found: dict[str, list[BoardBearing]] = {name: [] for name in survey.cameras}
    for image in survey.images:
        pose = boards.get((image.setup, image.placement))
        if pose is not None:
            away = pose.translation_m - cameras_m[image.camera]
            right, up = np.arctan2(away[1], away[0]), np.arctan2(-away[2], np.hypot(away[0], away[1]))
            found[image.camera].append(
                BoardBearing(image, float(right), float(up), float(np.linalg.norm(away)))
            )
    return found


def mixups(survey: Survey) -> Iterator[SurveyFinding]:
    """Yield boards that face away, and images that disagree with the others of their camera.

    The direction of the board is compared with the angle of pan, and its distance with the size of the grid
    in the image. Each is taken against the camera's median, so neither mounting nor focal length matters.
    """
    yield from _facing_away(_rover_from_boards(survey), _cameras_in_rover_m(survey))
    for name, mine in sights(survey).items():
        yield from _camera_mixups(survey, survey.cameras[name], mine)


def _rover_from_boards(survey: Survey) -> dict[Placement, Rigid]:
    """Where boards are, by set-up and placement; nothing is left out that does not fit."""
    rover, boards = poses(survey, "prism", 0.0), poses(survey, "tape", 0.0)
    return {
        (setup, placement): of_setup.b_from_a @ board.b_from_a
        for (setup, placement), board in boards.items()
        if isinstance(board, Alignment) and isinstance(of_setup := rover.get((setup, "")), Alignment)
    }


def _cameras_in_rover_m(survey: Survey) -> dict[str, FloatArray]:
    """About where each camera is, (3,) metres."""
    middle = np.mean(list(survey.prisms_in_rover_m.values()), axis=0)
    return {
        name: middle if camera.rough_C_m is None else camera.rough_C_m
        for name, camera in survey.cameras.items()
    }


def _facing_away(
    boards: Mapping[Placement, Rigid], cameras_m: Mapping[str, FloatArray]
) -> Iterator[SurveyFinding]:
    """Yield boards that turn their back on the rover."""
    middle_m = np.mean(list(cameras_m.values()), axis=0)
    for (setup, placement), pose in boards.items():
        towards = pose.translation_m - middle_m
        cosine = float(pose.rotation[:, 2] @ towards / max(float(np.linalg.norm(towards)), 1e-9))
        if cosine < -0.2:
            angle_deg = float(np.degrees(np.arccos(min(-cosine, 1.0))))
            yield SurveyFinding(
                "error",
                f"set-up {setup}, placement {placement}",
                f"the tapes say that the board turns its back to the rover ({angle_deg:.0f} degrees from "
                "straight away)",
                "Two tapes are exchanged (seen from the front, x goes right, y down, z into the board), or "
                "in tapes_in_board_m; correct the names",
            )


def _camera_mixups(survey: Survey, camera: SurveyCamera, mine: list[BoardBearing]) -> Iterator[SurveyFinding]:
    off_m = CAMERA_OFF_M if camera.rough_C_m is None else ROUGH_OFF_M
    seen, sizes = [], []
    for sight in mine:
        dots = survey.dots.get(sight.image.name)
        scale = None if dots is None else pixels_per_metre(survey, dots)
        if scale is not None:
            seen.append(sight)
            sizes.append(scale * sight.range_m / camera.focal_px)
    if len(seen) < 3:
        return
    aside = [sight.right_rad - (sight.image.pan_rad or 0.0) for sight in seen]
    usual_size = float(np.median(sizes))
    usual_aside = float(
        np.angle(np.median(np.exp(1j * np.array(aside)).real) + 1j * np.median(np.sin(aside)))
    )
    doubtful: list[tuple[SurveyImage, str]] = []
    for (image, _, _, range_m), angle, size in zip(seen, aside, sizes, strict=True):
        reasons = []
        off_rad = float(np.abs(np.angle(np.exp(1j * (angle - usual_aside)))))
        if image.pan_rad is not None and off_rad > _reach_rad(camera, image, range_m, off_m):
            reasons.append(f"its board is {np.degrees(off_rad):.0f} degrees aside of where pan looks")
        off = max(size / usual_size, usual_size / size)
        if off > SIZE * (1 + off_m / max(range_m, off_m)):
            larger = "larger" if size > usual_size else "smaller"
            reasons.append(f"its dots are {off:.1f} times {larger} than a board at {range_m:.1f} m shows")
        if reasons:
            doubtful.append((image, " and ".join(reasons)))
    if len(doubtful) > 0.5 * len(seen):  # not the names are at fault but a sign, a column or a length
        yield SurveyFinding(
            "error",
            f"camera {camera.name}",
            f"{len(doubtful)} of {len(seen)} images cannot show the board they name, "
            f"e.g. {doubtful[0][0].name}: {doubtful[0][1]}",
            "Check the sign of pan (right is positive), its unit, and the placements in images.csv",
        )
        return
    for image, reason in doubtful:
        yield SurveyFinding(
            "warning",
            f"images.csv line {image.row}, image {image.name}",
            f"it cannot show placement {image.placement}: {reason}",
            "Two boards may be mixed up: check the placement of this image, and the tapes of the placement",
        )
    range_m = float(np.median([sight.range_m for sight in seen]))
    off = max(usual_size, 1 / usual_size)
    if off > SIZE * (1 + off_m / max(range_m, off_m)):
        yield SurveyFinding(
            "error" if off > 2.5 else "warning",
            f"camera {camera.name}",
            f"its boards look {usual_size:.2f} times as large as focal_px {camera.focal_px:g} and "
            f"board.spacing_m say, which would fit a focal length of {usual_size * camera.focal_px:.0f} px",
            "Correct focal_px, or spacing_m if all cameras say so (a foot is 0.3048 m)",
        )


def _reach_rad(camera: SurveyCamera, image: SurveyImage, range_m: float, off_m: float) -> float:
    """How far aside of pan a board can be and still be seen."""
    half_view = float(np.arctan2(np.hypot(*camera.size_px) / 2, camera.focal_px))
    down = abs(image.tilt_rad or 0.0) + half_view
    if down > np.radians(75):
        return float(np.pi)
    across = half_view / float(np.cos(down))
    return across + float(np.arcsin(min(1.0, 1.5 * off_m / range_m))) + 0.15


STILL_RAD = 0.1
"""A spread so small says nothing: boards stand anywhere in the picture."""


def joint_mixups(survey: Survey) -> Iterator[SurveyFinding]:
    """Yield one error if pan and tilt, with another sign or exchanged, look far better at the boards."""
    # Of the images for which the head was turned to the board; those for the camera show it in corners.
    turned = [
        [one for one in mine if one.image.purpose != "camera" and one.image.pan_rad is not None]
        for mine in sights(survey).values()
    ]
    turned = [mine for mine in turned if len(mine) >= 4]  # a mean takes the mounting out
    if not turned:
        return
    joints = [np.array([(i.pan_rad, i.tilt_rad) for i, *_ in mine], dtype=np.float64) for mine in turned]
    boards = [np.array([(one.right_rad, one.up_rad) for one in mine]) for mine in turned]
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
    wrong = [g > STILL_RAD and b < 0.6 * g for g, b in zip(given, better, strict=True)]
    if best[0][0] == 1:
        faults = ["pan_rad and tilt_rad are exchanged"] if all(wrong) else []
    else:
        names = zip(("pan_rad", "tilt_rad"), wrong, strict=True)
        faults = [f"the sign of {name} is wrong" for name, off in names if off]
    if faults:
        axis = wrong.index(True)
        yield SurveyFinding(
            "error",
            "images.csv",
            f"{' and '.join(faults)}: the boards are spread by {np.degrees(given[axis]):.0f} degrees about "
            f"where the head looks as written, and by {np.degrees(better[axis]):.0f} degrees the other way",
            "Write radians; positive pan turns right, positive tilt looks up",
        )


def _spread_rad(joints_rad: list[FloatArray], boards_rad: list[FloatArray]) -> float:
    """Rms angle between boards and joints (n,) about each camera's mean."""
    off = []
    for turned, seen in zip(joints_rad, boards_rad, strict=True):
        aside = np.exp(1j * (seen - turned))
        middle = aside.mean()
        off.append(np.angle(aside * np.conj(middle / max(abs(middle), 1e-12))))
    return float(np.sqrt(np.mean(np.concatenate(off) ** 2)))

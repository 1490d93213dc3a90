"""Images that cannot show the board they name, and joint angles with the wrong sign, or exchanged.

A mast whose tilt counts downwards fits a survey as well as the true one, with its head turned by half a
turn: no residual shows it. The station does: the boards then stand where the head does not look.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product

import numpy as np

from calib.geometry.rigid import FloatArray, Rigid
from calib.survey.alignment import NotAligned, align
from calib.survey.doubts import pixels_per_metre
from calib.survey.records import Survey, SurveyCamera, SurveyFinding, SurveyImage

EYE_M, ROUGH_EYE_M = 1.0, 0.25
"""How far a camera may be from where it is taken to be: the middle of the prisms, or its rough place."""

SIZE = 1.45
"""How much lens, lean and focal length may change the size of a board."""

ASIDE_RAD = 0.15
MOST = 0.5
"""From so many images on, the names are not at fault but a sign, a column or a length."""

Placement = tuple[str, str]


def mixups(survey: Survey) -> Iterator[SurveyFinding]:
    """Yield boards that face away, and images that disagree with the others of their camera.

    The direction of the board is compared with the angle of pan, and its distance with the size of the grid
    in the image. Each is taken against the camera's median, so neither mounting nor focal length matters.
    """
    boards, eyes = rover_from_boards(survey), eyes_in_rover_m(survey)
    yield from _facing_away(boards, eyes)
    for camera in survey.cameras.values():
        yield from _camera_mixups(survey, camera, boards, eyes[camera.name])


def rover_from_boards(survey: Survey) -> dict[Placement, Rigid]:
    """Return where boards stand, by set-up and placement, as far as prisms and tapes determine it."""
    rover: dict[str, Rigid] = {}
    for (setup, _), seen in survey.measured("prism").items():
        design = [survey.prisms_in_rover_m[name] for name in seen]
        pose = _aligned(list(seen.values()), design)
        if pose is not None:
            rover[setup] = pose
    boards: dict[Placement, Rigid] = {}
    for (setup, placement), seen in survey.measured("tape").items():
        pose = _aligned([survey.board.tapes_in_board_m[name] for name in seen], list(seen.values()))
        if pose is not None and setup in rover:
            boards[setup, placement] = rover[setup] @ pose
    return boards


def eyes_in_rover_m(survey: Survey) -> dict[str, FloatArray]:
    """Return about where each camera is, (3,) metres."""
    middle = np.mean(list(survey.prisms_in_rover_m.values()), axis=0)
    return {
        name: middle if camera.rough_C_m is None else camera.rough_C_m
        for name, camera in survey.cameras.items()
    }


def _aligned(a: list[FloatArray], b: list[FloatArray]) -> Rigid | None:
    try:
        return align(a, b, 1.0, [""] * len(a)).b_from_a
    except NotAligned:
        return None


def _facing_away(
    boards: Mapping[Placement, Rigid], eyes: Mapping[str, FloatArray]
) -> Iterator[SurveyFinding]:
    """Yield boards that turn their back on the rover."""
    eye_m = np.mean(list(eyes.values()), axis=0)
    for (setup, placement), pose in boards.items():
        towards = pose.translation_m - eye_m
        cosine = float(pose.rotation[:, 2] @ towards / max(float(np.linalg.norm(towards)), 1e-9))
        if cosine < -0.2:
            yield SurveyFinding(
                "error",
                f"set-up {setup}, placement {placement}",
                f"the tapes say that the board turns its back to the rover ({_angle_deg(-cosine):.0f} "
                "degrees from straight away)",
                "Two tapes are exchanged (seen from the front, x goes right, y down, z into the board), or "
                "in tapes_in_board_m; correct the names",
            )


def _camera_mixups(
    survey: Survey, camera: SurveyCamera, boards: Mapping[Placement, Rigid], eye_m: FloatArray
) -> Iterator[SurveyFinding]:
    eye_sigma_m = EYE_M if camera.rough_C_m is None else ROUGH_EYE_M
    images, aside, sizes, ranges = [], [], [], []
    for image in survey.images:
        pose = boards.get((image.setup, image.placement))
        scale = pixels_per_metre(survey, survey.dots[image.name]) if image.name in survey.dots else None
        if image.camera != camera.name or pose is None or scale is None:
            continue
        images.append(image)
        aside.append(_aside_rad(pose, eye_m, image))
        ranges.append(float(np.linalg.norm(pose.translation_m - eye_m)))
        sizes.append(scale * ranges[-1] / camera.focal_px)
    if len(images) < 3:
        return
    usual_size = float(np.median(sizes))
    usual_aside = float(
        np.angle(np.median(np.exp(1j * np.array(aside)).real) + 1j * np.median(np.sin(aside)))
    )
    doubtful: list[tuple[SurveyImage, str]] = []
    for image, angle, size, range_m in zip(images, aside, sizes, ranges, strict=True):
        words = []
        off_rad = float(np.abs(np.angle(np.exp(1j * (angle - usual_aside)))))
        if image.pan_rad is not None and off_rad > _reach_rad(camera, image, range_m, eye_sigma_m):
            words.append(f"its board stands {np.degrees(off_rad):.0f} degrees aside of where pan looks")
        off = max(size / usual_size, usual_size / size)
        if off > SIZE * (1 + eye_sigma_m / max(range_m, eye_sigma_m)):
            larger = "larger" if size > usual_size else "smaller"
            words.append(f"its dots are {off:.1f} times {larger} than a board at {range_m:.1f} m shows")
        if words:
            doubtful.append((image, " and ".join(words)))
    if len(doubtful) > MOST * len(images):
        yield SurveyFinding(
            "error",
            f"camera {camera.name}",
            f"{len(doubtful)} of {len(images)} images cannot show the board they name, "
            f"e.g. {doubtful[0][0].name}: {doubtful[0][1]}",
            "Check the sign of pan (right is positive), its unit, and the placements in images.csv",
        )
        return
    for image, words_of in doubtful:
        yield SurveyFinding(
            "warning",
            f"images.csv line {image.row}, image {image.name}",
            f"it cannot show placement {image.placement}: {words_of}",
            "Two boards may be mixed up: check the placement of this image, and the tapes of the placement",
        )
    yield from _size(camera, usual_size, float(np.median(ranges)), eye_sigma_m)


def _size(camera: SurveyCamera, usual: float, range_m: float, eye_sigma_m: float) -> Iterator[SurveyFinding]:
    """Yield a focal length or a spacing of dots that the size of the boards in the pictures contradicts."""
    if max(usual, 1 / usual) > SIZE * (1 + eye_sigma_m / max(range_m, eye_sigma_m)):
        yield SurveyFinding(
            "error" if max(usual, 1 / usual) > 2.5 else "warning",
            f"camera {camera.name}",
            f"its boards look {usual:.2f} times as large as focal_px {camera.focal_px:g} and "
            f"board.spacing_m say, which would fit a focal length of {usual * camera.focal_px:.0f} px",
            "Correct focal_px, or spacing_m if all cameras say so (a foot is 0.3048 m)",
        )


def _angle_deg(cosine: float) -> float:
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _aside_rad(pose: Rigid, eye_m: FloatArray, image: SurveyImage) -> float:
    """Direction of the board less pan, about the rover's z."""
    x, y, _ = pose.translation_m - eye_m
    return float(np.arctan2(y, x)) - (image.pan_rad or 0.0)


def _reach_rad(camera: SurveyCamera, image: SurveyImage, range_m: float, eye_sigma_m: float) -> float:
    """How far aside of pan a board can be and still be seen."""
    half_view = float(np.arctan2(np.hypot(*camera.size_px) / 2, camera.focal_px))
    down = abs(image.tilt_rad or 0.0) + half_view
    if down > np.radians(75):
        return float(np.pi)
    across = half_view / float(np.cos(down))
    return across + float(np.arcsin(min(1.0, 1.5 * eye_sigma_m / range_m))) + ASIDE_RAD


FEWEST_IMAGES = 4
"""Of a camera; its mounting is taken out by their mean."""

BETTER = 0.6
"""Another reading of a column is believed if it leaves less than this part of the spread."""

STILL_RAD = 0.1
"""A spread so small says nothing: boards stand anywhere in the picture."""


def joint_doubts(survey: Survey) -> Iterator[SurveyFinding]:
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
        yield SurveyFinding(
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

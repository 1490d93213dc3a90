"""Images that cannot show the board they name: wrong direction, wrong distance, wrong side."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from calib.rigid import FloatArray, Rigid
from calib.survey import Finding, Survey, SurveyCamera, SurveyImage
from calib.survey.alignment import NotAligned, align
from calib.survey.doubts import pixels_per_metre

EYE_M, ROUGH_EYE_M = 1.0, 0.25
"""How far a camera may be from where it is taken to be: the middle of the prisms, or its rough place."""

SIZE = 1.45
"""How much lens, lean and focal length may change the size of a board."""

ASIDE_RAD = 0.15
MOST = 0.5
"""From so many images on, the names are not at fault but a sign, a column or a length."""

Placement = tuple[str, str]


def mixups(survey: Survey) -> Iterator[Finding]:
    """Yield boards that face away, and images that disagree with the others of their camera.

    Compared is the direction of the board with the angle of pan, and its distance with the size of the grid
    in the picture, each against the camera's median: neither its mounting nor its focal length matters.
    """
    boards, eyes = rover_from_boards(survey), eyes_in_rover_m(survey)
    yield from _facing_away(boards, eyes)
    for camera in survey.cameras.values():
        yield from _camera_mixups(survey, camera, boards, eyes[camera.name])


def rover_from_boards(survey: Survey) -> dict[Placement, Rigid]:
    """Return where boards stand, by set-up and placement, as far as three prisms and three tapes tell."""
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


def _facing_away(boards: Mapping[Placement, Rigid], eyes: Mapping[str, FloatArray]) -> Iterator[Finding]:
    """Yield boards that turn their back on the rover."""
    eye_m = np.mean(list(eyes.values()), axis=0)
    for (setup, placement), pose in boards.items():
        towards = pose.translation_m - eye_m
        cosine = float(pose.rotation[:, 2] @ towards / max(float(np.linalg.norm(towards)), 1e-9))
        if cosine < -0.2:
            yield Finding(
                "error",
                f"set-up {setup}, placement {placement}",
                f"the tapes say that the board turns its back to the rover ({_angle_deg(-cosine):.0f} "
                "degrees from straight away)",
                "Two tapes are exchanged (seen from the front, x goes right, y down, z into the board), or "
                "in tapes_in_board_m; correct the names",
            )


def _camera_mixups(
    survey: Survey, camera: SurveyCamera, boards: Mapping[Placement, Rigid], eye_m: FloatArray
) -> Iterator[Finding]:
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
        yield Finding(
            "error",
            f"camera {camera.name}",
            f"{len(doubtful)} of {len(images)} images cannot show the board they name, "
            f"e.g. {doubtful[0][0].name}: {doubtful[0][1]}",
            "Check the sign of pan (right is positive), its unit, and the placements in images.csv",
        )
        return
    for image, words_of in doubtful:
        yield Finding(
            "warning",
            f"images.csv line {image.row}, image {image.name}",
            f"it cannot show placement {image.placement}: {words_of}",
            "Two boards may be mixed up: check the placement of this image, and the tapes of the placement",
        )
    yield from _size(camera, usual_size, float(np.median(ranges)), eye_sigma_m)


def _size(camera: SurveyCamera, usual: float, range_m: float, eye_sigma_m: float) -> Iterator[Finding]:
    """Yield a focal length or a spacing of dots that the size of the boards in the pictures contradicts."""
    if max(usual, 1 / usual) > SIZE * (1 + eye_sigma_m / max(range_m, eye_sigma_m)):
        yield Finding(
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

"""Find the dots in all pictures of a survey, several at a time.

The station (prisms, tapes) and the rough camera predict where the board is. A plain mast carries the camera
to each image's joint angles: pan about a vertical axis amid the head's rough cameras, tilt about y. Rough
cameras are good to 20 cm and 10 degrees, and so is this. Cameras without a rough place are assumed upright.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.files import open_plain
from calib.files.pictures import decode_picture
from calib.geometry.cahvor import COEFFICIENTS, WIDE, CameraModel, Kind
from calib.geometry.rigid import FloatArray, Rigid, rot_y, rot_z
from calib.survey.alignment import NotAligned, rover_from_station, station_from_board
from calib.survey.records import Survey, SurveyCamera, SurveyImage
from calib.targets.boards import Board, CornersNotFound, Dots
from calib.targets.dots import PredictedBoard, Upright, find_dots

DOWN = np.array([0.0, 0.0, 1.0])

Progress = Callable[[int, int, str], None]
"""Called with how many images are done, of how many, and the name of the last."""


@dataclass(frozen=True, eq=False)
class SurveyDots:
    """``dots`` by image name, also those that the survey had already; ``failures``, a sentence each."""

    dots: Mapping[str, Dots]
    failures: Mapping[str, str]


def detect_survey(
    survey: Survey, executor: Executor | None = None, progress: Progress | None = None
) -> SurveyDots:
    """Return the dots of every image of a survey, found in its picture where dots.csv has none.

    The work is done in the executor, e.g. a ``ProcessPoolExecutor`` (its workers must reach the pictures), or
    in this thread; the result does not depend on it. ``progress`` is called after each image, in this thread.
    """
    expected = expectations(survey)
    images = [i for i in survey.images if i.name not in survey.dots and i.file != Path()]
    tasks = [
        (survey.folder / i.file, survey.cameras[i.camera].size_px, survey.board, expected[i.name])
        for i in images
    ]
    found, failures = dict(survey.dots), dict[str, str]()
    results = map(_find, tasks) if executor is None else executor.map(_find, tasks)
    for count, (image, result) in enumerate(zip(images, results, strict=True), 1):
        if isinstance(result, Dots):
            found[image.name] = result
        else:
            failures[image.name] = result.reason
        if progress is not None:
            progress(count, len(tasks), image.name)
    return SurveyDots({i.name: found[i.name] for i in survey.images if i.name in found}, failures)


def _find(
    task: tuple[Path, tuple[int, int], Board, PredictedBoard | Upright | None],
) -> Dots | CornersNotFound:
    return find_in_file(*task)


def find_in_file(
    path: Path, size_px: tuple[int, int], board: Board, expected: PredictedBoard | Upright | None
) -> Dots | CornersNotFound:
    """Find the dots in a picture file; a file that cannot be used is a failure with a reason."""
    try:
        with open_plain(path) as file:
            data = file.read()
    except OSError as error:
        return CornersNotFound(f"{path.name} cannot be read: {error.strerror or error}")
    try:
        image = decode_picture(data)
    except ValueError as reason:
        return CornersNotFound(f"{path.name} is not a picture that can be read: {reason}")
    height, width = image.shape[:2]
    if (width, height) != tuple(size_px):
        return CornersNotFound(
            f"{path.name} is {width} x {height} px where {size_px[0]} x {size_px[1]} are expected"
        )
    if image.dtype not in (np.uint8, np.uint16):
        return CornersNotFound(f"{path.name} holds {image.dtype} where 8 or 16 bits a pixel are expected")
    return find_dots(image, board, expected)


def expectations(survey: Survey) -> dict[str, PredictedBoard | Upright | None]:
    """Return what is known beforehand of each image's board, by image name.

    None where the station data do not determine the board's pose.
    """
    try:
        setups = {name: fit.b_from_a for name, fit in rover_from_station(survey).items()}
        placements = {key: fit.b_from_a for key, fit in station_from_board(survey).items()}
    except NotAligned:
        setups, placements = {}, {}
    heads = [c.rough_C_m for c in survey.cameras.values() if c.on == "head" and c.rough_C_m is not None]
    pivot = np.mean(heads, axis=0) if heads else np.zeros(3)
    first: dict[str, SurveyImage] = {}
    for image in survey.images:
        first.setdefault(image.camera, image)
    expected: dict[str, PredictedBoard | Upright | None] = {}
    for image in survey.images:
        camera = survey.cameras[image.camera]
        key = (image.setup, image.placement)
        if image.setup not in setups or key not in placements:
            expected[image.name] = None
            continue
        rover_from_board = setups[image.setup] @ placements[key]
        turn = _head_turn(image, camera)
        if camera.rough_C_m is None or camera.rough_A is None:
            down = rover_from_board.inverse.vectors(turn @ DOWN)
            # A body camera looks down as well, but its picture's down is nearest to the rover's.
            upright = _rough_model(camera, np.zeros(3), np.array([1.0, 0.0, 0.0]), np.eye(3), np.eye(3))
            camera_from_carrier = Rigid(np.eye(3)[[1, 2, 0]], np.zeros(3))
            expected[image.name] = Upright(upright.moved(camera_from_carrier), down)
        else:
            turned = turn @ _head_turn(first[image.camera], camera).T
            C = pivot + turned @ (camera.rough_C_m - pivot) if camera.on == "head" else camera.rough_C_m
            expected[image.name] = PredictedBoard(
                _rough_model(camera, C, camera.rough_A, turn, turned), rover_from_board
            )
    return expected


def _head_turn(image: SurveyImage, camera: SurveyCamera) -> FloatArray:
    """The head's axes in the rover frame, for a mast that stands upright; (3, 3)."""
    if camera.on != "head" or image.pan_rad is None or image.tilt_rad is None:
        return np.eye(3)
    return np.asarray(rot_z(image.pan_rad) @ rot_y(image.tilt_rad))


def _rough_model(
    camera: SurveyCamera, C: FloatArray, first_A: FloatArray, turn: FloatArray, turned: FloatArray
) -> CameraModel:
    """An ideal camera there: its rows are level in its carrier, its lens a pinhole or an even fisheye."""
    A = turned @ first_A
    A = A / np.linalg.norm(A)
    right = np.cross(turn @ DOWN, A)
    if float(np.linalg.norm(right)) < 1e-3:  # straight down: the top of the image is ahead
        right = turn @ np.array([0.0, 1.0, 0.0])
    right = right - (right @ A) * A
    right = right / np.linalg.norm(right)
    x_px, y_px = ((n - 1) / 2 for n in camera.size_px)
    matrix = [[camera.focal_px, 0.0, x_px], [0.0, camera.focal_px, y_px], [0.0, 0.0, 1.0]]
    kind: Kind = "OPENCV_FISHEYE" if camera.kind in WIDE else "CAHV"
    lens = np.zeros(COEFFICIENTS.get(kind, 0))
    return CameraModel.of_matrix(kind, camera.size_px, matrix, lens, [right, np.cross(A, right), A], C)

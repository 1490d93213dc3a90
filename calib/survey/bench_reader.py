"""Read the folder of a bench: boards whose places nobody measured, and no station."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import cast

import numpy as np

from calib.boards import AnyBoard, Corners
from calib.boards.board_file import board_of
from calib.errors import BadFile
from calib.files.mast_file import read_stereo
from calib.files.strict import Section
from calib.files.yaml_text import kind_of
from calib.survey.folder import SCHEMA, Folder, image_of, joints_of, once, pixel_of
from calib.survey.records import NO_BOARD, Approach, Purpose, Survey, SurveyCamera, SurveyImage
from calib.survey.rows import Row
from calib.survey.survey_yaml import bench_sigma_of, cameras_of

BENCH_IMAGE_COLUMNS = ("image", "camera", "placement", "board", "purpose", "pan_rad", "tilt_rad", "file")

APPROACH_COLUMNS = ("pan_approach", "tilt_approach")

CORNER_COLUMNS = ("image", "board", "id", "x_px", "y_px")

SIGMA_COLUMN = "sigma_px"

WORST_SIGMA_PX = 100.0


def read_bench(read: Folder, document: object) -> Survey:
    """Return the survey of a folder whose survey.yaml names ``boards``.

    images.csv may have no rows yet, or not be there: a bench grows while it is measured.

    Raises
    ------
    BadFile
        As `calib.survey.read_survey`.
    """
    path = read.path / "survey.yaml"
    top = Section(path, "", document, ("schema", "boards", "sigma", "cameras"), ("stereo",))
    if top.values["schema"] != SCHEMA:
        raise top.bad("schema", f"{kind_of(top.values['schema'])} where '{SCHEMA}' is expected")
    for name in ("station.csv", "dots.csv", "clicks.csv"):
        if (read.path / name).exists():
            raise BadFile(read.path / name, "", "goes with a station, and survey.yaml has boards without one")
    boards = _boards(top)
    cameras = cameras_of(top)
    sigma = bench_sigma_of(top.section("sigma", ("corner_px",), ("joint_rad",)))
    images = _images(read, cameras, boards)
    return Survey(
        folder=read.path,
        board=NO_BOARD,
        prisms_in_rover_m={},
        sigma=sigma,
        cameras=cameras,
        stereo=read_stereo(top, cameras),
        station=(),
        images=images,
        dots={},
        boards=boards,
        corners=_corners(read, boards, cameras, {image.name: image for image in images}, sigma.corner_px),
        digest=read.digest(),
    )


def _boards(top: Section) -> dict[str, AnyBoard]:
    boards: dict[str, AnyBoard] = {}
    for name, value in top.mapping("boards").items():
        if not name.strip() or not name.isprintable():
            raise top.bad("boards", f"{name[:40]!r} where the name of a board is expected")
        boards[name] = board_of(top.path, f"boards.{name}", value)
    if not boards:
        raise top.bad("boards", "holds no board; at least one is expected")
    return boards


def _images(
    read: Folder, cameras: Mapping[str, SurveyCamera], boards: Mapping[str, AnyBoard]
) -> tuple[SurveyImage, ...]:
    images: list[SurveyImage] = []
    names: dict[tuple[str, ...], int] = {}
    shown: dict[tuple[str, ...], int] = {}
    for row in read.rows("images.csv", BENCH_IMAGE_COLUMNS, ("setup", *APPROACH_COLUMNS), optional=True):
        name = row.text("image")
        once(names, (name,), row, f"image {name}")
        camera = cameras[row.choice("camera", tuple(cameras), "camera of survey.yaml")]
        board = row.choice("board", tuple(boards), "board of survey.yaml")
        purpose = cast(Purpose, row.choice("purpose", ("camera", "mast", "check"), "purpose"))
        pan_rad, tilt_rad = joints_of(row, camera)
        file = row.cells["file"]
        if file:
            once(shown, (file, board), row, f"board {board} in file {file}")
            read.check_picture(row, file, camera)
        images.append(
            SurveyImage(
                name,
                camera.name,
                row.cells.get("setup", ""),
                row.text("placement"),
                purpose,
                pan_rad,
                tilt_rad,
                Path(file),
                row.line,
                board,
                *(_approach(row, column, camera) for column in APPROACH_COLUMNS),
            )
        )
    return tuple(images)


def _approach(row: Row, column: str, camera: SurveyCamera) -> Approach:
    """From which side a joint came to rest."""
    word = row.cells.get(column, "")
    if not word:
        return 0
    if camera.on == "rover":
        raise row.bad(column, f"'{word[:40]}' where nothing is expected: {camera.name} is on the body")
    value = row.number(column, 1.0)
    if value not in (-1.0, 0.0, 1.0):
        raise row.bad(column, f"{word[:40]} where -1, 0 or 1 is expected")
    return cast(Approach, int(value))


def _corners(
    read: Folder,
    boards: Mapping[str, AnyBoard],
    cameras: Mapping[str, SurveyCamera],
    images: Mapping[str, SurveyImage],
    corner_px: float,
) -> dict[str, Corners]:
    found: dict[str, list[tuple[int, float, float, float]]] = {}
    seen: dict[tuple[str, ...], int] = {}
    counts = {name: len(board.ids) for name, board in boards.items()}
    for row in read.rows("corners.csv", CORNER_COLUMNS, (SIGMA_COLUMN,), optional=True):
        name = image_of(row, images)
        board = row.choice("board", tuple(boards), "board of survey.yaml")
        if board != images[name].board:
            raise row.bad("board", f"'{board}' where image {name} of images.csv shows {images[name].board}")
        number = row.index("id", counts[board])
        once(seen, (name, str(number)), row, f"corner {number} of image {name}")
        x_px, y_px = pixel_of(row, cameras[images[name].camera])
        sigma_px = corner_px
        if row.cells.get(SIGMA_COLUMN):
            sigma_px = row.number(SIGMA_COLUMN, WORST_SIGMA_PX)
            if sigma_px <= 0:
                raise row.bad(SIGMA_COLUMN, f"{sigma_px:g} where a number above 0 is expected")
        found.setdefault(name, []).append((number, x_px, y_px, sigma_px))
    corners: dict[str, Corners] = {}
    for name, rows in found.items():
        table = np.array(rows)
        corners[name] = Corners(table[:, 0].astype(np.int64), table[:, 1:3], table[:, 3])
    return corners

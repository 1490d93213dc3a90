"""Read a survey folder strictly: what is wrong is refused with file, line and column.

A bench's folder has boards at unknown places, and no station.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import cast

import numpy as np

from calib.errors import BadFile
from calib.files.mast_file import read_stereo
from calib.files.yaml_text import Section, kind_of, nearest
from calib.geometry.rigid import FloatArray
from calib.survey.folder import (
    BOARD_KEYS,
    FURTHEST_M,
    SCHEMA,
    Row,
    SurveyFolder,
    array_of,
    bench_sigma_of,
    cameras_of,
    dot_board_of,
    image_of,
    joints_of,
    once,
    pixel_of,
    places_of,
    sigma_of,
)
from calib.survey.records import (
    Approach,
    Click,
    Purpose,
    StationKind,
    StationPoint,
    Survey,
    SurveyCamera,
    SurveyImage,
)
from calib.targets.board_file import board_of
from calib.targets.boards import NO_BOARD, AnyBoard, Board, Corners, Dots

BENCH_IMAGE_COLUMNS = ("image", "camera", "placement", "board", "purpose", "pan_rad", "tilt_rad", "file")

APPROACH_COLUMNS = ("pan_approach", "tilt_approach")

CORNER_COLUMNS = ("image", "board", "id", "x_px", "y_px")

SIGMA_COLUMN = "sigma_px"

WORST_SIGMA_PX = 100.0


def read_bench(read: SurveyFolder, document: object) -> Survey:
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
    images = _bench_images(read, cameras, boards)
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


def _bench_images(
    read: SurveyFolder, cameras: Mapping[str, SurveyCamera], boards: Mapping[str, AnyBoard]
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
    read: SurveyFolder,
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


STATION_COLUMNS = ("setup", "kind", "placement", "point", "x_m", "y_m", "z_m")

IMAGE_COLUMNS = ("image", "camera", "setup", "placement", "purpose", "pan_rad", "tilt_rad", "file")

DOT_COLUMNS = ("image", "row", "column", "x_px", "y_px")

CLICK_COLUMNS = ("image", "point", "x_px", "y_px")


def read_survey(folder: str | Path) -> Survey:
    """Read a survey folder.

    Pictures are not opened but for the size in their first bytes; whether there are enough of them, and
    whether the measurements fit together, is for `calib.survey.check.check_survey`.

    Parameters
    ----------
    folder
        Holds survey.yaml, station.csv, images.csv and, as wanted, dots.csv and clicks.csv; or, where
        survey.yaml names ``boards`` and no station was there, images.csv and corners.csv.

    Returns
    -------
    Survey
        Its ``digest`` is the SHA-256 over names and contents of these files and of the images that images.csv
        names. It is the same on every machine and changes with every byte.

    Raises
    ------
    BadFile
        For a file that is missing or cannot be read, an unknown key, column or name, an invalid number, a
        double row, an image of another size. The message has the file, the place, and what would be right.
    """
    read = SurveyFolder(Path(folder))
    document = read.document()
    return read_bench(read, document) if "boards" in document else _with_station(read, document)


def _with_station(read: SurveyFolder, document: object) -> Survey:
    """The survey of a folder with station.csv."""
    path = read.path / "survey.yaml"
    top = Section(
        path,
        "",
        document,
        ("schema", "board", "prisms_in_rover_m", "sigma", "cameras"),
        ("stereo",),
    )
    if top.values["schema"] != SCHEMA:
        raise top.bad("schema", f"{kind_of(top.values['schema'])} where '{SCHEMA}' is expected")
    board = dot_board_of(top.section("board", BOARD_KEYS))
    prisms = places_of(top, "prisms_in_rover_m", "prism")
    cameras = cameras_of(top)
    stereo = read_stereo(top, cameras)
    sigma = sigma_of(top.section("sigma", ("station_m", "dot_px"), ("joint_rad", "prism_cad_m")))
    station = _station(read, board, prisms)
    images = _images(read, cameras, sorted({point.setup for point in station}))
    by_name = {image.name: image for image in images}
    return Survey(
        folder=read.path,
        board=board,
        prisms_in_rover_m=prisms,
        sigma=sigma,
        cameras=cameras,
        stereo=stereo,
        station=station,
        images=images,
        dots=_dots(read, board, cameras, by_name),
        clicks=_clicks(read, cameras, by_name, station),
        digest=read.digest(),
    )


def _station(read: SurveyFolder, board: Board, prisms: Mapping[str, FloatArray]) -> tuple[StationPoint, ...]:
    points: list[StationPoint] = []
    seen: dict[tuple[str, ...], int] = {}
    for row in read.rows("station.csv", STATION_COLUMNS):
        setup = row.text("setup")
        kind = row.choice("kind", ("prism", "tape", "check"), "kind of point")
        placement = row.cells["placement"]
        if kind == "tape":
            placement = row.text("placement")
        elif placement:
            raise row.bad("placement", f"'{placement[:40]}' where a {kind}'s is empty")
        if kind == "prism":
            point = row.choice("point", tuple(prisms), "prism of survey.yaml")
        elif kind == "tape":
            point = row.choice("point", tuple(board.tapes_in_board_m), "tape of survey.yaml")
        else:
            point = row.text("point")
        name = f"{kind} {point} of " + (f"placement {placement} in " if placement else "")
        once(seen, (setup, kind, placement, point), row, f"{name}set-up {setup}")
        position_m = array_of(row.numbers(("x_m", "y_m", "z_m"), FURTHEST_M))
        points.append(StationPoint(setup, cast(StationKind, kind), placement, point, position_m, row.line))
    read.some(points, "station.csv", "the prisms and tapes that were measured")
    return tuple(points)


def _images(
    read: SurveyFolder, cameras: Mapping[str, SurveyCamera], setups: list[str]
) -> tuple[SurveyImage, ...]:
    images: list[SurveyImage] = []
    names: dict[tuple[str, ...], int] = {}
    files: dict[tuple[str, ...], int] = {}
    for row in read.rows("images.csv", IMAGE_COLUMNS):
        name = row.text("image")
        once(names, (name,), row, f"image {name}")
        camera = cameras[row.choice("camera", tuple(cameras), "camera of survey.yaml")]
        setup = row.choice("setup", setups, "set-up of station.csv")
        purpose = cast(Purpose, row.choice("purpose", ("camera", "mast", "check"), "purpose"))
        placement = row.cells["placement"] if purpose == "check" else row.text("placement")
        pan_rad, tilt_rad = joints_of(row, camera)
        file = row.cells["file"]
        if file:
            once(files, (file,), row, f"file {file}")
            read.check_picture(row, file, camera)
        image = (name, camera.name, setup, placement, purpose, pan_rad, tilt_rad, Path(file), row.line)
        images.append(SurveyImage(*image))
    read.some(images, "images.csv", "the images that were taken")
    return tuple(images)


def _dots(
    read: SurveyFolder, board: Board, cameras: Mapping[str, SurveyCamera], images: Mapping[str, SurveyImage]
) -> dict[str, Dots]:
    found: dict[str, list[tuple[int, int, float, float]]] = {}
    seen: dict[tuple[str, ...], int] = {}
    for row in read.rows("dots.csv", DOT_COLUMNS, optional=True):
        name = image_of(row, images)
        place = row.index("row", board.rows), row.index("column", board.columns)
        once(seen, (name, *map(str, place)), row, f"dot {place} of image {name}")
        x_px, y_px = pixel_of(row, cameras[images[name].camera])
        found.setdefault(name, []).append((*place, x_px, y_px))
    dots: dict[str, Dots] = {}
    for name, places in found.items():
        table = np.array(places, dtype=np.float64)
        indices = table[:, :2].astype(np.int64)
        dots[name] = Dots(indices[:, 0], indices[:, 1], table[:, 2:])
    return dots


def _clicks(
    read: SurveyFolder,
    cameras: Mapping[str, SurveyCamera],
    images: Mapping[str, SurveyImage],
    station: tuple[StationPoint, ...],
) -> tuple[Click, ...]:
    checks = {(point.setup, point.point) for point in station if point.kind == "check"}
    clicks: list[Click] = []
    seen: dict[tuple[str, ...], int] = {}
    for row in read.rows("clicks.csv", CLICK_COLUMNS, optional=True):
        name, point = image_of(row, images), row.text("point")
        setup = images[name].setup
        if (setup, point) not in checks:
            known = sorted(other for where, other in checks if where == setup)
            there = nearest(point, known) if known else "it has none"
            raise row.bad("point", f"'{point[:40]}' is no check point of set-up {setup}; {there}")
        once(seen, (name, point), row, f"point {point} of image {name}")
        clicks.append(Click(name, point, array_of(pixel_of(row, cameras[images[name].camera]))))
    return tuple(clicks)

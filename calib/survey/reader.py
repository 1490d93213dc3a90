"""Read a survey folder (contract section 2) strictly: what is wrong is refused with file, line and column."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np

from calib.errors import BadFile
from calib.files import digest_of, read_bytes
from calib.files.mast_file import read_stereo
from calib.files.strict import Section, nearest
from calib.files.yaml_text import MAX_BYTES, kind_of, parse_mapping
from calib.rigid import FloatArray
from calib.survey.picture_file import picture_size_px
from calib.survey.records import (
    Board,
    Click,
    Dots,
    Purpose,
    StationKind,
    StationPoint,
    Survey,
    SurveyCamera,
    SurveyImage,
)
from calib.survey.rows import Row, rows_of
from calib.survey.survey_yaml import BOARD_KEYS, FURTHEST_M, board_of, cameras_of, places_of, sigma_of

SCHEMA = "mastctl/survey/1"

STATION_COLUMNS = ("setup", "kind", "placement", "point", "x_m", "y_m", "z_m")

IMAGE_COLUMNS = ("image", "camera", "setup", "placement", "purpose", "pan_rad", "tilt_rad", "file")

DOT_COLUMNS = ("image", "row", "column", "x_px", "y_px")

CLICK_COLUMNS = ("image", "point", "x_px", "y_px")

CSV_MAX_BYTES = 200_000_000

LARGEST_ANGLE_RAD = 1e4
"""Beyond these a number is no measurement; what is merely unlikely is for the check of the survey."""

EDGE_PX = 1.0
"""How far outside its image a dot may have been found: noise at the border."""


def read_survey(folder: str | Path) -> Survey:
    """Read a survey folder.

    Pictures are not opened but for the size in their first bytes; whether there are enough of them, and
    whether the measurements fit together, is for `calib.survey.check.check_survey`.

    Parameters
    ----------
    folder
        Holds survey.yaml, station.csv, images.csv and, as wanted, dots.csv and clicks.csv.

    Returns
    -------
    Survey
        Its ``digest`` is the SHA-256 over names and contents of these files and of the pictures that
        images.csv names, so it is the same on every machine and changes with every byte.

    Raises
    ------
    BadFile
        For a file that is missing or cannot be read, an unknown key, column or name, a number that is none,
        a row that is there twice, a picture of another size: which file, which place, what would be right.
    """
    return _Reader(Path(folder)).survey()


class _Reader:
    """One reading of a folder; remembers what it read for the digest."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.digests: dict[str, str] = {}

    def survey(self) -> Survey:
        if not self.folder.is_dir():
            raise BadFile(self.folder, "", "is no folder; a survey is a folder with survey.yaml in it")
        path = self.folder / "survey.yaml"
        top = Section(
            path,
            "",
            parse_mapping(self._bytes("survey.yaml", MAX_BYTES), path),
            ("schema", "board", "prisms_in_rover_m", "sigma", "cameras"),
            ("stereo",),
        )
        if top.values["schema"] != SCHEMA:
            raise top.bad("schema", f"{kind_of(top.values['schema'])} where '{SCHEMA}' is expected")
        board = board_of(top.section("board", BOARD_KEYS))
        prisms = places_of(top, "prisms_in_rover_m", "prism")
        cameras = cameras_of(top)
        station = self._station(board, prisms)
        images = self._images(cameras, sorted({point.setup for point in station}))
        by_name = {image.name: image for image in images}
        return Survey(
            folder=self.folder,
            board=board,
            prisms_in_rover_m=prisms,
            sigma=sigma_of(top.section("sigma", ("station_m", "dot_px"), ("joint_rad", "prism_cad_m"))),
            cameras=cameras,
            stereo=read_stereo(top, cameras),
            station=station,
            images=images,
            dots=self._dots(board, cameras, by_name),
            clicks=self._clicks(cameras, by_name, station),
            digest=self._digest(),
        )

    def _bytes(self, name: str, limit_bytes: int) -> bytes:
        path = self.folder / name
        if not path.exists():
            raise BadFile(path, "", "is missing; a survey has survey.yaml, station.csv and images.csv")
        data = read_bytes(path, limit_bytes)
        self.digests[name] = digest_of(data)
        return data

    def _rows(self, name: str, columns: tuple[str, ...], optional: bool = False) -> Iterator[Row]:
        path = self.folder / name
        if optional and not path.exists():
            return iter(())
        return rows_of(self._bytes(name, CSV_MAX_BYTES), path, columns)

    def _some(self, rows: Sequence[object], name: str, what: str) -> None:
        if not rows:
            raise BadFile(
                self.folder / name, "", f"has a header and no rows; one for each of {what} is expected"
            )

    def _station(self, board: Board, prisms: Mapping[str, FloatArray]) -> tuple[StationPoint, ...]:
        points: list[StationPoint] = []
        seen: dict[tuple[str, ...], int] = {}
        for row in self._rows("station.csv", STATION_COLUMNS):
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
            _once(seen, (setup, kind, placement, point), row, f"{name}set-up {setup}")
            position_m = _array(row.numbers(("x_m", "y_m", "z_m"), FURTHEST_M))
            points.append(
                StationPoint(setup, cast(StationKind, kind), placement, point, position_m, row.line)
            )
        self._some(points, "station.csv", "the prisms and tapes that were measured")
        return tuple(points)

    def _images(self, cameras: Mapping[str, SurveyCamera], setups: list[str]) -> tuple[SurveyImage, ...]:
        images: list[SurveyImage] = []
        names: dict[tuple[str, ...], int] = {}
        files: dict[tuple[str, ...], int] = {}
        for row in self._rows("images.csv", IMAGE_COLUMNS):
            name = row.text("image")
            _once(names, (name,), row, f"image {name}")
            camera = cameras[row.choice("camera", tuple(cameras), "camera of survey.yaml")]
            setup = row.choice("setup", setups, "set-up of station.csv")
            purpose = cast(Purpose, row.choice("purpose", ("camera", "mast", "check"), "purpose"))
            placement = row.cells["placement"] if purpose == "check" else row.text("placement")
            pan_rad, tilt_rad = _joints(row, camera)
            file = row.cells["file"]
            if file:
                _once(files, (file,), row, f"file {file}")
                self._check_picture(row, file, camera)
            image = (name, camera.name, setup, placement, purpose, pan_rad, tilt_rad, Path(file), row.line)
            images.append(SurveyImage(*image))
        self._some(images, "images.csv", "the images that were taken")
        return tuple(images)

    def _check_picture(self, row: Row, file: str, camera: SurveyCamera) -> None:
        """Refuse a picture of another size, and note its content; one that is missing is for the check."""
        path = self.folder / file
        try:
            if not path.is_file():
                return
            size_px = picture_size_px(path)
            with path.open("rb") as stream:
                self.digests[file] = hashlib.file_digest(stream, "sha256").hexdigest()
        except (OSError, ValueError) as error:
            raise row.bad("file", f"'{file[:60]}' cannot be read: {error}") from None
        if size_px is not None and size_px != camera.size_px:
            found, wanted = ("x".join(map(str, size)) for size in (size_px, camera.size_px))
            raise row.bad("file", f"{file} is {found} pixels where {camera.name} of survey.yaml has {wanted}")

    def _dots(
        self, board: Board, cameras: Mapping[str, SurveyCamera], images: Mapping[str, SurveyImage]
    ) -> dict[str, Dots]:
        found: dict[str, list[tuple[int, int, float, float]]] = {}
        seen: dict[tuple[str, ...], int] = {}
        for row in self._rows("dots.csv", DOT_COLUMNS, optional=True):
            name = _image(row, images)
            place = row.index("row", board.rows), row.index("column", board.columns)
            _once(seen, (name, *map(str, place)), row, f"dot {place} of image {name}")
            x_px, y_px = _pixel(row, cameras[images[name].camera])
            found.setdefault(name, []).append((*place, x_px, y_px))
        dots: dict[str, Dots] = {}
        for name, places in found.items():
            table = np.array(places, dtype=np.float64)
            indices = table[:, :2].astype(np.int64)
            dots[name] = Dots(indices[:, 0], indices[:, 1], table[:, 2:])
        return dots

    def _clicks(
        self,
        cameras: Mapping[str, SurveyCamera],
        images: Mapping[str, SurveyImage],
        station: tuple[StationPoint, ...],
    ) -> tuple[Click, ...]:
        checks = {(point.setup, point.point) for point in station if point.kind == "check"}
        clicks: list[Click] = []
        seen: dict[tuple[str, ...], int] = {}
        for row in self._rows("clicks.csv", CLICK_COLUMNS, optional=True):
            name, point = _image(row, images), row.text("point")
            setup = images[name].setup
            if (setup, point) not in checks:
                known = sorted(other for where, other in checks if where == setup)
                there = nearest(point, known) if known else "it has none"
                raise row.bad("point", f"'{point[:40]}' is no check point of set-up {setup}; {there}")
            _once(seen, (name, point), row, f"point {point} of image {name}")
            clicks.append(Click(name, point, _array(_pixel(row, cameras[images[name].camera]))))
        return tuple(clicks)

    def _digest(self) -> str:
        listing = "".join(f"{digest}  {name}\n" for name, digest in sorted(self.digests.items()))
        return digest_of(listing.encode("utf-8", "surrogatepass"))


def _joints(row: Row, camera: SurveyCamera) -> tuple[float | None, float | None]:
    """Read pan and tilt: both for a head camera, neither for one on the body."""
    for column in ("pan_rad", "tilt_rad"):
        word = row.cells[column]
        if camera.on == "rover" and word:
            raise row.bad(column, f"'{word[:40]}' where nothing is expected: {camera.name} is on the body")
        if camera.on == "head" and not word:
            raise row.bad(column, f"is empty; {camera.name} is on the head and needs the measured angle")
    if camera.on == "rover":
        return None, None
    return row.number("pan_rad", LARGEST_ANGLE_RAD), row.number("tilt_rad", LARGEST_ANGLE_RAD)


def _image(row: Row, images: Mapping[str, SurveyImage]) -> str:
    name = row.cells["image"]
    return name if name in images else row.choice("image", tuple(images), "image of images.csv")


def _pixel(row: Row, camera: SurveyCamera) -> tuple[float, float]:
    """Read a pixel that must be inside the image."""
    pixel = row.number("x_px", 1e9), row.number("y_px", 1e9)
    for column, value, size in zip(("x_px", "y_px"), pixel, camera.size_px, strict=True):
        if not -0.5 - EDGE_PX <= value <= size - 0.5 + EDGE_PX:
            shape = "x".join(map(str, camera.size_px))
            raise row.bad(column, f"{value:g} is outside the image of {camera.name}, {shape} pixels")
    return pixel


def _once(seen: dict[tuple[str, ...], int], key: tuple[str, ...], row: Row, what: str) -> None:
    """Refuse what is there a second time."""
    if key in seen:
        raise row.bad("", f"{what} is there twice, first on line {seen[key]}")
    seen[key] = row.line


def _array(values: list[float] | tuple[float, float]) -> FloatArray:
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array

"""Read a survey folder strictly: what is wrong is refused with file, and line and column or key.

With a station: survey.yaml, station.csv, images.csv and, as wanted, dots.csv and clicks.csv. A bench has
boards at unknown places, and images.csv and corners.csv; both may be missing, for it grows while it is
measured.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, cast

import numpy as np
from pydantic import AfterValidator, Field, RootModel, model_validator

from calib.errors import BadFile
from calib.files import digest_of, open_plain, read_bytes, text_of
from calib.files.mast_file import CameraName, SensorModeRecord, SizePx, StereoRecord, sensor_mode_of
from calib.files.records import ABSENT, Record, Text, Vector, parse_record, problem
from calib.files.tables import TableRow, check_header, csv_rows
from calib.files.yaml_text import MAX_BYTES, nearest, parse_mapping
from calib.geometry.cahvor import Kind
from calib.geometry.rigid import FloatArray, frozen_array
from calib.survey.records import (
    Approach,
    Click,
    Purpose,
    Sigma,
    StationKind,
    StationPoint,
    Survey,
    SurveyCamera,
    SurveyImage,
)
from calib.targets.board_file import BoardRecord, refuse_larger
from calib.targets.boards import NO_BOARD, AnyBoard, Board, Corners, Dots

SCHEMA = "mastctl/survey/1"

STATION_COLUMNS = ("setup", "kind", "placement", "point", "x_m", "y_m", "z_m")
IMAGE_COLUMNS = ("image", "camera", "setup", "placement", "purpose", "pan_rad", "tilt_rad", "file")
DOT_COLUMNS = ("image", "row", "column", "x_px", "y_px")
CLICK_COLUMNS = ("image", "point", "x_px", "y_px")
BENCH_IMAGE_COLUMNS = ("image", "camera", "placement", "board", "purpose", "pan_rad", "tilt_rad", "file")
APPROACH_COLUMNS = ("pan_approach", "tilt_approach")
CORNER_COLUMNS = ("image", "board", "id", "x_px", "y_px")
SIGMA_COLUMN = "sigma_px"

FURTHEST_M = 1e5
"""Beyond it a number is not a measurement; the check of the survey judges unlikely ones."""

SMALLEST_SIGMA = 1e-9
"""What is stated as exacter, and not as exact, leaves nothing of a float where sigmas are squared."""


def _exact_or_sigma(value: float) -> float:
    if 0.0 < value < SMALLEST_SIGMA:
        raise problem("", f"is {value:g} where 0 or at least {SMALLEST_SIGMA:g} is expected")
    return value


_Metres = Annotated[float, Field(ge=-FURTHEST_M, le=FURTHEST_M)]
_Place = Annotated[list[_Metres], Field(min_length=3, max_length=3)]
_Length = Annotated[float, Field(gt=0.0, le=FURTHEST_M)]
_Sigma = Annotated[float, Field(ge=SMALLEST_SIGMA, le=FURTHEST_M)]
_Uncertainty = Annotated[float, Field(ge=0.0, le=10.0), AfterValidator(_exact_or_sigma)]
_Dots = Annotated[int, Field(ge=2, le=200)]
_Three = Field(json_schema_extra={"minProperties": 3})


def _points(what: str) -> AfterValidator:
    """At least three points that are not on one line."""

    def check(places: dict[str, list[float]]) -> dict[str, list[float]]:
        if len(places) < 3:
            raise problem("", f"{len(places)} {what}s where at least three are expected")
        table = np.array(list(places.values()))
        across = np.linalg.svd(table - table.mean(axis=0), compute_uv=False)
        if across[1] < 1e-3 * max(across[0], 1e-3):
            raise problem("", f"the {what}s stand on one line; no pose follows from them")
        return places

    return AfterValidator(check)


def _frozen(places: Mapping[str, list[float]]) -> dict[str, FloatArray]:
    return {name: frozen_array(place, (3,)) for name, place in places.items()}


class DotGridRecord(Record):
    """The board of a survey with a station."""

    rows: _Dots
    columns: _Dots
    spacing_m: _Length
    dot_diameter_m: _Length
    tapes_in_board_m: Annotated[dict[Text, _Place], _points("tape"), _Three]

    @model_validator(mode="after")
    def _has_room_between_dots(self) -> DotGridRecord:
        refuse_larger(self, "dot_diameter_m", "spacing_m")
        return self


class StationSigmaRecord(Record):
    """Standard deviations, one axis each, of a survey with a station."""

    station_m: _Sigma
    dot_px: _Sigma
    joint_rad: _Uncertainty = 0.0
    prism_cad_m: _Uncertainty = 0.0


class BenchSigmaRecord(Record):
    """Standard deviations, one axis each, of a bench."""

    corner_px: _Sigma
    joint_rad: _Uncertainty = 0.0


class RoughRecord(Record):
    """A rough pose, in the rover frame at the angles of a camera's first image."""

    C: _Place
    A: Vector

    @model_validator(mode="after")
    def _has_a_direction(self) -> RoughRecord:
        if np.linalg.norm(self.A) < 1e-6:
            raise problem("A", "is zero where a direction is expected")
        return self


class SurveyCameraRecord(Record):
    """The prior knowledge of a camera."""

    on: Literal["head", "rover"]
    size_px: SizePx
    model: Kind
    focal_px: _Length
    rough: RoughRecord = Field(default=ABSENT)
    sensor_mode: SensorModeRecord = Field(default=ABSENT)

    def camera(self, name: str, path: Path) -> SurveyCamera:
        """Return the camera of this name; the path is for messages. Raises BadFile."""
        size_px = self.size_px[0], self.size_px[1]
        return SurveyCamera(
            name=name,
            on=self.on,
            size_px=size_px,
            kind=self.model,
            focal_px=self.focal_px,
            rough_C_m=frozen_array(self.rough.C, (3,)) if self.rough else None,
            rough_A=np.array(self.rough.A) / np.linalg.norm(self.rough.A) if self.rough else None,
            sensor_mode=sensor_mode_of(self.sensor_mode, size_px, path, f"cameras.{name}"),
        )


class _SurveyRecord(StereoRecord):
    """The keys of every survey.yaml."""

    schema_: Literal["mastctl/survey/1"] = Field(alias="schema")
    cameras: Annotated[dict[CameraName, SurveyCameraRecord], Field(min_length=1)]


class StationRecord(_SurveyRecord):
    """The survey.yaml of a survey with a station."""

    board: DotGridRecord
    prisms_in_rover_m: Annotated[dict[Text, _Place], _points("prism"), _Three]
    sigma: StationSigmaRecord


class BenchRecord(_SurveyRecord):
    """The survey.yaml of a bench."""

    boards: Annotated[dict[Text, BoardRecord], Field(min_length=1)]
    sigma: BenchSigmaRecord


class SurveyRecord(RootModel[StationRecord | BenchRecord]):
    """A survey.yaml."""


def read_survey(folder: str | Path) -> Survey:
    """Read a survey folder.

    Pictures are read for their size alone; whether there are enough of them, and whether the measurements fit
    together, is for `calib.survey.check.check_survey`. The survey's ``digest`` is the SHA-256 over names and
    contents of the files that were read and of the pictures that images.csv names: the same on every machine,
    another with every byte that changes.

    Raises BadFile for a file that is missing or cannot be read, an unknown key, column or name, an invalid
    number, a double row, an image of another size. The message has the file, the place, and what would be
    right.
    """
    read = SurveyFolder(Path(folder))
    file, data = read.path / "survey.yaml", read.document()
    bench = "boards" in parse_mapping(data, file)
    board, boards, prisms = NO_BOARD, dict[str, AnyBoard](), dict[str, FloatArray]()
    record: BenchRecord | StationRecord
    if bench:
        record = parse_record(BenchRecord, data, file, SCHEMA)
        boards = {name: one.root.board for name, one in record.boards.items()}
        for name in ("station.csv", "dots.csv", "clicks.csv"):
            if (read.path / name).exists():
                reason = "goes with a station, and survey.yaml has boards without one"
                raise BadFile(read.path / name, "", reason)
    else:
        record = parse_record(StationRecord, data, file, SCHEMA)
        prisms, grid = _frozen(record.prisms_in_rover_m), record.board
        tapes = _frozen(grid.tapes_in_board_m)
        board = Board(grid.columns, grid.rows, grid.spacing_m, grid.dot_diameter_m, tapes)
    cameras = {name: camera.camera(name, file) for name, camera in record.cameras.items()}
    sigma = Sigma(**record.sigma.model_dump())
    station = () if bench else _station(read, board, prisms)
    images = _images(read, cameras, boards, sorted({point.setup for point in station}))
    by_name = {image.name: image for image in images}
    return Survey(
        folder=read.path,
        board=board,
        prisms_in_rover_m=prisms,
        sigma=sigma,
        cameras=cameras,
        stereo=record.pairs,
        station=station,
        images=images,
        dots={} if bench else _dots(read, board, cameras, by_name),
        clicks=() if bench else _clicks(read, cameras, by_name, station),
        boards=boards,
        corners=_corners(read, boards, cameras, by_name, sigma.corner_px) if bench else {},
        digest=read.digest(),
    )


class SurveyFolder:
    """One reading of a folder; remembers what it read for the digest, and what may be there only once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._digests: dict[str, str] = {}
        self._places: dict[tuple[object, ...], str] = {}

    def document(self) -> bytes:
        """Return the bytes of survey.yaml."""
        if not self.path.is_dir():
            raise BadFile(self.path, "", "is no folder; a survey is a folder with survey.yaml in it")
        return self._bytes_of("survey.yaml", MAX_BYTES)

    def _bytes_of(self, name: str, limit_bytes: int) -> bytes:
        path = self.path / name
        if not path.exists():
            raise BadFile(path, "", "is missing; a survey has survey.yaml, station.csv and images.csv")
        data = read_bytes(path, limit_bytes)
        self._digests[name] = digest_of(data)
        return data

    def rows(
        self,
        name: str,
        columns: Sequence[str],
        may_be_there: Sequence[str] | None = None,
        required: str = "",
    ) -> Iterator[tuple[int, TableRow]]:
        """Yield the line and the cells of a table's rows; none of one that is not there and not required.

        ``columns`` are exactly these in this order; or, with ``may_be_there``, these and any of those, in any
        order. ``required`` says what the rows are of. Raises BadFile for what is no UTF-8 CSV with such
        columns, a row of another length, or no rows where they are required.
        """
        path = self.path / name
        if not required and not path.exists():
            return
        rows = csv_rows(text_of(self._bytes_of(name, 200_000_000), path), path)
        header = check_header(next(rows, (1, []))[1], path, columns, may_be_there)
        line = 0
        for line, cells in rows:
            if line > 2_000_000:
                raise BadFile(path, "", "has more than 2000000 lines, the most that is read")
            yield line, TableRow(path, f"line {line}", header, cells)
        if required and not line:
            raise BadFile(path, "", f"has a header and no rows; one for each of {required} is expected")

    def once(self, row: TableRow, what: str, *key: object) -> None:
        """Refuse what is in a row's table a second time."""
        place = self._places.setdefault((row.path, *key), row.place)
        if place != row.place:
            raise row.bad("", f"{what} is there twice, first on {place}")

    def check_picture(self, row: TableRow, file: str, camera: SurveyCamera) -> None:
        """Refuse a picture of another size, and note its content; one that is missing is for the check."""
        from calib.files.pictures import picture_size_px  # OpenCV, which numbers do without

        path = self.path / file
        try:
            if not path.is_file():
                return
            with open_plain(path) as stream:
                data = stream.read()
            size_px = picture_size_px(data)
            self._digests[file] = digest_of(data)
        except (OSError, ValueError) as error:
            raise row.bad("file", f"'{file[:60]}' cannot be read: {error}") from None
        if size_px is not None and size_px != camera.size_px:
            found, wanted = ("x".join(map(str, size)) for size in (size_px, camera.size_px))
            raise row.bad("file", f"{file} is {found} pixels where {camera.name} of survey.yaml has {wanted}")

    def digest(self) -> str:
        """Return the SHA-256 over names and contents of all that was read."""
        listing = "".join(f"{digest}  {name}\n" for name, digest in sorted(self._digests.items()))
        return digest_of(listing.encode("utf-8", "surrogatepass"))


def _station(read: SurveyFolder, board: Board, prisms: Mapping[str, FloatArray]) -> tuple[StationPoint, ...]:
    points: list[StationPoint] = []
    known = {"prism": tuple(prisms), "tape": tuple(board.tapes_in_board_m)}
    of_what = "the prisms and tapes that were measured"
    for line, row in read.rows("station.csv", STATION_COLUMNS, required=of_what):
        setup = row.text("setup")
        kind = row.choice("kind", ("prism", "tape", "check"), "kind of point")
        placement = row.text("placement") if kind == "tape" else row.cells["placement"]
        if placement and kind != "tape":
            raise row.bad("placement", f"'{placement[:40]}' where a {kind}'s is empty")
        point = row.text("point")
        if kind in known:
            row.choice("point", known[kind], f"{kind} of survey.yaml")
        where = f"placement {placement} in " if placement else ""
        read.once(row, f"{kind} {point} of {where}set-up {setup}", setup, kind, placement, point)
        position_m = frozen_array([row.number(column, FURTHEST_M) for column in ("x_m", "y_m", "z_m")], (3,))
        points.append(StationPoint(setup, cast(StationKind, kind), placement, point, position_m, line))
    return tuple(points)


def _images(
    read: SurveyFolder,
    cameras: Mapping[str, SurveyCamera],
    boards: Mapping[str, AnyBoard],
    setups: list[str],
) -> tuple[SurveyImage, ...]:
    images: list[SurveyImage] = []
    if boards:
        rows = read.rows("images.csv", BENCH_IMAGE_COLUMNS, ("setup", *APPROACH_COLUMNS))
    else:
        rows = read.rows("images.csv", IMAGE_COLUMNS, required="the images that were taken")
    for line, row in rows:
        name = row.text("image")
        read.once(row, f"image {name}", name)
        camera = cameras[row.choice("camera", tuple(cameras), "camera of survey.yaml")]
        if boards:
            setup = row.cells.get("setup", "")
            board = row.choice("board", tuple(boards), "board of survey.yaml")
        else:
            setup, board = row.choice("setup", setups, "set-up of station.csv"), ""
        purpose = cast(Purpose, row.choice("purpose", ("camera", "mast", "check"), "purpose"))
        unplaced = purpose == "check" and not boards
        placement = row.cells["placement"] if unplaced else row.text("placement")
        pan_rad, tilt_rad = (_joint_rad(row, column, camera) for column in ("pan_rad", "tilt_rad"))
        file = row.cells["file"]
        if file:
            read.once(row, f"board {board} in file {file}" if board else f"file {file}", "file", file, board)
            read.check_picture(row, file, camera)
        images.append(
            SurveyImage(
                name,
                camera.name,
                setup,
                placement,
                purpose,
                pan_rad,
                tilt_rad,
                Path(file),
                line,
                board,
                *(_approach(row, column, camera) for column in APPROACH_COLUMNS),
            )
        )
    return tuple(images)


def _joint_rad(row: TableRow, column: str, camera: SurveyCamera) -> float | None:
    """Read an angle, which a head camera has and one on the body has not."""
    _refuse_on_body(row, column, camera)
    if camera.on == "rover":
        return None
    if not row.cells[column]:
        raise row.bad(column, f"is empty; {camera.name} is on the head and needs the measured angle")
    return row.number(column, 1e4)


def _refuse_on_body(row: TableRow, column: str, camera: SurveyCamera) -> None:
    """Refuse a joint's cell that is not empty for a camera on the body."""
    cell = row.cells.get(column, "")
    if camera.on == "rover" and cell:
        raise row.bad(column, f"'{cell[:40]}' where nothing is expected: {camera.name} is on the body")


def _pixel(row: TableRow, camera: SurveyCamera) -> tuple[float, float]:
    """Read ``x_px`` and ``y_px``, which must be inside the camera's image."""
    pixel = row.number("x_px", 1e9), row.number("y_px", 1e9)
    for column, value, size in zip(("x_px", "y_px"), pixel, camera.size_px, strict=True):
        if not -1.5 <= value <= size + 0.5:  # noise at the border: a pixel beyond it
            shape = "x".join(map(str, camera.size_px))
            raise row.bad(column, f"{value:g} is outside the image of {camera.name}, {shape} pixels")
    return pixel


def _approach(row: TableRow, column: str, camera: SurveyCamera) -> Approach:
    """Read from which side a joint came to rest."""
    cell = row.cells.get(column, "")
    _refuse_on_body(row, column, camera)
    value = row.number(column, 1.0) if cell else 0.0
    if value not in (-1.0, 0.0, 1.0):
        raise row.bad(column, f"{cell[:40]} where -1, 0 or 1 is expected")
    return cast(Approach, int(value))


def _image(row: TableRow, images: Mapping[str, SurveyImage]) -> SurveyImage:
    name = row.cells["image"]
    return images[name if name in images else row.choice("image", tuple(images), "image of images.csv")]


def _corners(
    read: SurveyFolder,
    boards: Mapping[str, AnyBoard],
    cameras: Mapping[str, SurveyCamera],
    images: Mapping[str, SurveyImage],
    corner_px: float,
) -> dict[str, Corners]:
    found: dict[str, list[tuple[float, ...]]] = {}
    counts = {name: len(board.ids) for name, board in boards.items()}
    for _, row in read.rows("corners.csv", CORNER_COLUMNS, (SIGMA_COLUMN,)):
        image = _image(row, images)
        board = row.choice("board", tuple(boards), "board of survey.yaml")
        if board != image.board:
            raise row.bad("board", f"'{board}' where image {image.name} of images.csv shows {image.board}")
        number = row.index("id", counts[board])
        read.once(row, f"corner {number} of image {image.name}", image.name, number)
        pixel, sigma_px = _pixel(row, cameras[image.camera]), corner_px
        if row.cells.get(SIGMA_COLUMN):
            sigma_px = row.number(SIGMA_COLUMN, 100.0)
            if sigma_px <= 0:
                raise row.bad(SIGMA_COLUMN, f"{sigma_px:g} where a number above 0 is expected")
        found.setdefault(image.name, []).append((number, *pixel, sigma_px))
    tables = {name: np.array(rows) for name, rows in found.items()}
    return {name: Corners(t[:, 0].astype(np.int64), t[:, 1:3], t[:, 3]) for name, t in tables.items()}


def _dots(
    read: SurveyFolder, board: Board, cameras: Mapping[str, SurveyCamera], images: Mapping[str, SurveyImage]
) -> dict[str, Dots]:
    found: dict[str, list[tuple[float, ...]]] = {}
    for _, row in read.rows("dots.csv", DOT_COLUMNS):
        image = _image(row, images)
        place = row.index("row", board.rows), row.index("column", board.columns)
        read.once(row, f"dot {place} of image {image.name}", image.name, place)
        found.setdefault(image.name, []).append((*place, *_pixel(row, cameras[image.camera])))
    tables = {name: np.array(rows) for name, rows in found.items()}
    indices = {name: t[:, :2].astype(np.int64) for name, t in tables.items()}
    return {name: Dots(at[:, 0], at[:, 1], tables[name][:, 2:]) for name, at in indices.items()}


def _clicks(
    read: SurveyFolder,
    cameras: Mapping[str, SurveyCamera],
    images: Mapping[str, SurveyImage],
    station: tuple[StationPoint, ...],
) -> tuple[Click, ...]:
    checks = {(point.setup, point.point) for point in station if point.kind == "check"}
    clicks: list[Click] = []
    for _, row in read.rows("clicks.csv", CLICK_COLUMNS):
        image, point = _image(row, images), row.text("point")
        if (image.setup, point) not in checks:
            known = sorted(other for where, other in checks if where == image.setup)
            there = nearest(point, known) if known else "it has none"
            raise row.bad("point", f"'{point[:40]}' is no check point of set-up {image.setup}; {there}")
        read.once(row, f"point {point} of image {image.name}", image.name, point)
        clicks.append(Click(image.name, point, frozen_array(_pixel(row, cameras[image.camera]), (2,))))
    return tuple(clicks)

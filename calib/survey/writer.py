"""Write a survey folder: whole or not at all, and never over another one.

A bench's folder is written at once too, or picture by picture while it is measured.
"""

from __future__ import annotations

import contextlib
import csv
import io
import os
import secrets
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from calib.errors import BadFile
from calib.files.atomic import replace_bytes, sync_folder
from calib.files.mast_file import sensor_mode_keys
from calib.files.yaml_text import dump_mapping
from calib.survey.folder import SCHEMA
from calib.survey.reader import (
    APPROACH_COLUMNS,
    CLICK_COLUMNS,
    CORNER_COLUMNS,
    DOT_COLUMNS,
    IMAGE_COLUMNS,
    SIGMA_COLUMN,
    STATION_COLUMNS,
    read_survey,
)
from calib.survey.records import Sigma, Survey, SurveyCamera, SurveyImage
from calib.targets.board_file import document_of
from calib.targets.boards import NO_BOARD, AnyBoard, Corners

BENCH_TABLE_COLUMNS = (
    *("image", "camera", "setup", "placement", "board", "purpose", "pan_rad", "tilt_rad"),
    *APPROACH_COLUMNS,
    "file",
)


class NotWritten(BadFile):
    """The file system refuses, as a full disk does; everything written before is whole."""


class BenchFolder:
    """A bench's folder that grows by one image at a time.

    After a kill or a power cut at any moment `calib.survey.read_survey` reads the folder. An image in
    images.csv has its file, and all of its corners or none of them.

    Parameters
    ----------
    path
        A folder that holds no survey yet (it is made where it is missing), or that of a bench with the same
        boards, sigmas and cameras, which goes on.
    boards, sigma, cameras, stereo
        As of `calib.survey.Survey`.

    Raises
    ------
    BadFile
        If the folder holds another survey, or something that is none, or the file system refuses.
    """

    def __init__(
        self,
        path: str | Path,
        boards: Mapping[str, AnyBoard],
        sigma: Sigma,
        cameras: Mapping[str, SurveyCamera],
        stereo: Mapping[str, tuple[str, str]],
    ) -> None:
        self.path = Path(path)
        header = Survey(self.path, NO_BOARD, {}, sigma, cameras, stereo, (), (), {}, boards=boards)
        wanted = dump_mapping(bench_document(header))
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            there = self.path / "survey.yaml"
            if not there.exists():
                if (self.path / "images.csv").exists():
                    raise BadFile(
                        self.path, "", "has an images.csv and no survey.yaml; an empty folder is expected"
                    )
                replace_bytes(there, wanted, 0o644)
        except OSError as error:
            raise NotWritten(self.path, "", f"cannot be written: {error.strerror or error}") from None
        survey = read_survey(self.path)
        place, words = _other(bench_document(survey), bench_document(_as_known(header, survey)))
        if words:
            raise BadFile(there, place, f"{words}; another folder (--survey) is expected")
        self._images = list(survey.images)
        self._corners = dict(survey.corners)

    def survey(self) -> Survey:
        """Return what a reader finds. Raises BadFile."""
        return read_survey(self.path)

    def append(self, image: SurveyImage, corners: Corners | None, picture: bytes | None = None) -> None:
        """Add an image; when this returns it is on the disk.

        The picture goes first, then the image's row, then its corners.

        Parameters
        ----------
        image
            Of a name that is not there yet; its ``row`` does not count.
        corners
            The corners found in it; None or empty where there were none.
        picture
            The bytes of ``image.file``, PNG or JPEG; None where it is there already, or there is none.

        Raises
        ------
        BadFile
            If the name is there already, the picture lies outside the folder, or the file system refuses; the
            folder is then readable still.
        """
        if any(other.name == image.name for other in self._images):
            raise BadFile(self.path / "images.csv", "", f"has an image {image.name} already")
        images = [*self._images, replace(image, row=len(self._images) + 2)]
        try:
            if picture is not None:
                self._write_picture(image.file, picture)
            replace_bytes(self.path / "images.csv", images_table(images), 0o644)
            self._images = images
            if corners is not None and len(corners):
                found = {**self._corners, image.name: corners}
                replace_bytes(self.path / "corners.csv", corners_table(images, found), 0o644)
                self._corners = found
        except OSError as error:
            raise NotWritten(self.path, image.name, f"cannot be written: {error.strerror or error}") from None

    def _write_picture(self, file: Path, picture: bytes) -> None:
        path = self.path / file
        if self.path not in path.parents or ".." in file.parts:
            raise BadFile(self.path, str(file), "the picture lies outside the folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_bytes(path, picture, 0o644)


def _as_known(header: Survey, there: Survey) -> Survey:
    """The header, with sensor modes as a folder has them where either does not know one."""
    cameras = {}
    for name, camera in header.cameras.items():
        kept = there.cameras[name].sensor_mode if name in there.cameras else camera.sensor_mode
        known = kept is not None and camera.sensor_mode is not None
        cameras[name] = camera if known else replace(camera, sensor_mode=kept)
    return replace(header, cameras=cameras)


def _other(there: Any, wanted: Any, place: str = "") -> tuple[str, str]:
    """Where two documents first differ, and how in words; empty where they do not."""
    if isinstance(there, Mapping) and isinstance(wanted, Mapping):
        for key in [*there, *(key for key in wanted if key not in there)]:
            at = f"{place}.{key}" if place else str(key)
            if key not in wanted:
                return at, "is in the folder, and is not asked for now"
            if key not in there:
                return at, "is asked for now, and is not in the folder"
            found = _other(there[key], wanted[key], at)
            if found[1]:
                return found
        return "", ""
    if isinstance(there, (list, tuple)) and isinstance(wanted, (list, tuple)):
        return (
            (place, "")
            if list(there) == list(wanted)
            else (place, f"is {there!r}, now it would be {wanted!r}")
        )
    return (place, "") if there == wanted else (place, f"is {there!r}, now it would be {wanted!r}")


def bench_files(survey: Survey) -> list[tuple[str, bytes]]:
    """Return the names and bytes of a bench's text files."""
    files = [
        ("survey.yaml", dump_mapping(bench_document(survey))),
        ("images.csv", images_table(survey.images)),
    ]
    if survey.corners:
        files.append(("corners.csv", corners_table(survey.images, survey.corners)))
    return files


def bench_document(survey: Survey) -> dict[str, Any]:
    """Return what survey.yaml of a bench holds."""
    return {
        "schema": SCHEMA,
        "boards": {name: document_of(board) for name, board in survey.boards.items()},
        "sigma": {"corner_px": survey.sigma.corner_px, "joint_rad": survey.sigma.joint_rad},
        "cameras": {name: camera_document(camera) for name, camera in survey.cameras.items()},
        "stereo": survey.stereo,
    }


def camera_document(camera: SurveyCamera) -> dict[str, Any]:
    """Return what survey.yaml holds of a camera."""
    document: dict[str, Any] = {
        "on": camera.on,
        "size_px": list(camera.size_px),
        "model": camera.kind,
        "focal_px": float(camera.focal_px),
    }
    if camera.rough_C_m is not None and camera.rough_A is not None:
        document["rough"] = {"C": camera.rough_C_m, "A": camera.rough_A}
    return document | sensor_mode_keys(camera.sensor_mode)


def images_table(images: Iterable[SurveyImage]) -> bytes:
    """Return the bytes of a bench's images.csv."""
    return table(
        BENCH_TABLE_COLUMNS,
        [
            (
                *(i.name, i.camera, i.setup, i.placement, i.board, i.purpose),
                *joint_cells(i.pan_rad, i.tilt_rad),
                *(("", "") if i.pan_rad is None else (str(i.pan_approach), str(i.tilt_approach))),
                file_cell(i.file),
            )
            for i in images
        ],
    )


def corners_table(images: Iterable[SurveyImage], corners: Mapping[str, Corners]) -> bytes:
    """Return the bytes of corners.csv, images in their order."""
    rows: list[Sequence[str]] = []
    for image in images:
        if image.name in corners:
            found = corners[image.name]
            for number, (x_px, y_px), sigma_px in zip(
                found.ids.tolist(), found.pixels_px.tolist(), found.sigma_px.tolist(), strict=True
            ):
                rows.append((image.name, image.board, str(number), repr(x_px), repr(y_px), repr(sigma_px)))
    return table((*CORNER_COLUMNS, SIGMA_COLUMN), rows)


def joint_cells(pan_rad: float | None, tilt_rad: float | None) -> list[str]:
    """Return the cells of two angles, empty where there are none."""
    return ["" if angle is None else repr(float(angle)) for angle in (pan_rad, tilt_rad)]


def file_cell(path: Path) -> str:
    """Return the cell of a picture's name, empty where there is none."""
    return "" if path == Path() else path.as_posix()


def table(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> bytes:
    """Return a CSV file's bytes."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue().encode()


def write_survey(survey: Survey, folder: str | Path, pictures: Iterable[tuple[str, bytes]] = ()) -> Survey:
    """Write a survey as a new folder and return what a reader finds there.

    Everything is written beside the folder, read back, and then renamed into place. dots.csv and clicks.csv
    are left out where the survey has none. A sigma of single dots is not written: the format has no place.

    Parameters
    ----------
    folder
        Must not exist, or be empty.
    pictures
        File names, as the survey's images name them, with the bytes of the PNG or JPEG.

    Raises
    ------
    BadFile
        If the folder holds something, the survey is none that a reader takes, or the file system refuses;
        then nothing is left behind.
    """
    try:
        target = Path(folder).resolve()
        if target.exists() and (not target.is_dir() or any(target.iterdir())):
            raise BadFile(folder, "", "is there already and not empty; a survey is never written over")
        target.parent.mkdir(parents=True, exist_ok=True)
        new = target.with_name(f".{target.name}.{secrets.token_hex(4)}.new")
        new.mkdir()
    except (OSError, ValueError) as error:
        raise BadFile(folder, "", f"cannot be written: {error}") from None
    try:
        for name, data in _files(survey):
            _write(new / name, data)
        for name, data in pictures:
            path = new / name
            if new not in path.parents or ".." in path.parts:
                raise BadFile(folder, name, "the picture lies outside the folder")
            path.parent.mkdir(parents=True, exist_ok=True)
            _write(path, data)
        _check(new, target)
        sync_folder(new)
        new.replace(target)
        sync_folder(target.parent)
    except OSError as error:
        raise BadFile(folder, "", f"cannot be written: {error.strerror or error}") from None
    finally:
        with contextlib.suppress(OSError):
            shutil.rmtree(new)
    return read_survey(folder)


def _check(new: Path, target: Path) -> None:
    """Read back what was written; a refusal names the file as it would have been called."""
    try:
        read_survey(new)
    except BadFile as error:
        raise BadFile(target / error.path.relative_to(new), error.place, error.reason) from None


def _files(survey: Survey) -> list[tuple[str, bytes]]:
    """Return the text files' names and bytes."""
    if survey.boards:
        return bench_files(survey)
    station: list[Sequence[Any]] = [
        (p.setup, p.kind, p.placement, p.point, *_floats(p.position_m)) for p in survey.station
    ]
    images: list[Sequence[Any]] = [
        (
            i.name,
            i.camera,
            i.setup,
            i.placement,
            i.purpose,
            *joint_cells(i.pan_rad, i.tilt_rad),
            file_cell(i.file),
        )
        for i in survey.images
    ]
    dots: list[Sequence[Any]] = [
        (name, int(row), int(column), *_floats(pixel))
        for name, found in survey.dots.items()
        for row, column, pixel in zip(found.rows, found.columns, found.pixels_px, strict=True)
    ]
    clicks: list[Sequence[Any]] = [(c.image, c.point, *_floats(c.pixel_px)) for c in survey.clicks]
    files = [
        ("survey.yaml", dump_mapping(_document(survey))),
        ("station.csv", table(STATION_COLUMNS, station)),
        ("images.csv", table(IMAGE_COLUMNS, images)),
    ]
    if dots:
        files.append(("dots.csv", table(DOT_COLUMNS, dots)))
    if clicks:
        files.append(("clicks.csv", table(CLICK_COLUMNS, clicks)))
    return files


def _document(survey: Survey) -> dict[str, Any]:
    board, sigma = survey.board, survey.sigma
    return {
        "schema": SCHEMA,
        "board": {
            "rows": board.rows,
            "columns": board.columns,
            "spacing_m": board.spacing_m,
            "dot_diameter_m": board.dot_diameter_m,
            "tapes_in_board_m": board.tapes_in_board_m,
        },
        "prisms_in_rover_m": survey.prisms_in_rover_m,
        "sigma": {
            "station_m": sigma.station_m,
            "dot_px": sigma.dot_px,
            "joint_rad": sigma.joint_rad,
            "prism_cad_m": sigma.prism_cad_m,
        },
        "cameras": {name: camera_document(camera) for name, camera in survey.cameras.items()},
        "stereo": survey.stereo,
    }


def _floats(values: Iterable[Any]) -> list[str]:
    return [repr(float(value)) for value in values]


def _write(path: Path, data: bytes) -> None:
    with path.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())

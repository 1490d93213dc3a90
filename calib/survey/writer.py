"""Write a survey folder: whole or not at all, and never over another one.

A bench's folder is written at once too, or picture by picture while it is measured.
"""

from __future__ import annotations

import contextlib
import io
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from calib.errors import BadFile
from calib.files import replace_bytes, sync_folder, write_new
from calib.files.mast_file import sensor_mode_keys
from calib.files.tables import write_rows
from calib.files.yaml_text import dump_mapping, plain
from calib.survey.reader import (
    APPROACH_COLUMNS,
    CLICK_COLUMNS,
    CORNER_COLUMNS,
    DOT_COLUMNS,
    IMAGE_COLUMNS,
    SCHEMA,
    SIGMA_COLUMN,
    STATION_COLUMNS,
    DotGridRecord,
    read_survey,
)
from calib.survey.records import Sigma, Survey, SurveyCamera, SurveyImage
from calib.targets.board_file import document_of
from calib.targets.boards import NO_BOARD, AnyBoard, Corners

BENCH_TABLE_COLUMNS = (*IMAGE_COLUMNS[:4], "board", *IMAGE_COLUMNS[4:7], *APPROACH_COLUMNS, "file")

_IMAGE_CELLS: Mapping[str, Callable[[SurveyImage], object]] = {
    "image": lambda i: i.name,
    "camera": lambda i: i.camera,
    "setup": lambda i: i.setup,
    "placement": lambda i: i.placement,
    "board": lambda i: i.board,
    "purpose": lambda i: i.purpose,
    "pan_rad": lambda i: None if i.pan_rad is None else float(i.pan_rad),
    "tilt_rad": lambda i: None if i.tilt_rad is None else float(i.tilt_rad),
    "pan_approach": lambda i: None if i.pan_rad is None else i.pan_approach,
    "tilt_approach": lambda i: None if i.pan_rad is None else i.tilt_approach,
    "file": lambda i: "" if i.file == Path() else i.file.as_posix(),
}


class NotWritten(BadFile):
    """The file system refuses, as a full disk does; everything written before is whole."""


class BenchFolder:
    """A bench's folder that grows by one image at a time.

    After a kill or a power cut at any moment `calib.survey.reader.read_survey` reads the folder. An image in
    images.csv has its file, and all of its corners or none of them. The folder holds no survey yet (it is
    made where it is missing), or that of a bench with the same boards, sigmas and cameras, which goes on.

    Raises BadFile if the folder holds another survey, or something that is none, or the file system refuses.
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
        file = self.path / "survey.yaml"
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            if not file.exists():
                if (self.path / "images.csv").exists():
                    reason = "has an images.csv and no survey.yaml; an empty folder is expected"
                    raise BadFile(self.path, "", reason)
                replace_bytes(file, dump_mapping(_document(header)), 0o644)
        except OSError as error:
            raise NotWritten(self.path, "", f"cannot be written: {error.strerror or error}") from None
        stored = read_survey(self.path)
        before, now = (dict(_leaves(plain(_document(one)))) for one in (stored, header))
        both = [*stored.cameras.values(), *cameras.values()]
        unknown = {camera.name for camera in both if camera.sensor_mode is None}  # and so no other
        for place in [*before, *now]:
            if ".sensor_mode" in place and place.split(".")[1] in unknown:
                continue
            if place not in before or place not in now or before[place] != now[place]:
                was, wanted = (repr(one[place]) if place in one else "missing" for one in (before, now))
                reason = f"is {was}, now it would be {wanted}; another folder is expected"
                raise BadFile(file, place, reason)
        self._images = list(stored.images)
        self._corners = dict(stored.corners)

    def survey(self) -> Survey:
        """Return what a reader finds. Raises BadFile."""
        return read_survey(self.path)

    def append(self, image: SurveyImage, corners: Corners | None, picture: bytes | None = None) -> None:
        """Add an image of a new name; when this returns it is on the disk.

        The picture goes first (PNG or JPEG; None where it is there already, or there is none), then the
        image's row, then its corners. Raises BadFile if the name is there already, the picture lies outside
        the folder, or the file system refuses; the folder is then readable still.
        """
        if any(other.name == image.name for other in self._images):
            raise BadFile(self.path / "images.csv", "", f"has an image {image.name} already")
        images = [*self._images, replace(image, row=len(self._images) + 2)]
        try:
            if picture is not None:
                replace_bytes(_picture_path(self.path, image.file, self.path), picture, 0o644)
            replace_bytes(self.path / "images.csv", _images_table(images, BENCH_TABLE_COLUMNS), 0o644)
            self._images = images
            if corners is not None and len(corners):
                found = {**self._corners, image.name: corners}
                replace_bytes(self.path / "corners.csv", _corners_table(images, found), 0o644)
                self._corners = found
        except OSError as error:
            raise NotWritten(self.path, image.name, f"cannot be written: {error.strerror or error}") from None


def _leaves(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each value of a document with its key path; lists are one value."""
    if not isinstance(value, Mapping):
        yield place, value
        return
    for key, inner in value.items():
        yield from _leaves(inner, f"{place}.{key}" if place else key)


def write_survey(survey: Survey, folder: str | Path, pictures: Iterable[tuple[str, bytes]] = ()) -> Survey:
    """Write a survey as a new folder, or into an empty one, and return what a reader finds there.

    Everything is written beside the folder, read back, and then renamed into place. Tables without rows are
    left out. A sigma of single dots is not written: the format has no place. ``pictures`` are file names, as
    the survey's images name them, with the bytes of the PNG or JPEG.

    Raises BadFile if the folder holds something, the survey is none that a reader takes, or the file system
    refuses; then nothing is left behind.
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
        for name, data in _files(survey).items():
            write_new(new / name, data)
        for name, data in pictures:
            write_new(_picture_path(new, Path(name), folder), data)
        try:
            read_survey(new)
        except BadFile as error:  # which names the file as it would have been called
            raise BadFile(target / error.path.relative_to(new), error.place, error.reason) from None
        sync_folder(new)
        new.replace(target)
        sync_folder(target.parent)
    except OSError as error:
        raise BadFile(folder, "", f"cannot be written: {error.strerror or error}") from None
    finally:
        with contextlib.suppress(OSError):
            shutil.rmtree(new)
    return read_survey(folder)


def _picture_path(folder: Path, file: Path, named: str | Path) -> Path:
    """Return where a picture goes, its folder made; ``named`` is what a refusal calls the survey's."""
    path = folder / file
    if folder not in path.parents or ".." in file.parts:
        raise BadFile(named, str(file), "the picture lies outside the folder")
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _files(survey: Survey) -> dict[str, bytes]:
    """Return the text files' bytes by name."""
    files = {"survey.yaml": dump_mapping(_document(survey))}
    if survey.boards:
        files["images.csv"] = _images_table(survey.images, BENCH_TABLE_COLUMNS)
        if survey.corners:
            files["corners.csv"] = _corners_table(survey.images, survey.corners)
        return files
    files["images.csv"] = _images_table(survey.images, IMAGE_COLUMNS)
    station = [(p.setup, p.kind, p.placement, p.point, *p.position_m.tolist()) for p in survey.station]
    files["station.csv"] = _table(STATION_COLUMNS, station)
    if survey.dots:
        dots = [
            (name, int(row), int(column), *pixel.tolist())
            for name, found in survey.dots.items()
            for row, column, pixel in zip(found.rows, found.columns, found.pixels_px, strict=True)
        ]
        files["dots.csv"] = _table(DOT_COLUMNS, dots)
    if survey.clicks:
        clicks = [(c.image, c.point, *c.pixel_px.tolist()) for c in survey.clicks]
        files["clicks.csv"] = _table(CLICK_COLUMNS, clicks)
    return files


def _document(survey: Survey) -> dict[str, Any]:
    """Return what survey.yaml holds."""
    sigma, board = survey.sigma, survey.board
    document: dict[str, Any] = {"schema": SCHEMA}
    if survey.boards:
        document["boards"] = {name: document_of(one) for name, one in survey.boards.items()}
        document["sigma"] = {"corner_px": sigma.corner_px, "joint_rad": sigma.joint_rad}
    else:
        document["board"] = {name: getattr(board, name) for name in DotGridRecord.model_fields}
        document["prisms_in_rover_m"] = survey.prisms_in_rover_m
        document["sigma"] = {key: value for key, value in vars(sigma).items() if key != "corner_px"}
    document["cameras"] = {name: _camera_document(camera) for name, camera in survey.cameras.items()}
    return document | {"stereo": survey.stereo}


def _camera_document(camera: SurveyCamera) -> dict[str, Any]:
    document: dict[str, Any] = {
        "on": camera.on,
        "size_px": list(camera.size_px),
        "model": camera.kind,
        "focal_px": float(camera.focal_px),
    }
    if camera.rough_C_m is not None and camera.rough_A is not None:
        document["rough"] = {"C": camera.rough_C_m, "A": camera.rough_A}
    return document | sensor_mode_keys(camera.sensor_mode)


def _images_table(images: Iterable[SurveyImage], columns: Sequence[str]) -> bytes:
    return _table(columns, ([_IMAGE_CELLS[column](image) for column in columns] for image in images))


def _corners_table(images: Iterable[SurveyImage], corners: Mapping[str, Corners]) -> bytes:
    """Return the bytes of corners.csv, images in their order."""
    rows = (
        (image.name, image.board, number, *pixel, sigma_px)
        for image in images
        if (found := corners.get(image.name)) is not None
        for number, pixel, sigma_px in zip(
            found.ids.tolist(), found.pixels_px.tolist(), found.sigma_px.tolist(), strict=True
        )
    )
    return _table((*CORNER_COLUMNS, SIGMA_COLUMN), rows)


def _table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> bytes:
    text = io.StringIO()
    write_rows(text, columns, rows)
    return text.getvalue().encode()

"""Write a survey folder (contract section 2): whole or not at all, and never over another one."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from calib.errors import BadFile
from calib.files.atomic import sync_folder
from calib.files.yaml_text import dump_mapping
from calib.survey.bench_writer import bench_files, camera_document, file_cell, joint_cells, table
from calib.survey.folder import SCHEMA
from calib.survey.reader import CLICK_COLUMNS, DOT_COLUMNS, IMAGE_COLUMNS, STATION_COLUMNS, read_survey
from calib.survey.records import Survey


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

"""What every survey folder is read with: files' bytes and digests, and cells that several tables have."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from calib.errors import BadFile
from calib.files import digest_of, read_bytes
from calib.files.yaml_text import MAX_BYTES, parse_mapping
from calib.rigid import FloatArray
from calib.survey.picture_file import picture_size_px
from calib.survey.records import SurveyCamera, SurveyImage
from calib.survey.rows import Row, rows_of

SCHEMA = "mastctl/survey/1"

CSV_MAX_BYTES = 200_000_000

LARGEST_ANGLE_RAD = 1e4
"""Beyond these a number is no measurement; what is merely unlikely is for the check of the survey."""

EDGE_PX = 1.0
"""How far outside its image a dot or corner may have been found: noise at the border."""


class Folder:
    """One reading of a folder; remembers what it read for the digest.

    Parameters
    ----------
    path
        The folder.
    files
        Names of the files that must be there, for the refusal.
    """

    def __init__(self, path: Path, files: str = "survey.yaml, station.csv and images.csv") -> None:
        self.path, self.files = path, files
        self.digests: dict[str, str] = {}

    def document(self) -> dict[str, object]:
        """Return what survey.yaml holds."""
        if not self.path.is_dir():
            raise BadFile(self.path, "", "is no folder; a survey is a folder with survey.yaml in it")
        return parse_mapping(self.bytes_of("survey.yaml", MAX_BYTES), self.path / "survey.yaml")

    def bytes_of(self, name: str, limit_bytes: int) -> bytes:
        """Return a file's bytes. Raises BadFile."""
        path = self.path / name
        if not path.exists():
            raise BadFile(path, "", f"is missing; a survey has {self.files}")
        data = read_bytes(path, limit_bytes)
        self.digests[name] = digest_of(data)
        return data

    def rows(
        self,
        name: str,
        columns: Sequence[str],
        may_be_there: Sequence[str] | None = None,
        optional: bool = False,
    ) -> Iterator[Row]:
        """Yield a table's rows, as `rows_of` does; none of an optional file that is not there."""
        path = self.path / name
        if optional and not path.exists():
            return iter(())
        return rows_of(self.bytes_of(name, CSV_MAX_BYTES), path, columns, may_be_there)

    def some(self, rows: Sequence[object], name: str, what: str) -> None:
        """Refuse a table without rows."""
        if not rows:
            raise BadFile(
                self.path / name, "", f"has a header and no rows; one for each of {what} is expected"
            )

    def check_picture(self, row: Row, file: str, camera: SurveyCamera) -> None:
        """Refuse a picture of another size, and note its content; one that is missing is for the check."""
        path = self.path / file
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

    def digest(self) -> str:
        """Return the SHA-256 over names and contents of all that was read."""
        listing = "".join(f"{digest}  {name}\n" for name, digest in sorted(self.digests.items()))
        return digest_of(listing.encode("utf-8", "surrogatepass"))


def joints_of(row: Row, camera: SurveyCamera) -> tuple[float | None, float | None]:
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


def image_of(row: Row, images: Mapping[str, SurveyImage]) -> str:
    name = row.cells["image"]
    return name if name in images else row.choice("image", tuple(images), "image of images.csv")


def pixel_of(row: Row, camera: SurveyCamera) -> tuple[float, float]:
    """Read a pixel that must be inside the image."""
    pixel = row.number("x_px", 1e9), row.number("y_px", 1e9)
    for column, value, size in zip(("x_px", "y_px"), pixel, camera.size_px, strict=True):
        if not -0.5 - EDGE_PX <= value <= size - 0.5 + EDGE_PX:
            shape = "x".join(map(str, camera.size_px))
            raise row.bad(column, f"{value:g} is outside the image of {camera.name}, {shape} pixels")
    return pixel


def once(seen: dict[tuple[str, ...], int], key: tuple[str, ...], row: Row, what: str) -> None:
    """Refuse what is there a second time."""
    if key in seen:
        raise row.bad("", f"{what} is there twice, first on line {seen[key]}")
    seen[key] = row.line


def array_of(values: list[float] | tuple[float, float]) -> FloatArray:
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array

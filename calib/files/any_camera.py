"""One camera out of a file of any known format: told by content, written by suffix."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from calib.errors import BadFile
from calib.files import CameraFile, read_bytes
from calib.files.cahvor_text import looks_like_cahvor, parse_cahvor, save_cahvor
from calib.files.mast_file import (
    CAMERA_SCHEMA,
    MAST_SCHEMA,
    StoredRig,
    parse_camera,
    parse_rig,
    save_camera,
    schema_of,
)
from calib.files.pds3 import load_pds3_camera, looks_like_pds3
from calib.files.pds3_image import MAX_FILE_BYTES

KNOWN_FORMATS = "a mast file, a camera file, a .cahvor file or a PDS3 label"


def load_any(path: str | Path) -> StoredRig | CameraFile:
    """Read a mast file, or the one camera of a camera file, .cahvor file or PDS3 label.

    The content tells the format. Where it tells nothing the suffix says which format's refusal helps most.

    Raises
    ------
    BadFile
        If the file is none of these, or is one but malformed.
    """
    data = read_bytes(path, MAX_FILE_BYTES)
    suffix = Path(path).suffix.lower()
    if looks_like_pds3(data) or suffix in (".lbl", ".img"):
        return load_pds3_camera(path)
    schema = schema_of(data)
    if schema == CAMERA_SCHEMA:
        return parse_camera(data, path)
    if schema == MAST_SCHEMA or suffix in (".yaml", ".yml"):
        return parse_rig(data, path)
    if suffix == ".cahvor" or looks_like_cahvor(data):
        return parse_cahvor(data, path)
    raise BadFile(path, "", f"is not {KNOWN_FORMATS}")


@dataclass(frozen=True)
class Conversion:
    """What a conversion wrote: where, in which format, and what the format could not hold."""

    path: Path
    format: str
    lost: tuple[str, ...]


def save_any(camera: CameraFile, path: str | Path) -> Conversion:
    """Save a camera as .yaml (a camera file) or .cahvor, whichever the suffix says.

    Raises
    ------
    BadFile
        If the suffix is another, or the file cannot be saved.
    """
    suffix = Path(path).suffix.lower()
    if suffix in (".yaml", ".yml"):
        save_camera(camera, path)
        return Conversion(Path(path), CAMERA_SCHEMA, ())
    if suffix == ".cahvor":
        return Conversion(Path(path), "cahvor", save_cahvor(camera, path))
    raise BadFile(path, "", f"suffix '{suffix}' where .yaml or .cahvor is expected")

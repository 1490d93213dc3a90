"""PDS3 products: a label, attached to its image or detached, with camera model, mast angles and image.

Names in the labels of MER and MSL. A camera is group ``GEOMETRIC_CAMERA_MODEL`` (MSL: ``..._PARMS``) with
MODEL_TYPE and MODEL_COMPONENT_1..9 (C A H V O R E, then T = type and P = linearity). The mast is group
``PMA_ARTICULATION_STATE`` (MER) or ``RSM_ARTICULATION_STATE_PARMS`` (MSL) with ``AZIMUTH-MEASURED`` and
``ELEVATION-MEASURED`` among its angle names. Only MEASURED angles go with the camera model of a label:
REQUESTED and FINAL differ by milliradians.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from calib.errors import BadFile
from calib.files import LARGEST_IMAGE_PX, CameraFile, build_model, digest_of, read_bytes
from calib.files.odl import LabelBlock, Quantity, integer_in, number_in, parse_label, vector_in
from calib.geometry.cahvor import CameraModel, Kind

MAX_FILE_BYTES = 1 << 30

_SAMPLES = {
    **dict.fromkeys(("MSB_INTEGER", "INTEGER", "SUN_INTEGER", "MAC_INTEGER"), ">i"),
    **dict.fromkeys(("MSB_UNSIGNED_INTEGER", "UNSIGNED_INTEGER", "SUN_UNSIGNED_INTEGER"), ">u"),
    **dict.fromkeys(("LSB_INTEGER", "PC_INTEGER", "VAX_INTEGER"), "<i"),
    **dict.fromkeys(("LSB_UNSIGNED_INTEGER", "PC_UNSIGNED_INTEGER", "VAX_UNSIGNED_INTEGER"), "<u"),
    **dict.fromkeys(("IEEE_REAL", "FLOAT", "REAL", "SUN_REAL", "MAC_REAL"), ">f"),
    "PC_REAL": "<f",
}
_BITS = {"i": (8, 16, 32), "u": (8, 16, 32), "f": (32, 64)}


def read_pixels(
    path: Path, root: LabelBlock, block: LabelBlock, data: bytes, size_px: tuple[int, int]
) -> tuple[NDArray[Any] | None, tuple[str, ...]]:
    """Return the pixels that a label points to, and notes.

    Parameters
    ----------
    path, data
        The file that begins with the label, and its bytes.
    root, block
        The label, and its IMAGE object.
    size_px
        (width, height) of the image.

    Returns
    -------
    pixels
        (height, width) in the machine's byte order; None, with a note, if the image's file is not there.
    notes
        Sentences for the user.

    Raises
    ------
    BadFile
        If the samples are of a kind that is not read, the pointer is malformed, or the file is too short.
    """
    width, height = size_px
    code = _SAMPLES.get(str(block.values.get("SAMPLE_TYPE")))
    if code is None:
        found = str(block.values.get("SAMPLE_TYPE", "nothing"))[:40]
        raise BadFile(path, "IMAGE.SAMPLE_TYPE", f"{found} where one of {', '.join(_SAMPLES)} is expected")
    bits = integer_in(block, "SAMPLE_BITS", path, 1, 64)
    if bits not in _BITS[code[1]]:
        raise BadFile(path, "IMAGE.SAMPLE_BITS", f"{bits} where one of {_BITS[code[1]]} is expected")
    if "BANDS" in block.values and integer_in(block, "BANDS", path, 1, 10**6) != 1:
        raise BadFile(path, "IMAGE.BANDS", f"{block.values['BANDS']} where 1 is expected")
    if str(block.values.get("ENCODING_TYPE", "N/A")) not in ("N/A", "NONE"):
        raise BadFile(path, "IMAGE.ENCODING_TYPE", "compressed pixels; plain samples are expected")
    before, after = (
        integer_in(block, key, path, 0, 1 << 20) if key in block.values else 0
        for key in ("LINE_PREFIX_BYTES", "LINE_SUFFIX_BYTES")
    )
    name, offset = _pointer(path, root)
    source = path
    if name:
        beside = _beside(path, name)
        if beside is None:
            return None, (f"{name} is not beside the label; there is no image",)
        source, data = beside, read_bytes(beside, MAX_FILE_BYTES)
    line_bytes = before + width * bits // 8 + after
    if offset + height * line_bytes > len(data):
        raise BadFile(
            source, "IMAGE", f"{len(data)} bytes where at least {offset + height * line_bytes} are expected"
        )
    lines = np.frombuffer(data, np.uint8, height * line_bytes, offset).reshape(height, line_bytes)
    pixels = np.ascontiguousarray(lines[:, before : before + width * bits // 8])
    dtype = np.dtype(f"{code}{bits // 8}")
    return pixels.view(dtype).astype(dtype.newbyteorder("=")), ()


def _pointer(path: Path, root: LabelBlock) -> tuple[str, int]:
    """Return where ^IMAGE points: a file's name ('' for the label's own file) and a byte offset."""
    pointer = root.values.get("^IMAGE")
    items = list(pointer) if isinstance(pointer, tuple) and not isinstance(pointer, Quantity) else [pointer]
    name = str(items.pop(0)) if items and isinstance(items[0], str) else ""
    where = items[0] if items else 1
    if len(items) > 1 or (name and not re.fullmatch(r"[\w.+-]+", name)):
        raise BadFile(path, "^IMAGE", "a record, or a file beside the label with a record, is expected")
    if (
        isinstance(where, Quantity)
        and where.unit.upper() in ("BYTES", "BYTE")
        and isinstance(where.value, int)
    ):
        start, unit_bytes = where.value, 1
    elif isinstance(where, int) and not isinstance(where, Quantity):
        start = where
        unit_bytes = 1 if start == 1 else integer_in(root, "RECORD_BYTES", path, 1, 1 << 24)
    else:
        raise BadFile(path, "^IMAGE", "a record number or a number <BYTES> is expected")
    if not 1 <= start <= 1 << 40:
        raise BadFile(path, "^IMAGE", f"{start} where a record from 1 on is expected")
    return name, (start - 1) * unit_bytes


def _beside(path: Path, name: str) -> Path | None:
    """Return the file of that name beside the label, in whichever case it is written."""
    for candidate in (name, name.lower(), name.upper()):
        if (path.parent / candidate).is_file():
            return path.parent / candidate
    return None


#: A label is looked for in the first bytes of a file; the longest known have some 60 kB.
MAX_LABEL_BYTES = 1_000_000

_FIRST = re.compile(
    rb"(?:\s|/\*[^*]*\*/|CCSD[0-9A-Z]+|[A-Z]+_VERSION_ID\s*=\s*\"?ODL)*PDS_VERSION_ID\s*=\s*\"?PDS3"
)
_COMPONENTS = {"CAHV": 4, "CAHVOR": 6, "CAHVORE": 7}


@dataclass(frozen=True)
class PdsLabel:
    """A label's content; ``attached`` if data follow it in the same file."""

    path: Path
    root: LabelBlock
    attached: bool
    digest: str


@dataclass(frozen=True, eq=False)
class PdsProduct:
    """The values of a label that a pointing program needs.

    Attributes
    ----------
    camera_model
        In ``frame``, for the image of ``size_px``; None if the label has none of the CAHV family.
    frame
        REFERENCE_COORD_SYSTEM_NAME of the camera model (``ROVER_FRAME``, ``ROVER_NAV_FRAME``).
    azimuth_measured_rad, elevation_measured_rad
        The mast's measured angles; None if the label has none.
    image
        (lines, samples) in the machine's byte order, of the label's sample type; None if its file is absent
        or was not asked for.
    size_px
        (width, height) = (LINE_SAMPLES, LINES).
    calibration_source_id, product_id
        As the label has them, '' if it does not.
    notes
        Sentences for the user.
    """

    label: PdsLabel
    camera_model: CameraModel | None
    frame: str
    azimuth_measured_rad: float | None
    elevation_measured_rad: float | None
    image: NDArray[Any] | None
    size_px: tuple[int, int]
    calibration_source_id: str
    product_id: str
    notes: tuple[str, ...]


def looks_like_pds3(data: bytes) -> bool:
    """Return whether the bytes begin with a PDS3 label."""
    return _FIRST.match(data[:4096]) is not None


def read_label(path: str | Path) -> PdsLabel:
    """Read the label at the beginning of a file.

    Raises
    ------
    BadFile
        If the file cannot be read or does not begin with a PDS3 label.
    """
    return _label(read_bytes(path, MAX_FILE_BYTES), path)


def read_product(path: str | Path, with_image: bool = True) -> PdsProduct:
    """Read a label and, unless ``image`` is false, the image that it points to.

    Parameters
    ----------
    path
        The label, or the file that it is attached to.
    with_image
        Whether to read the pixels too.

    Raises
    ------
    BadFile
        If the file is no PDS3 product with an IMAGE object, or what it says of camera, angles or image is
        malformed; the place names group and keyword.
    """
    data = read_bytes(path, MAX_FILE_BYTES)
    label = _label(data, path)
    image_block = next((b for b in label.root.every() if b.kind == "OBJECT" and b.name == "IMAGE"), None)
    if image_block is None:
        raise BadFile(path, "IMAGE", "the label has no OBJECT = IMAGE")
    size = (
        integer_in(image_block, "LINE_SAMPLES", path, 1, LARGEST_IMAGE_PX),
        integer_in(image_block, "LINES", path, 1, LARGEST_IMAGE_PX),
    )
    model, frame, source, notes = _camera(label, size)
    azimuth, elevation = _mast_angles(label)
    image = None
    if with_image:
        image, image_notes = read_pixels(label.path, label.root, image_block, data, size)
        notes += image_notes
    return PdsProduct(
        label=label,
        camera_model=model,
        frame=frame,
        azimuth_measured_rad=azimuth,
        elevation_measured_rad=elevation,
        image=image,
        size_px=size,
        calibration_source_id=source,
        product_id=str(label.root.values.get("PRODUCT_ID", "")),
        notes=notes,
    )


def load_pds3_camera(path: str | Path) -> CameraFile:
    """Read the camera model of a label, with the label's facts as provenance.

    Raises
    ------
    BadFile
        As ``read_product``, and if the label has no camera model.
    """
    product = read_product(path, with_image=False)
    if product.camera_model is None:
        raise BadFile(path, "GEOMETRIC_CAMERA_MODEL", "the label has no CAHV, CAHVOR or CAHVORE camera model")
    provenance: dict[str, Any] = {"product_id": product.product_id}
    if product.calibration_source_id:
        provenance["calibration_source_id"] = product.calibration_source_id
    if product.azimuth_measured_rad is not None:
        provenance["azimuth_measured_rad"] = product.azimuth_measured_rad
        provenance["elevation_measured_rad"] = product.elevation_measured_rad
    return CameraFile(
        product.camera_model, product.frame, {}, provenance, product.notes, Path(path), product.label.digest
    )


def _label(data: bytes, path: str | Path) -> PdsLabel:
    if not looks_like_pds3(data):
        raise BadFile(path, "line 1", "does not begin with 'PDS_VERSION_ID = PDS3'")
    root = parse_label(data[:MAX_LABEL_BYTES].decode("latin-1"), path)
    pointer = root.values.get("^IMAGE")
    attached = pointer is not None and not isinstance(_first(pointer), str)
    return PdsLabel(Path(path), root, attached, digest_of(data))


def _camera(
    label: PdsLabel, size_px: tuple[int, int]
) -> tuple[CameraModel | None, str, str, tuple[str, ...]]:
    """Return the camera model, its frame, its calibration source and notes."""
    path = label.path
    blocks = [b for b in label.root.every() if b.name.startswith("GEOMETRIC_CAMERA_MODEL")]
    kinds = [b for b in blocks if b.values.get("MODEL_TYPE") in _COMPONENTS]
    if not kinds:
        return None, "", "", ()
    block = kinds[0]
    notes = () if len(kinds) == 1 else (f"the first of {len(kinds)} camera models of the label is read",)
    kind = cast(Kind, block.values["MODEL_TYPE"])
    count = _COMPONENTS[kind]
    vectors = {
        letter: vector_in(block, f"MODEL_COMPONENT_{number}", path)
        for number, letter in zip(range(1, count + 1), kind, strict=True)
    }
    cahvore_type, linearity = 0, None
    if kind == "CAHVORE":
        number = number_in(block, "MODEL_COMPONENT_8", path)
        if number not in (1.0, 2.0, 3.0):
            raise BadFile(
                path, f"{block.name}.MODEL_COMPONENT_8", f"{number:g} where type 1, 2 or 3 is expected"
            )
        cahvore_type = int(number)
        if "MODEL_COMPONENT_9" in block.values:
            linearity = number_in(block, "MODEL_COMPONENT_9", path)
        elif cahvore_type == 3:
            raise BadFile(path, f"{block.name}.MODEL_COMPONENT_9", "the linearity of type 3 is missing")
    model, model_notes = build_model(path, block.name, kind, size_px, vectors, cahvore_type, linearity)
    frame = block.values.get("REFERENCE_COORD_SYSTEM_NAME")
    if not isinstance(frame, str) or not frame.isprintable() or not frame:
        raise BadFile(path, f"{block.name}.REFERENCE_COORD_SYSTEM_NAME", "the frame's name is missing")
    source = block.values.get("CALIBRATION_SOURCE_ID", "")
    return model, frame, str(source) if isinstance(source, (int, str)) else "", notes + model_notes


def _mast_angles(label: PdsLabel) -> tuple[float | None, float | None]:
    """Return measured azimuth and elevation of the mast, radians; None where the label has no such group."""
    for block in label.root.every():
        if not re.match("(PMA|RSM)_ARTICULATION_STATE", block.name):
            continue
        names = block.values.get("ARTICULATION_DEVICE_ANGLE_NAME", ())
        angles = block.values.get("ARTICULATION_DEVICE_ANGLE", ())
        place = f"{block.name}.ARTICULATION_DEVICE_ANGLE"
        if not isinstance(names, tuple) or not isinstance(angles, tuple) or len(names) != len(angles):
            raise BadFile(label.path, place, "as many angles as angle names are expected")
        if "AZIMUTH-MEASURED" in names and "ELEVATION-MEASURED" in names:
            azimuth, elevation = (
                _radians(angles[names.index(name)], label.path, place)
                for name in ("AZIMUTH-MEASURED", "ELEVATION-MEASURED")
            )
            return azimuth, elevation
    return None, None


def _radians(value: Any, path: Path, place: str) -> float:
    unit = value.unit.lower() if isinstance(value, Quantity) else "rad"
    number = value.value if isinstance(value, Quantity) else value
    factor = {"rad": 1.0, "radian": 1.0, "radians": 1.0, "deg": math.pi / 180, "degree": math.pi / 180}
    if not isinstance(number, (int, float)) or not abs(number) <= 1e6 or unit not in factor:
        raise BadFile(path, place, f"{value!r:.60} where an angle in <rad> or <deg> is expected")
    return float(number) * factor[unit]


def _first(value: Any) -> Any:
    return value[0] if isinstance(value, tuple) and not isinstance(value, Quantity) and value else value

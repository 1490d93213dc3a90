"""Cameras as OpenCV and ROS write them, and what files with OpenCV's lenses share.

ROS's ``camera_info`` is camera_calibration_parsers' YAML, or messages of one topic as ``ros2 topic echo``
prints them, of which the first is read. The file holds no pose: frame ``camera``, x right, y down, z ahead,
as ROS's optical frames. R and P are those of a camera that is not rectified; of a rectified one they are not
read, for they do not change what the lens sees.

OpenCV's ``FileStorage`` in YAML, JSON or XML holds ``image_width``, ``image_height``, ``camera_matrix`` and
``distortion_coefficients`` as the calibration samples write them, and ``fisheye_model`` for cv2.fisheye's
lens. OpenCV has no keys for where a camera is: this writer adds ``frame`` and ``camera_from_frame`` (4, 4),
points of the frame to camera axes, and this reader knows them.

The lens is the family that the file names and as many coefficients as it holds: 0, 4, 5, 8, 12 or 14 of
cv2.projectPoints (``plumb_bob``, ``rational_polynomial``), 4 of cv2.fisheye (``equidistant``). A key that is
not read is noted, unless it may change the camera: then the file is refused.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar
from xml.etree import ElementTree

import cv2
import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from calib.errors import BadFile
from calib.files import LARGEST_IMAGE_PX, CameraFile, blind_notes
from calib.files.records import ABSENT, Number, Record, Text, problem, read_record
from calib.files.twin import FISHEYE, ODD, LensFamily, kind_of_lens
from calib.files.yaml_text import MAX_BYTES, MAX_DEPTH, dump_mapping, kind_of, parse_mapping
from calib.geometry.cahvor import CameraModel
from calib.geometry.lenses import opencv
from calib.geometry.rigid import FloatArray, Rigid

LensName = Literal[
    "plumb_bob",
    "rational_polynomial",
    "equidistant",
    "fisheye",
    "kannala_brandt",
    "radtan",
    "pinhole",
    "none",
]
_EQUIDISTANT = ("equidistant", "fisheye", "kannala_brandt")

_OTHER_NAMES = {
    "camera_matrix": ("cameraMatrix", "Camera_Matrix", "K", "M", "k"),
    "distortion_coefficients": (
        *("dist_coeffs", "dist_coeff", "distCoeffs", "Distortion_Coefficients"),
        *("D", "d"),
    ),
    "image_width": ("image_Width", "width"),
    "image_height": ("image_Height", "height"),
}
_IGNORED = (
    *("rectification_matrix", "r", "R", "projection_matrix", "p", "P"),
    *("camera_name", "header", "roi"),
)

_LENS_KEY = re.compile(
    r"fish_?eye|omni|distor|dist_?coef|lens|model|(?:^|_)(?:xi|skew|alpha|mirror\w*)$", re.I
)
_SPREAD_KEY = re.compile(r"std|dev|sigma|cov|err", re.I)
"""Unknown keys that may change what a lens does, but for those that say how well it is known."""

_NEAR = 0.85
"""How alike (difflib's ratio) a key that is not read and a known one must be for a misspelling."""

_STORAGE = re.compile(
    rb"\A(?:\s|\xef\xbb\xbf|#[^\n]*\n)*(?:%YAML:|<opencv_storage|<\?xml)|!!opencv-|\"opencv-"
)
_XML = re.compile(rb"\A(?:\s|\xef\xbb\xbf)*<")
_TAG = re.compile(rb"!!opencv-[a-z-]+|^(?:\xef\xbb\xbf)?%YAML.*$", re.MULTILINE)
_ESCAPE = re.compile(rb"(\\\\)|\\(?=')")
"""OpenCV writes an apostrophe as no other YAML or JSON does, after a backslash."""
_BETWEEN = re.compile(rb"^---[ \t]*\r?$", re.MULTILINE)
_CONTENT = re.compile(rb"^[ \t]*[^\s#]", re.MULTILINE)


def looks_like_storage(data: bytes) -> bool:
    """Return whether the bytes have a mark of OpenCV's FileStorage: its head, a tag, or XML."""
    return _STORAGE.search(data) is not None


def read_document(data: bytes, path: str | Path) -> dict[str, Any]:
    """Return the keys of a FileStorage, of a YAML file, or of the first of several messages.

    Raises BadFile if it cannot be parsed.
    """
    if _XML.match(data):
        return _xml(data, path)
    if looks_like_storage(data):  # the rest of OpenCV's YAML and JSON is plain
        data = _ESCAPE.sub(rb"\1", _TAG.sub(b"", data))
    lines = b""
    for part in _BETWEEN.split(data):
        if _CONTENT.search(part):
            return parse_mapping(lines + part, path)
        lines += b"\n" * part.count(b"\n")
    return parse_mapping(data, path)


def _xml(data: bytes, path: str | Path) -> dict[str, Any]:
    """The keys of a FileStorage in XML."""
    if len(data) > MAX_BYTES:
        raise BadFile(path, "", f"is larger than {MAX_BYTES} bytes, the most that is read")
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        line = f"line {error.position[0]}" if isinstance(error, ElementTree.ParseError) else ""
        raise BadFile(path, line, f"is not XML: {error}") from None
    if root.tag != "opencv_storage":
        raise BadFile(path, "", f"holds <{root.tag[:40]}> where <opencv_storage> is expected")

    def value_of(node: ElementTree.Element, depth: int) -> Any:
        if depth > MAX_DEPTH:
            raise BadFile(path, "", f"is nested deeper than {MAX_DEPTH} levels")
        if len(node):
            found: dict[str, Any] = {}
            for inner in node:
                if inner.tag in found and inner.tag != "_":
                    raise BadFile(path, inner.tag, "the key is there twice")
                found[inner.tag] = value_of(inner, depth + 1)
            return found if "_" not in found else [None] * len(node)  # no part of a camera is such a list
        numbers = [_xml_number(one) for one in (node.text or "").split()]
        return numbers if len(numbers) != 1 or node.tag == "data" else numbers[0]

    keys = value_of(root, 0)
    return keys if isinstance(keys, dict) else {}


def _xml_number(text: str) -> float | int | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text.strip('"')


def _flat(value: Any) -> Any:
    """The numbers of ``{rows, cols, data}``, of a list of rows, or of a list; the data count."""
    if isinstance(value, dict):
        if "data" not in value:
            raise problem("data", "the key is missing")
        data = value["data"]
        return [data] if isinstance(data, (int, float)) else data or []
    if not isinstance(value, list):
        raise problem("", f"{kind_of(value)} where {{rows, cols, data}} or [[a, b, c], ...] is expected")
    rows = [row if isinstance(row, list) else [row] for row in value]
    if len({len(row) for row in rows}) > 1:
        raise problem("", "rows of several lengths where a matrix is expected")
    return [number for row in rows for number in row]


def _no_skew(numbers: list[float]) -> list[float]:
    """A camera matrix without skew: cv2 and programs built on it leave a skew out."""
    if numbers[1] or numbers[3] or numbers[6:] != [0.0, 0.0, 1.0]:
        matrix = np.reshape(numbers, (3, 3)).tolist()
        raise problem("", f"{matrix} where [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] is expected")
    return numbers


def _not_binned(times: int) -> int:
    if times > 1:
        raise problem("", "the picture is binned; the camera of the whole picture is expected (0 or 1)")
    return times


Numbers = Annotated[list[Number], BeforeValidator(_flat)]
_Matrix33 = Annotated[
    list[Number], Field(min_length=9, max_length=9), BeforeValidator(_flat), AfterValidator(_no_skew)
]
Matrix44 = Annotated[list[Number], Field(min_length=16, max_length=16), BeforeValidator(_flat)]
_Pixels = Annotated[
    int,
    Field(ge=1, le=LARGEST_IMAGE_PX),
    BeforeValidator(lambda size: int(size) if isinstance(size, float) and size.is_integer() else size),
]
_Binning = Annotated[int, Field(ge=0, le=64), AfterValidator(_not_binned)]
_LensName = Annotated[
    LensName,
    BeforeValidator(lambda name: (name.lower() or "none") if isinstance(name, str) else name),
]


class Source(NamedTuple):
    """Where a record was read: the file, the mapping's key path, the file's name of each key, notes."""

    path: str | Path
    place: str
    names: Mapping[str, str]
    notes: list[str]

    def bad(self, key: str, reason: str) -> BadFile:
        """Return the refusal of a key's value, or of the whole mapping for ''."""
        steps = (self.place, self.names.get(key, key))
        return BadFile(self.path, ".".join(filter(None, steps)), reason)


Kind = TypeVar("Kind", bound=Record)


def read_foreign(
    kind: type[Kind],
    keys: object,
    path: str | Path,
    place: str = "",
    other_names: Mapping[str, Sequence[str]] | None = None,
    ignored: Sequence[str] = (),
) -> tuple[Kind, Source]:
    """Return the record of another program's keys, and where it was read, with a note of unread keys.

    ``other_names`` are further names of a record's keys, of other releases; ``ignored`` are keys that say
    nothing of the camera. Raises BadFile as `calib.files.records.read_record`, or if an unread key may change
    the camera, is nearly a known one, or contradicts another name of the same.
    """
    if not isinstance(keys, dict):
        raise BadFile(path, place, f"{kind_of(keys)} where a mapping is expected")
    source = Source(path, place, {}, [])
    names: dict[str, str] = {}
    known = dict.fromkeys(ignored)
    for field, info in kind.model_fields.items():
        choices = (field, *(other_names or {}).get(field, ()))
        known |= dict.fromkeys(choices)
        present = [name for name in choices if name in keys]
        for other in present[1:]:
            if keys[other] != keys[present[0]]:
                raise source.bad(other, f"has other values than '{present[0]}'; keep the one that is right")
        if present:
            names[field] = present[0]
        elif info.is_required():
            near = [one for name in choices for one in get_close_matches(name, keys, n=1, cutoff=_NEAR)]
            hint = f"; add the image's size in pixels, as '{field}: 640'" if "image_" in field else ""
            raise source.bad(
                field, "the key is missing" + (f"; rename '{near[0]}', if that is it" if near else hint)
            )
    left = [key for key in keys if key not in known]
    for key in left:
        if near := get_close_matches(key, [name for name in known if name not in keys], 1, _NEAR):
            reason = f"unknown key; the nearest known is '{near[0]}': rename it or take it out"
            raise source.bad(key, reason)
        if _LENS_KEY.search(key) and not _SPREAD_KEY.search(key):
            reason = "this key may change the lens and is not read; take it out if it does not, else write "
            reason += "distortion_model (plumb_bob, rational_polynomial or equidistant) and its coefficients"
            raise source.bad(key, reason)
    try:
        record = read_record(kind, {field: keys[name] for field, name in names.items()}, path, place)
    except BadFile as error:
        field = next((one for one in names if one in re.split(r"[.\[]", error.place)), "")
        renamed = error.place.replace(field, names.get(field, ""), 1)
        raise BadFile(path, renamed, error.reason) from None
    if left:
        source.notes.append(f"{', '.join(source.bad(key, '').place for key in left[:8])} not read")
    return record, source._replace(names=names)


class CalibrationRecord(Record):
    """The keys of OpenCV's calibration of a camera, and of ROS's camera_info."""

    camera_matrix: _Matrix33
    distortion_coefficients: Numbers
    image_width: _Pixels
    image_height: _Pixels
    distortion_model: _LensName = Field(default=ABSENT)
    camera_model: _LensName = Field(default=ABSENT)
    fisheye_model: Annotated[int, Field(ge=0, le=1)] = Field(default=ABSENT)
    binning_x: _Binning = 0
    binning_y: _Binning = 0
    camera_from_frame: Matrix44 = Field(default=ABSENT)
    frame: Text = "camera"  # its own, x right, y down, z ahead, where the file holds no pose

    @model_validator(mode="after")
    def _names_one_lens(self) -> CalibrationRecord:
        names = self.lens_names
        if len({name in _EQUIDISTANT for name in names.values()}) > 1:
            reason = "name two lenses; keep the one that belongs to the coefficients"
            raise problem("", f"{' and '.join(names)} {reason}")
        if self.camera_from_frame is not None and "frame" not in self.model_fields_set:
            raise problem("frame", "the key is missing; camera_from_frame belongs to it")
        return self

    @property
    def lens_names(self) -> dict[str, LensName]:
        """The lens that each key names; of a name alone cv2 decides."""
        names: dict[str, LensName] = {
            "distortion_model": self.distortion_model,
            "camera_model": self.camera_model,
        }
        if self.distortion_model and self.camera_model == "pinhole":
            del names["camera_model"]  # the projection; the other key names the lens
        if self.fisheye_model is not None:
            names["fisheye_model"] = "equidistant" if self.fisheye_model else "pinhole"
        return {key: name for key, name in names.items() if name}


def looks_like_calibration(document: Mapping[str, object]) -> bool:
    """Return whether a file's keys are those of OpenCV's calibrations or of a camera_info."""
    sure = {"camera_matrix", "distortion_model", "Camera_Matrix", "cameraMatrix"}
    long = {name for field in _OTHER_NAMES for name in (field, *_OTHER_NAMES[field]) if len(name) > 6}
    keys = set(document)
    return bool(sure & keys) or any(len(some & keys) > 1 for some in (long, {"K", "width"}))


def parse_calibration(data: bytes, path: str | Path) -> CameraFile:
    """Return the camera of OpenCV's or ROS's file.

    Raises BadFile if it is none: which key, what it holds, what is expected.
    """
    document = read_document(data, path)
    record, source = read_foreign(CalibrationRecord, document, path, "", _OTHER_NAMES, _IGNORED)
    pose = Rigid.identity()
    if record.camera_from_frame is not None:
        pose = pose_of(source, "camera_from_frame", record.camera_from_frame).inverse
    return lens_camera(
        source,
        ("distortion_coefficients", next(iter(record.lens_names.values()), "pinhole")),
        record.distortion_coefficients,
        (record.image_width, record.image_height),
        np.array(record.camera_matrix)[[0, 4, 2, 5]],
        pose,
        record.frame,
    )


def pose_of(source: Source, key: str, numbers: Sequence[Any]) -> Rigid:
    """Return the 16 numbers of a matrix as a rigid transform; a rotation of few digits is made one."""
    matrix = np.reshape(np.array(numbers, dtype=np.float64), (4, 4))
    turn, _, other = np.linalg.svd(matrix[:3, :3])
    rotation = turn @ other
    off = np.abs(rotation - matrix[:3, :3]).max()
    if not off < 1e-3 or np.linalg.det(rotation) < 0.0 or matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise source.bad(key, "no rotation and translation: (4, 4) with a last row 0, 0, 0, 1 is expected")
    return Rigid(rotation, matrix[:3, 3])


def matrix44(pose: Rigid) -> FloatArray:
    """Return a transform as (4, 4)."""
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = pose.rotation, pose.translation_m
    return whole


def lens_camera(
    source: Source,
    lens: tuple[str, LensName],
    coefficients: Sequence[float],
    size_px: Sequence[int],
    intrinsics: Sequence[float] | FloatArray,
    frame_from_camera: Rigid,
    frame: str,
) -> CameraFile:
    """Return the camera of numbers that were read, with a note of the part of its image that has no ray.

    ``lens`` is the key of the coefficients and the lens's name, ``intrinsics`` are fx, fy, cx, cy. One
    without a lens is a CAHV. Raises BadFile if the numbers are no camera, or as `blind_notes`.
    """
    key, name = lens
    numbers, (fx, fy, cx, cy), pose = np.array(coefficients, dtype=np.float64), intrinsics, frame_from_camera
    family: LensFamily = "equidistant" if name in _EQUIDISTANT else "pinhole"
    if name == "none" and numbers.any():
        reason = f"{len(numbers)} coefficients, and distortion_model 'none'; name it: plumb_bob or "
        raise source.bad(key, reason + "equidistant")
    if family == "equidistant":
        if len(numbers) not in (0, 4) and (len(numbers) < 4 or numbers[4:].any()):
            raise source.bad(key, f"{len(numbers)} coefficients where 4 are expected for '{name}'")
        numbers = numbers[:4] if len(numbers) else np.zeros(4)
    elif len(numbers) not in (0, *opencv.COUNTS):
        expected = ", ".join(map(str, (0, *opencv.COUNTS)))
        raise source.bad(key, f"{len(numbers)} coefficients where one of {expected} is expected")
    if np.abs(numbers).max(initial=0.0) > 1e6:
        raise source.bad(key, f"{numbers.tolist()} where numbers up to 1e6 are expected")
    if not (1e-3 < min(abs(fx), abs(fy)) <= max(abs(fx), abs(fy)) < 1e7) or max(abs(cx), abs(cy)) > 1e7:
        raise source.bad("", f"focal length {[float(fx), float(fy)]} where pixels are expected")
    if fx * fy < 0.0:
        raise source.bad("", f"focal lengths {fx:g}, {fy:g} of two signs: a mirrored image is not read")
    if fy < 0.0:  # the same as a camera turned about z by half a turn
        fx, fy, pose = -fx, -fy, pose @ Rigid(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
        if family == "pinhole":
            numbers = numbers * np.where(np.isin(np.arange(len(numbers)), ODD), -1.0, 1.0)
    matrix, size = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], (size_px[0], size_px[1])
    kind = kind_of_lens(family, numbers)
    try:
        model = CameraModel.of_matrix(kind, size, matrix, numbers, pose.rotation.T, pose.translation_m)
    except ValueError as error:
        raise source.bad("", str(error)) from None
    notes = (*source.notes, *blind_notes(model, source.path, source.place))
    return CameraFile(model, frame, {}, {}, notes, Path(source.path))


def intrinsics_of(camera: CameraModel) -> FloatArray:
    """Return fx, fy, cx, cy (4,) of a camera without skew."""
    return camera.camera_matrix[[0, 1, 0, 1], [0, 1, 2, 2]]


def lens_numbers(camera: CameraModel) -> FloatArray:
    """Return the coefficients (n,) as other programs write them: four zeros where there is no lens."""
    return camera.distortion if len(camera.distortion) else np.zeros(4)


def format_camera_info(camera: CameraModel, lens: str, name: str) -> bytes:
    """Return the camera as camera_calibration_parsers writes it; its pose is left out."""
    distortion = camera.distortion
    if lens == "plumb_bob":
        distortion = np.pad(distortion, (0, 5 - len(distortion)))

    def matrix(values: FloatArray) -> dict[str, object]:
        return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel()}

    return dump_mapping(
        {
            "image_width": camera.size_px[0],
            "image_height": camera.size_px[1],
            "camera_name": name,
            "camera_matrix": matrix(camera.camera_matrix),
            "distortion_model": lens,
            "distortion_coefficients": matrix(distortion[None]),
            "rectification_matrix": matrix(np.eye(3)),
            "projection_matrix": matrix(np.hstack([camera.camera_matrix, np.zeros((3, 1))])),
        }
    )


def format_opencv(camera: CameraModel, frame: str) -> bytes:
    """Return the camera as OpenCV's YAML, its pose with it."""
    fisheye, distortion = camera.kind == FISHEYE, lens_numbers(camera)
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.writeComment("The centre of the first pixel is (0, 0); metres of 'frame' to camera axes")
    keys = {
        "image_width": camera.size_px[0],
        "image_height": camera.size_px[1],
        "camera_model": "fisheye" if fisheye else "pinhole",
        "fisheye_model": int(fisheye),
        "camera_matrix": camera.camera_matrix,
        "distortion_coefficients": distortion[:, None] if fisheye else distortion[None],
        "frame": frame,
        "camera_from_frame": matrix44(camera.pose.inverse),
    }
    for key, value in keys.items():
        storage.write(key, value)
    return storage.releaseAndGetString().encode()

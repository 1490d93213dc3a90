"""Cameras as OpenCV and ROS write them, and what the files of all other programs share.

ROS's ``camera_info`` is camera_calibration_parsers' YAML, or messages of one topic as ``ros2 topic echo``
prints them. The file holds no pose: frame ``camera``, x right, y down, z ahead, as ROS's optical frames. R
and P are those of a camera that is not rectified; of a rectified one they are not read, for they do not
change what the lens sees.

OpenCV's ``FileStorage`` (`calib.files.file_storage`) holds ``image_width``, ``image_height``,
``camera_matrix`` and ``distortion_coefficients`` as the calibration samples write them, ``fisheye_model`` for
cv2.fisheye's lens, ``M1``, ``D1``, ``M2``, ``D2`` for a stereo pair (whose R and T have no stated unit and
are not read). OpenCV has no keys for where a camera is: this writer adds ``frame`` and ``camera_from_frame``
(4, 4), points of the frame to camera axes, and this reader knows them.

The lens is the family that the file names and as many coefficients as it holds: 0, 4, 5, 8, 12 or 14 of
cv2.projectPoints (``plumb_bob``, ``rational_polynomial``), 4 of cv2.fisheye (``equidistant``).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from pydantic import BeforeValidator, Field

from calib.errors import BadFile
from calib.files import LARGEST_IMAGE_PX, CameraFile, blind_notes, digest_of
from calib.files.file_storage import looks_like_storage, parse_storage
from calib.files.mast_file import SizePx
from calib.files.records import Number, Text, read_value
from calib.files.twin import FISHEYE, ODD, LensFamily, kind_of_lens
from calib.files.yaml_text import dump_mapping, kind_of, parse_mapping
from calib.geometry.cahvor import CameraModel
from calib.geometry.lenses import opencv
from calib.geometry.rigid import FloatArray, Rigid

CAMERA_FRAME = "camera"
"""The frame of a file that holds no pose: the camera's own, x right, y down, z ahead."""

LARGEST_COEFFICIENT = 1e6

_Flag = Annotated[int, Field(ge=0, le=1)]
_Binning = Annotated[int, Field(ge=0, le=64)]
_Offset = Annotated[int, Field(ge=0, le=65536)]
_Pixels = Annotated[
    int,
    Field(ge=1, le=LARGEST_IMAGE_PX),
    BeforeValidator(lambda size: int(size) if isinstance(size, float) and size.is_integer() else size),
]

_LENS_KEY = re.compile(
    r"fish_?eye|omni|distor|dist_?coef|lens|model|(?:^|_)(?:xi|skew|alpha|mirror\w*)$", re.I
)
_SPREAD_KEY = re.compile(r"std|dev|sigma|cov|err", re.I)
"""Unknown keys that may change what a lens does, but for those that say how well it is known."""

_NEAR = 0.8
"""How alike (difflib's ratio) a key that is not read and a known one must be for a misspelling."""


class ForeignMapping:
    """A mapping of another program, whose unknown keys are noted unless they may change the camera."""

    def __init__(self, path: str | Path, place: str, value: Any) -> None:
        if not isinstance(value, dict):
            raise BadFile(path, place, f"{kind_of(value)} where a mapping is expected")
        self.path, self.place, self.values = path, place, value

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def at(self, key: str) -> str:
        """Return the key path of a key."""
        return f"{self.place}.{key}" if self.place and key else self.place or key

    def bad(self, key: str, reason: str) -> BadFile:
        """Return the refusal of a key's value."""
        return BadFile(self.path, self.at(key), reason)

    def read(self, kind: Any, key: str) -> Any:
        """Return the value of a key, of an annotated type. Raises BadFile."""
        return read_value(kind, self.values[key], self.path, self.at(key))

    def numbers(self, key: str, count: int | None = None) -> FloatArray:
        """Return a list of numbers (n,), of as many as are expected."""
        kind = Annotated[list[Number], Field(min_length=count, max_length=count)]
        return np.array(self.read(kind, key), dtype=np.float64)

    def need(self, *names: str, remedy: str = "") -> str:
        """Return the first of the names that is a key; they are other programs' names of one thing."""
        present = [name for name in names if name in self.values]
        if not present:
            near = [key for name in names for key in get_close_matches(name, self.values, n=1, cutoff=_NEAR)]
            hint = f"; rename '{near[0]}', if that is it" if near else ""
            raise self.bad(names[0], f"the key is missing{hint}{remedy}")
        for other in present[1:]:
            if self.values[other] != self.values[present[0]]:
                raise self.bad(other, f"has other values than '{present[0]}'; keep the one that is right")
        return present[0]

    def matrix(self, key: str, notes: list[str]) -> FloatArray:
        """Return the numbers (n,) of ``{rows, cols, data}``, of a list of rows, or of a list.

        The data count, not ``rows`` and ``cols``; where these contradict, a note is added.
        """
        value = self.values[key]
        if isinstance(value, dict):
            data = value[ForeignMapping(self.path, self.at(key), value).need("data")]
            data = [data] if isinstance(data, (int, float)) else data or []
            found = ForeignMapping(self.path, self.at(key), {"data": data}).numbers("data")
            rows, columns = value.get("rows"), value.get("cols")
            if isinstance(rows, int) and isinstance(columns, int) and rows * columns != len(found):
                notes.append(
                    f"{self.at(key)}: {len(found)} numbers, and rows and cols say {rows} x {columns}; "
                    "the numbers are read"
                )
            return found
        if not isinstance(value, list):
            raise self.bad(
                key, f"{kind_of(value)} where {{rows, cols, data}} or [[a, b, c], ...] is expected"
            )
        rows_of = [row if isinstance(row, list) else [row] for row in value]
        if len({len(row) for row in rows_of}) > 1:
            raise self.bad(key, "rows of several lengths where a matrix is expected")
        flat = ForeignMapping(self.path, self.place, {key: [number for row in rows_of for number in row]})
        return flat.numbers(key)

    def unread(self, known: Sequence[str]) -> tuple[str, ...]:
        """Return a note that names the keys that were not read.

        Raises
        ------
        BadFile
            If one of them may change the camera, or is nearly one of the known keys that are not in the file.
        """
        left = [key for key in self.values if key not in known]
        for key in left:
            near = get_close_matches(key, [name for name in known if name not in self.values], 1, _NEAR)
            if near:
                raise self.bad(
                    key, f"unknown key; the nearest known is '{near[0]}': rename it or take it out"
                )
            if _LENS_KEY.search(key) and not _SPREAD_KEY.search(key):
                raise self.bad(
                    key,
                    "this key may change the lens and is not read; take it out if it does not, else write "
                    f"the lens as {_LENS_KEYS}",
                )
        return (f"{', '.join(f'{self.at(key)!s}' for key in left[:8])} not read",) if left else ()


_LENS_KEYS = "distortion_model (plumb_bob, rational_polynomial or equidistant) and distortion_coefficients"


def camera_matrix(section: ForeignMapping, key: str, matrix: FloatArray) -> FloatArray:
    """Return a matrix K (3, 3), which has no skew: cv2 and programs built on it leave a skew out."""
    if matrix[0, 1] or matrix[1, 0] or matrix[2].tolist() != [0.0, 0.0, 1.0]:
        raise section.bad(key, f"{matrix.tolist()} where [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] is expected")
    return matrix


def matrix_of(numbers: FloatArray) -> FloatArray:
    """Return fx, fy, cx, cy as a camera matrix (3, 3)."""
    fx, fy, cx, cy = numbers.tolist()
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def pose_of(section: ForeignMapping, key: str, matrix: FloatArray) -> Rigid:
    """Return a (4, 4) matrix as a rigid transform; a rotation of few digits is made one."""
    turn, _, other = np.linalg.svd(matrix[:3, :3])
    rotation = turn @ other
    off = np.abs(rotation - matrix[:3, :3]).max()
    if not off < 1e-3 or np.linalg.det(rotation) < 0.0 or matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise section.bad(key, "no rotation and translation: (4, 4) with a last row 0, 0, 0, 1 is expected")
    return Rigid(rotation, matrix[:3, 3])


def lens_camera(
    section: ForeignMapping,
    family: LensFamily,
    size_px: tuple[int, int],
    matrix: FloatArray,
    distortion: FloatArray,
    frame_from_camera: Rigid | None = None,
) -> CameraModel:
    """Return the camera of numbers that were read, or refuse them; one without a lens is a CAHV."""
    if np.abs(distortion).max(initial=0.0) > LARGEST_COEFFICIENT:
        raise section.bad("", f"coefficients {distortion.tolist()} where numbers up to 1e6 are expected")
    focal_px = matrix[[0, 1], [0, 1]]
    if not ((np.abs(focal_px) > 1e-3) & (np.abs(focal_px) < 1e7)).all() or np.abs(matrix[:2, 2]).max() > 1e7:
        raise section.bad("", f"focal length {focal_px.tolist()} where pixels are expected")
    if focal_px.prod() < 0.0:
        raise section.bad("", f"focal lengths {focal_px.tolist()} of two signs: a mirrored image is not read")
    pose = Rigid.identity() if frame_from_camera is None else frame_from_camera
    if focal_px[1] < 0.0:  # the same as a camera turned about z by half a turn
        pose = pose @ Rigid(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
        matrix = matrix * [[-1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, 1.0]]
        if family == "pinhole":
            distortion = distortion * np.where(np.isin(np.arange(len(distortion)), ODD), -1.0, 1.0)
    try:
        return CameraModel.of_matrix(
            kind_of_lens(family, distortion), size_px, matrix, distortion, pose.rotation.T, pose.translation_m
        )
    except ValueError as error:
        raise section.bad("", str(error)) from None


def as_camera_file(
    camera: CameraModel, section: ForeignMapping, frame: str, digest: str, notes: Sequence[str] = ()
) -> CameraFile:
    """Return the camera, with a note of the part of its image that has no ray.

    Raises
    ------
    BadFile
        If more than half of the image has no ray, or the lens folds at its axis.
    """
    notes = (*notes, *blind_notes(camera, section.path, section.place))
    return CameraFile(camera, frame, {}, {}, notes, Path(section.path), digest)


def lens_pose(camera: CameraModel) -> Rigid:
    """Return the camera's axes (x right, y down, z ahead) and C in its frame."""
    return Rigid(camera.rotation.T, camera.C)


def matrix44(pose: Rigid) -> FloatArray:
    """Return a transform as (4, 4)."""
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = pose.rotation, pose.translation_m
    return whole


Reading = CameraFile | BadFile
"""One camera of a file of several: read, or the refusal for when it is requested."""

LENSES: dict[str, tuple[LensFamily, tuple[int, ...]]] = {
    "plumb_bob": ("pinhole", (0, 4, 5)),
    "rational_polynomial": ("pinhole", (8,)),
    "equidistant": ("equidistant", (4,)),
    "fisheye": ("equidistant", (4,)),
    "kannala_brandt": ("equidistant", (4,)),
    "radtan": ("pinhole", (4,)),
    "pinhole": ("pinhole", (0, *opencv.COUNTS)),
    "none": ("pinhole", (0,)),
    "": ("pinhole", (0,)),
}
"""Each name of a lens: its family, and how many coefficients it says there are."""

_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "M", "k")
_COEFFICIENTS = (
    *("distortion_coefficients", "dist_coeffs", "dist_coeff", "distCoeffs", "Distortion_Coefficients"),
    *("D", "d"),
)
_WIDTH, _HEIGHT = ("image_width", "image_Width", "width"), ("image_height", "image_Height", "height")
_RESOLUTION = "cameraResolution"
_LENS_NAMES = ("distortion_model", "camera_model")
_RECTIFIED = ("rectification_matrix", "r", "R")
_HARMLESS = (*_RECTIFIED, "projection_matrix", "p", "P", "camera_name", "header")
_BINNING = ("binning_x", "binning_y")
_PAIR = {
    side: (
        tuple(f"{name}{number}" for name in ("M", "K", "cameraMatrix", "camera_matrix")),
        tuple(f"{name}{number}" for name in ("D", "distCoeffs", "dist_coeffs", "distortion_coefficients")),
    )
    for side, number in (("left", 1), ("right", 2))
}


def looks_like_calibration(document: Mapping[str, object]) -> bool:
    """Return whether a file's keys are those of OpenCV's calibrations or of a camera_info."""
    long = {name for name in (*_MATRIX, *_COEFFICIENTS, *_WIDTH[:2], *_HEIGHT[:2]) if len(name) > 6}
    keys = {key for matrix, coefficients in _PAIR.values() for key in (*matrix, *coefficients)}
    return (
        any(
            name in document
            for name in ("camera_matrix", "distortion_model", "Camera_Matrix", "cameraMatrix")
        )
        or len(long & set(document)) > 1
        or len(keys & set(document)) > 1
        or ({"K", "width"} <= set(document))
    )


def read_document(data: bytes, path: str | Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the keys of a FileStorage, of a YAML file, or of messages of one topic that agree; with notes.

    Raises
    ------
    BadFile
        If it cannot be parsed, or two messages say different things of the camera.
    """
    if looks_like_storage(data):
        return parse_storage(data, path), ()
    parts = [part for part in _BETWEEN.split(data) if _CONTENT.search(part)]
    if len(parts) < 2:
        return parse_mapping(parts[0] if parts else data, path), ()
    first = parse_mapping(parts[0], path)
    for number, part in enumerate(parts[1:], 2):
        try:
            other = parse_mapping(part, path)
        except BadFile:
            if number < len(parts):
                raise
            return first, (f"message {number}, the last, is cut and not read",)
        for key in first:
            if key != "header" and key in other and other[key] != first[key]:
                raise BadFile(
                    path, key, f"message {number} differs from the first; one camera is expected: keep one"
                )
    return first, (f"{len(parts)} messages, which agree; the first is read",)


_BETWEEN = re.compile(rb"^---[ \t]*\r?$", re.MULTILINE)
_CONTENT = re.compile(rb"^[ \t]*[^\s#]", re.MULTILINE)


def parse_calibration(data: bytes, path: str | Path) -> dict[str, Reading]:
    """Read the camera of OpenCV's or ROS's file, or the pair ``left`` and ``right``.

    Returns
    -------
    readings
        By name, ``camera`` where there is one. Of a pair each is read or refused by itself.

    Raises
    ------
    BadFile
        If it is no camera: which key, what it holds, what is expected.
    """
    document, notes = read_document(data, path)
    top = ForeignMapping(path, "", document)
    if not any(key in top for matrix, _ in _PAIR.values() for key in matrix):
        return {"camera": _calibration(top, _MATRIX, _COEFFICIENTS, digest_of(data), notes)}
    names = [key for matrix, coefficients in _PAIR.values() for key in (*matrix, *coefficients)]
    found: dict[str, Reading] = {}
    for side, (matrix, coefficients) in _PAIR.items():
        one = ForeignMapping(
            path,
            "",
            {key: value for key, value in top.values.items() if key not in names}
            | {key: top.values[key] for key in (*matrix, *coefficients) if key in top},
        )
        try:
            found[side] = _calibration(one, matrix, coefficients, digest_of(data), notes)
        except BadFile as refusal:
            found[side] = refusal
    return found


def _calibration(
    top: ForeignMapping,
    matrix_names: Sequence[str],
    coefficient_names: Sequence[str],
    digest: str,
    notes_before: Sequence[str],
) -> CameraFile:
    """The camera of a mapping, its matrix and coefficients under one of the names."""
    notes = list(notes_before)
    key, distortion_key = top.need(*matrix_names), top.need(*coefficient_names)
    numbers = top.matrix(key, notes)
    if len(numbers) != 9:
        raise top.bad(key, f"{len(numbers)} numbers where 3 x 3 are expected")
    matrix = camera_matrix(top, key, numbers.reshape(3, 3))
    size = _size(top)
    family, distortion = _lens(top, distortion_key, top.matrix(distortion_key, notes), notes)
    for name in _BINNING:
        if name in top and top.read(_Binning, name) > 1:
            raise top.bad(name, "the picture is binned; the camera of the whole picture is expected (0 or 1)")
    frame, pose = CAMERA_FRAME, None
    known = [*matrix_names, *coefficient_names, *_WIDTH, *_HEIGHT, _RESOLUTION, *_LENS_NAMES, "fisheye_model"]
    known += [*_HARMLESS, *_BINNING, "roi"]
    if "camera_from_frame" in top:
        numbers = top.matrix("camera_from_frame", notes)
        if len(numbers) != 16:
            raise top.bad("camera_from_frame", f"{len(numbers)} numbers where 4 x 4 are expected")
        pose = pose_of(top, "camera_from_frame", numbers.reshape(4, 4)).inverse
        frame = top.read(Text, top.need("frame"))
        known += ["frame", "camera_from_frame"]
    notes += top.unread(known)
    if "roi" in top:
        roi = ForeignMapping(top.path, "roi", top.values["roi"])
        if any(name in roi and roi.read(_Offset, name) for name in ("x_offset", "y_offset")):
            notes.append("roi: not read; the camera is that of the whole picture")
    if _is_rectified(top, notes):
        notes.append("R or P turn or scale the picture for rectification; they are not read")
    return as_camera_file(lens_camera(top, family, size, matrix, distortion, pose), top, frame, digest, notes)


def _size(top: ForeignMapping) -> tuple[int, int]:
    """The image's size in pixels: two keys, or OpenCV's ``cameraResolution``."""
    if _RESOLUTION in top and not any(name in top for name in (*_WIDTH, *_HEIGHT)):
        width, height = top.read(SizePx, _RESOLUTION)
        return width, height
    width, height = (
        top.need(*names, remedy=f"; add the image's size in pixels, as '{names[0]}: 640'")
        for names in (_WIDTH, _HEIGHT)
    )
    return top.read(_Pixels, width), top.read(_Pixels, height)


def _lens(
    top: ForeignMapping, key: str, numbers: FloatArray, notes: list[str]
) -> tuple[LensFamily, FloatArray]:
    """The family that the file names and the coefficients that it holds; of a name alone cv2 decides."""
    names = {at: top.values[at] for at in _LENS_NAMES if at in top}
    for at, name in names.items():
        if not isinstance(name, str) or name.lower() not in LENSES:
            known = ", ".join(filter(None, LENSES))
            raise top.bad(at, f"{kind_of(name)} where one of {known} is expected")
    if "distortion_model" in names and names.get("camera_model") == "pinhole":
        del names["camera_model"]  # the projection; the other key names the lens
    families: dict[str, LensFamily] = {at: LENSES[name.lower()][0] for at, name in names.items()}
    if "fisheye_model" in top:
        families["fisheye_model"] = "equidistant" if top.read(_Flag, "fisheye_model") else "pinhole"
    if len(set(families.values())) > 1:
        raise top.bad(
            "", f"{' and '.join(families)} name two lenses; keep the one that belongs to the coefficients"
        )
    family: LensFamily = next(iter(families.values()), "pinhole")
    name = next(iter(names.values()), "pinhole" if family == "pinhole" else "equidistant").lower()
    return family, coefficients(top, key, name, numbers, notes)


def coefficients(
    section: ForeignMapping, key: str, name: str, numbers: FloatArray, notes: list[str]
) -> FloatArray:
    """Return the coefficients (n,) that cv2 takes of the numbers under a lens's name; a note if these differ.

    Raises
    ------
    BadFile
        If cv2 takes no such number of them.
    """
    family, counts = LENSES[name]
    if name in ("none", "") and numbers.any():
        raise section.bad(
            key,
            f"{len(numbers)} coefficients, and distortion_model '{name}'; name it: plumb_bob or equidistant",
        )
    found = numbers
    if family == "equidistant":
        if len(numbers) not in (0, 4) and (len(numbers) < 4 or numbers[4:].any()):
            raise section.bad(key, f"{len(numbers)} coefficients where 4 are expected for '{name}'")
        found = np.zeros(4) if not len(numbers) else numbers[:4]
    elif len(numbers) not in (0, *opencv.COUNTS):
        expected = ", ".join(map(str, (0, *opencv.COUNTS)))
        raise section.bad(key, f"{len(numbers)} coefficients where one of {expected} is expected")
    if len(numbers) not in counts and name not in ("none", ""):
        usual = " or ".join(map(str, counts))
        notes.append(
            f"{section.at(key)}: {len(numbers)} coefficients where '{name}' has {usual}; read as cv2 does"
        )
    return found


def _is_rectified(top: ForeignMapping, notes: list[str]) -> bool:
    """Whether R is another rotation than none."""
    for key in _RECTIFIED:
        if key in top:
            matrix = top.matrix(key, notes)
            return len(matrix) == 9 and bool(
                np.abs(matrix - np.eye(3).ravel()).max() > 1e-9 and np.any(matrix)
            )
    return False


def format_camera_info(camera: CameraModel, lens: str, name: str) -> bytes:
    """Return the camera as camera_calibration_parsers writes it; its pose is left out."""
    distortion = camera.distortion
    if lens == "plumb_bob":
        distortion = np.concatenate([distortion, np.zeros(5 - len(distortion))])

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
    fisheye = camera.kind == FISHEYE
    distortion = camera.distortion if len(camera.distortion) else np.zeros(4)
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
        "camera_from_frame": matrix44(lens_pose(camera).inverse),
    }
    for key, value in keys.items():
        storage.write(key, value)
    return storage.releaseAndGetString().encode()

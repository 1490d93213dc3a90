"""Cameras as OpenCV and ROS write them.

ROS's ``camera_info`` is camera_calibration_parsers' YAML, or messages of one topic as ``ros2 topic echo``
prints them, of which the first is read. The file holds no pose: frame ``camera``, x right, y down, z ahead,
as ROS's optical frames. R and P are those of a camera that is not rectified; of a rectified one they are not
read, for they do not change what the lens sees.

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
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from calib.files import LARGEST_IMAGE_PX, CameraFile, digest_of
from calib.files.file_storage import looks_like_storage, parse_storage
from calib.files.foreign import (
    LENSES,
    LensName,
    Matrix33,
    Matrix44,
    Numbers,
    coefficients,
    lens_camera,
    lens_numbers,
    lens_pose,
    matrix44,
    pose_of,
    read_foreign,
)
from calib.files.records import ABSENT, Record, Text, problem
from calib.files.twin import FISHEYE
from calib.files.yaml_text import dump_mapping, parse_mapping
from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray, Rigid

CAMERA_FRAME = "camera"
"""The frame of a file that holds no pose: the camera's own, x right, y down, z ahead."""

_OTHER_NAMES = {
    "camera_matrix": ("cameraMatrix", "Camera_Matrix", "K", "M", "k"),
    "distortion_coefficients": (
        *("dist_coeffs", "dist_coeff", "distCoeffs", "Distortion_Coefficients"),
        *("D", "d"),
    ),
    "image_width": ("image_Width", "width"),
    "image_height": ("image_Height", "height"),
}
_PAIR = {
    side: {
        "camera_matrix": tuple(f"{name}{number}" for name in ("M", "K", "cameraMatrix", "camera_matrix")),
        "distortion_coefficients": tuple(
            f"{name}{number}" for name in ("D", "distCoeffs", "dist_coeffs", "distortion_coefficients")
        ),
    }
    for side, number in (("left", 1), ("right", 2))
}
_IGNORED = (
    *("rectification_matrix", "r", "R", "projection_matrix", "p", "P"),
    *("camera_name", "header", "roi", "cameraResolution"),
)
_REMEDIES = {
    name: f"; add the image's size in pixels, as '{name}: 640'" for name in ("image_width", "image_height")
}


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


class CalibrationRecord(Record):
    """The keys of OpenCV's calibration of a camera, and of ROS's camera_info."""

    camera_matrix: Annotated[Matrix33, AfterValidator(_no_skew)]
    distortion_coefficients: Numbers
    image_width: _Pixels
    image_height: _Pixels
    distortion_model: _LensName = Field(default=ABSENT)
    camera_model: _LensName = Field(default=ABSENT)
    fisheye_model: Annotated[int, Field(ge=0, le=1)] = Field(default=ABSENT)
    binning_x: _Binning = 0
    binning_y: _Binning = 0
    camera_from_frame: Matrix44 = Field(default=ABSENT)
    frame: Text = CAMERA_FRAME

    @model_validator(mode="after")
    def _names_one_lens(self) -> CalibrationRecord:
        names = self.lens_names
        if len({LENSES[name][0] for name in names.values()}) > 1:
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
    pair = {name for side in _PAIR.values() for names in side.values() for name in names}
    keys = set(document)
    return bool(sure & keys) or any(len(some & keys) > 1 for some in (long, pair, {"K", "width"}))


def read_document(data: bytes, path: str | Path) -> dict[str, Any]:
    """Return the keys of a FileStorage, of a YAML file, or of the first of several messages.

    Raises BadFile if it cannot be parsed.
    """
    if looks_like_storage(data):
        return parse_storage(data, path)
    parts = [part for part in _BETWEEN.split(data) if _CONTENT.search(part)]
    return parse_mapping(parts[0] if parts else data, path)


_BETWEEN = re.compile(rb"^---[ \t]*\r?$", re.MULTILINE)
_CONTENT = re.compile(rb"^[ \t]*[^\s#]", re.MULTILINE)


def parse_calibration(data: bytes, path: str | Path) -> dict[str, CameraFile]:
    """Return the camera of OpenCV's or ROS's file as ``camera``, or the pair ``left`` and ``right``.

    Raises BadFile if one is no camera: which key, what it holds, what is expected.
    """
    document = read_document(data, path)
    keys = dict(document)
    if (
        isinstance(size := keys.get("cameraResolution"), list)
        and len(size) == 2
        and not {"image_width", "image_height", "width", "height"} & set(keys)
    ):
        keys |= {"image_width": size[0], "image_height": size[1]}
    digest = digest_of(data)
    if not any(key in keys for side in _PAIR.values() for key in side["camera_matrix"]):
        return {"camera": _calibration(keys, path, digest, _OTHER_NAMES)}
    of_pair = [name for side in _PAIR.values() for names in side.values() for name in names]
    found: dict[str, CameraFile] = {}
    for side, names in _PAIR.items():
        others = set(of_pair) - {name for some in names.values() for name in some}
        mine = {key: value for key, value in keys.items() if key not in others}
        found[side] = _calibration(mine, path, digest, _OTHER_NAMES | names)
    return found


def _calibration(
    keys: Mapping[str, Any], path: str | Path, digest: str, other_names: Mapping[str, tuple[str, ...]]
) -> CameraFile:
    """The camera of a mapping."""
    record, source = read_foreign(
        CalibrationRecord, keys, path, "", other_names, ignored=_IGNORED, remedies=_REMEDIES
    )
    lens: LensName = next(iter(record.lens_names.values()), "pinhole")
    distortion = coefficients(source, "distortion_coefficients", lens, record.distortion_coefficients)
    pose = Rigid.identity()
    if record.camera_from_frame is not None:
        pose = pose_of(source, "camera_from_frame", record.camera_from_frame).inverse
    matrix = np.reshape(record.camera_matrix, (3, 3))
    size_px = record.image_width, record.image_height
    return lens_camera(source, LENSES[lens][0], size_px, matrix, distortion, pose, record.frame, digest)


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
        "camera_from_frame": matrix44(lens_pose(camera).inverse),
    }
    for key, value in keys.items():
        storage.write(key, value)
    return storage.releaseAndGetString().encode()

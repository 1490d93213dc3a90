"""The mast file (``mastctl/mast/1``) and the camera file (``mastctl/camera/1``): strict in, atomic out.

Contract section 2. A and O are normalised on load; a note says so when that moves a pixel by more than
0.01. The digest of a file is the SHA-256 of its bytes. The version before a save is kept as
``NAME.previous.yaml`` (see `calib.files`).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, WithJsonSchema, model_validator

from calib.errors import BadFile
from calib.files import (
    LARGEST_IMAGE_PX,
    CameraFile,
    blind_notes,
    build_model,
    digest_of,
    read_bytes,
    save_bytes,
)
from calib.files.records import ABSENT, Free, Number, Pair, Record, Text, Vector, parse_record, problem, when
from calib.files.yaml_text import MAX_BYTES, dump_mapping, kind_of
from calib.geometry.cahvor import COEFFICIENTS, FREE, KINDS, CameraModel, Kind
from calib.geometry.mode import FLIPS, FlipName, SensorMode, flip_name
from calib.geometry.rig import MOST_HARMONICS, AxisJoint, JointErrors, Mast, Rig, RigCamera

MAST_SCHEMA = "mastctl/mast/1"
CAMERA_SCHEMA = "mastctl/camera/1"

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")

_Size = Annotated[int, Field(ge=1, le=LARGEST_IMAGE_PX)]
SizePx = Annotated[list[_Size], Field(min_length=2, max_length=2)]
"""Width and height of an image."""
_Offset = Annotated[int, Field(ge=0, le=LARGEST_IMAGE_PX)]
_Turn = Annotated[float, Field(ge=-1.001, le=1.001)]
_TurnRow = Annotated[list[_Turn], Field(min_length=3, max_length=3)]
_Coefficient = Annotated[float, Field(ge=-1e6, le=1e6)]


def _named(name: str) -> str:
    if not _NAME.fullmatch(name):
        raise problem("", "a camera's or pair's name is letters, digits, '_' and '-'")
    return name


def _pair(names: object) -> object:
    if not isinstance(names, list) or len(names) != 2 or not all(isinstance(name, str) for name in names):
        raise problem("", f"{kind_of(names)} where [left camera, right camera] is expected")
    for name, side in zip(names, ("_left", "_right"), strict=True):
        if not name.endswith(side):
            raise problem("", f"'{name}' where a camera named ...{side} is expected")
    return names


_NAMED = WithJsonSchema({"type": "string", "pattern": f"^{_NAME.pattern}$"})
CameraName = Annotated[str, AfterValidator(_named), _NAMED]
"""``<pair>_left`` and ``<pair>_right`` for the cameras of a pair; a pair, or a single camera, has no side."""
_SIDES = [{"type": "string", "pattern": "_left$"}, {"type": "string", "pattern": "_right$"}]
_Pair = Annotated[
    Any,
    AfterValidator(_pair),
    WithJsonSchema({"type": "array", "minItems": 2, "maxItems": 2, "prefixItems": _SIDES}),
]


class SensorModeRecord(Record):
    """``sensor_mode`` of a camera."""

    flip: FlipName = Field(description="how the camera turns its pictures")
    sensor_px: SizePx = Field(default=ABSENT, description="all that the sensor can give")
    crop_px: Annotated[list[_Offset], Field(min_length=4, max_length=4)] = Field(
        default=ABSENT, description="the part that makes a picture"
    )


_OPENCV_KEYS = ("camera_matrix", "distortion", "rotation")
_CAHVORE_KEYS = (*"AHVORE", "type", "linearity")


def _keys_of(kind: str) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Keys that a kind of camera needs, that it may have as zeros only, and that it must not have."""
    if kind in COEFFICIENTS:
        return _OPENCV_KEYS, (), _CAHVORE_KEYS
    needed = tuple(letter for letter in "AHVORE" if letter in kind)
    if kind == "CAHVORE":
        return (*needed, "type"), (), _OPENCV_KEYS
    return needed, tuple(set("RE") - set(kind)), ("type", "linearity", *_OPENCV_KEYS)


def _schema_by_kind(schema: dict[str, Any]) -> None:
    """Add to a camera's JSON Schema which keys go with which kind."""
    cases = []
    for kind in KINDS:
        needed, zeros, refused = _keys_of(kind)
        keys: dict[str, Any] = {key: {"items": {"const": 0}} for key in sorted(zeros)}
        keys |= dict.fromkeys(refused, False)
        if kind in COEFFICIENTS:
            keys["distortion"] = {"minItems": COEFFICIENTS[kind], "maxItems": COEFFICIENTS[kind]}
        cases.append(when("model", kind, {"properties": keys, "required": list(needed)}))
    schema["allOf"] = [*cases, when("type", 3, {"required": ["linearity"]})]


class CameraRecord(Record, json_schema_extra=_schema_by_kind):
    """The keys of one camera model."""

    size_px: SizePx
    model: Kind = Field(description="the family of its lens")
    C: Vector = Field(description="projection center")
    A: Vector = Field(default=ABSENT, description="unit vector along the optical axis")
    H: Vector = Field(default=ABSENT, description="image columns and rows")
    V: Vector = Field(default=ABSENT, description="image columns and rows")
    O: Vector = Field(default=ABSENT, description="unit vector, axis of the distortion")  # noqa: E741
    R: Vector = Field(default=ABSENT, description="radial distortion")
    E: Vector = Field(default=ABSENT, description="moving entrance pupil")
    type: Annotated[int, Field(ge=1, le=3)] = Field(
        default=ABSENT, description="perspective, fisheye, general"
    )
    linearity: Annotated[float, Field(ge=-100.0, le=100.0)] = Field(default=ABSENT)
    camera_matrix: Annotated[list[Vector], Field(min_length=3, max_length=3)] = Field(
        default=ABSENT, description="[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]"
    )
    distortion: list[_Coefficient] = Field(
        default=ABSENT,
        description="k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 τx τy, as many as the model's name says; "
        "OPENCV_FISHEYE: k1 k2 k3 k4 of cv2.fisheye",
    )
    rotation: Annotated[list[_TurnRow], Field(min_length=3, max_length=3)] = Field(
        default=ABSENT,
        description="OpenCV's R: rows are the camera's x right, y down and z ahead in the frame of on",
    )

    @model_validator(mode="before")
    @classmethod
    def _has_no_keys_of_other_kinds(cls, keys: Any) -> Any:
        kind = keys.get("model") if isinstance(keys, dict) else None
        for key in _keys_of(kind)[2] if kind in KINDS else ():
            if key in keys:
                raise problem(key, f"{kind} has no '{key}'; another 'model' has it")
        return keys

    @model_validator(mode="after")
    def _has_the_keys_of_its_kind(self) -> CameraRecord:
        kind, count = self.model, COEFFICIENTS.get(self.model)
        needed, zeros, _ = _keys_of(kind)
        for key in needed:
            if key not in self.model_fields_set:
                raise problem(key, f"the key is missing; {kind} has it")
        for key in zeros:
            if any(getattr(self, key) or ()):
                raise problem(key, f"{kind} has no {key}; expected zeros or another 'model'")
        if count is not None and len(self.distortion) != count:
            reason = f"{kind_of(self.distortion)} where a list of {count} numbers is expected"
            raise problem("distortion", reason)
        if self.type == 3 and self.linearity is None:
            raise problem("linearity", "the key is missing; CAHVORE type 3 has it")
        return self


class RigCameraRecord(CameraRecord, json_schema_extra=_schema_by_kind):
    """A camera of a mast file."""

    on: Literal["head", "rover"] = Field(description="the frame of its vectors")
    sensor_mode: SensorModeRecord = Field(
        default=ABSENT,
        description="which pixels of the sensor the calibrated pictures show: the daemon compares it",
    )


class CameraFileRecord(CameraRecord, json_schema_extra=_schema_by_kind):
    """A camera file."""

    schema_: Literal["mastctl/camera/1"] = Field(alias="schema")
    frame: Text
    fit: Free = Field(default={})
    provenance: Free = Field(default={})


class MastRecord(Record):
    """The numbers of the mast."""

    translation_m: Vector = Field(description="t: from the rover frame's origin to the mast's")
    rotation_rad: Vector = Field(description="θx, θy, θz")
    axis_offset_m: Number = Field(default=0.0, description="a: distance between the two axes")
    axis_twist_rad: Number = Field(default=0.0, description="k: angle of the tilt axis to the horizontal")


class AxisRecord(Record):
    """Errors of one joint's readings."""

    harmonics_rad: Annotated[list[Pair], Field(max_length=MOST_HARMONICS)] = Field(
        default=[], description="true = read + Σ (c_i cos(i read) + s_i sin(i read))"
    )
    backlash_rad: Annotated[float, Field(ge=0.0, le=1e9)] = Field(
        default=0.0,
        description="full width of the play: half of it is subtracted from the reading of an axis that came "
        "from smaller angles, and added from larger ones",
    )

    @property
    def joint(self) -> AxisJoint:
        """The joint. Raises ValueError as `AxisJoint`."""
        return AxisJoint(tuple((c, s) for c, s in self.harmonics_rad), self.backlash_rad)


class JointsRecord(Record):
    """Errors of both joints' readings."""

    pan: AxisRecord = Field(default=AxisRecord())
    tilt: AxisRecord = Field(default=AxisRecord())

    @model_validator(mode="after")
    def _are_joints(self) -> JointsRecord:
        for axis in ("pan", "tilt"):
            try:
                _ = getattr(self, axis).joint
            except ValueError as error:
                raise problem(axis, str(error)) from None
        return self


class StereoRecord(Record):
    """The key ``stereo`` of a file, which names cameras of the key ``cameras`` of a class that adds it."""

    stereo: dict[CameraName, _Pair] = Field(default={}, description="the cameras of each pair")

    @property
    def pairs(self) -> dict[str, tuple[str, str]]:
        """The left and right cameras of each pair."""
        return {pair: (left, right) for pair, (left, right) in self.stereo.items()}

    @model_validator(mode="after")
    def _has_the_cameras_of_its_pairs(self) -> StereoRecord:
        cameras: dict[str, Any] = getattr(self, "cameras", {})
        for pair, name in ((pair, name) for pair, names in self.stereo.items() for name in names):
            if name not in cameras:
                known = ", ".join(cameras) or "none"
                raise problem(f"stereo.{pair}", f"'{name}' is no camera of this file; there are {known}")
        return self


class MastFileRecord(StereoRecord):
    """A mast file."""

    schema_: Literal["mastctl/mast/1"] = Field(alias="schema")
    name: Text
    mast: MastRecord
    cameras: dict[CameraName, RigCameraRecord] = Field(
        description="cameras by name: <pair>_left and <pair>_right; one alone has a name without a side"
    )
    joints: JointsRecord = Field(
        default=JointsRecord(), description="errors of the head's readings: Read and true angles"
    )
    fit: Free = Field(default={}, description="residuals, covariance with its parameter order")
    provenance: Free = Field(default={}, description="origin of the file")


@dataclass(frozen=True, eq=False)
class StoredRig:
    """A rig as a mast file holds it: with the digest of the bytes, and sentences for the user."""

    rig: Rig
    digest: str
    path: Path
    notes: tuple[str, ...]


def load_rig(path: str | Path) -> StoredRig:
    """Read a mast file.

    Raises BadFile if it cannot be read or is no valid mast file: which key, what it holds, what is expected.
    """
    return parse_rig(read_bytes(path, MAX_BYTES), path)


def parse_rig(data: bytes, path: str | Path) -> StoredRig:
    """Read a mast file's bytes; ``path`` is for messages only. Raises BadFile as ``load_rig``."""
    record = parse_record(MastFileRecord, data, path, MAST_SCHEMA)
    cameras: dict[str, RigCamera] = {}
    notes: tuple[str, ...] = ()
    for name, camera in record.cameras.items():
        place = f"cameras.{name}"
        model, camera_notes = _model(camera, path, place)
        mode = camera.sensor_mode
        sensor_mode = sensor_mode_of(mode, model.size_px, path, place)
        cameras[name] = RigCamera(camera.on, model, sensor_mode)
        notes += camera_notes
    mast = record.mast
    rig = Rig(
        name=record.name,
        mast=Mast(
            np.array(mast.translation_m),
            np.array(mast.rotation_rad),
            mast.axis_offset_m,
            mast.axis_twist_rad,
        ),
        cameras=cameras,
        stereo=record.pairs,
        fit=record.fit,
        provenance=record.provenance,
        joints=JointErrors(record.joints.pan.joint, record.joints.tilt.joint),
    )
    return StoredRig(rig, digest_of(data), Path(path), notes)


def save_rig(rig: Rig, path: str | Path) -> StoredRig:
    """Save a mast file atomically, keep the version before it, and return what a reader will find.

    Raises BadFile if the rig is none that the file can hold, or the file system refuses; then nothing has
    changed.
    """
    mast = rig.mast
    document: dict[str, Any] = {
        "schema": MAST_SCHEMA,
        "name": rig.name,
        "mast": {
            "translation_m": mast.translation_m,
            "rotation_rad": mast.rotation_rad,
            "axis_offset_m": float(mast.axis_offset_m),
            "axis_twist_rad": float(mast.axis_twist_rad),
        },
        "cameras": {
            name: {"on": camera.on, **model_keys(camera.model), **sensor_mode_keys(camera.sensor_mode)}
            for name, camera in rig.cameras.items()
        },
        "stereo": rig.stereo,
        **({} if rig.joints == JointErrors() else {"joints": joint_keys(rig.joints)}),
        "fit": rig.fit,
        "provenance": rig.provenance,
    }
    data = _dump(document, path)
    stored = parse_rig(data, path)
    save_bytes(path, data)
    return stored


def parse_camera(data: bytes, path: str | Path) -> CameraFile:
    """Read a camera file's bytes; ``path`` is for messages only. Raises BadFile as ``load_rig``."""
    record = parse_record(CameraFileRecord, data, path, CAMERA_SCHEMA)
    model, notes = _model(record, path, "")
    return CameraFile(model, record.frame, record.fit, record.provenance, notes, Path(path))


def save_camera(camera: CameraFile, path: str | Path) -> CameraFile:
    """Save a camera file atomically and return what a reader will find. Raises BadFile as ``save_rig``."""
    document: dict[str, Any] = {"schema": CAMERA_SCHEMA, "frame": camera.frame, **model_keys(camera.model)}
    for key in ("fit", "provenance"):
        if getattr(camera, key):
            document[key] = getattr(camera, key)
    data = _dump(document, path)
    stored = parse_camera(data, path)
    save_bytes(path, data)
    return stored


def _model(record: CameraRecord, path: str | Path, place: str) -> tuple[CameraModel, tuple[str, ...]]:
    """The camera of a record, with notes for the user."""
    size_px = record.size_px[0], record.size_px[1]
    if record.model in FREE:
        model, notes = _opencv_model(record, size_px, path, place)
        return model, (*notes, *blind_notes(model, path, place))
    vectors = {letter: getattr(record, letter) for letter in record.model}
    return build_model(path, place, record.model, size_px, vectors, record.type or 0, record.linearity)


def _opencv_model(
    record: CameraRecord, size_px: tuple[int, int], path: str | Path, place: str
) -> tuple[CameraModel, tuple[str, ...]]:
    """A camera of OpenCV's families; a rotation of few digits is made one."""

    def at(key: str) -> str:
        return f"{place}.{key}" if place else key

    matrix, given = np.array(record.camera_matrix), np.array(record.rotation)
    rotation, notes = given, tuple[str, ...]()
    if np.abs(given @ given.T - np.eye(3)).max() > 1e-15:
        turn, _, other = np.linalg.svd(given)
        rotation = turn @ other
    off = float(np.abs(rotation - given).max())
    if not off < 1e-3 or np.linalg.det(rotation) < 0.0:
        raise BadFile(path, at("rotation"), f"{given.tolist()} where a rotation is expected")
    try:
        model = CameraModel.of_matrix(record.model, size_px, matrix, record.distortion, rotation, record.C)
    except (ValueError, ArithmeticError) as error:
        raise BadFile(path, place, f"is no usable camera: {error}") from None
    if not model.project(model.C + model.A)[1]:
        raise BadFile(path, at("distortion"), "the lens folds at its axis: no image can be formed")
    if (shift_px := off * max(abs(matrix[0, 0]), abs(matrix[1, 1]))) > 0.01:
        notes = (f"{place or 'camera'}: 'rotation' made one, which moves pixels by up to {shift_px:.2g} px",)
    return model, notes


def model_keys(model: CameraModel) -> dict[str, Any]:
    """Return one camera model's keys in the order of docs/reference/configuration.md."""
    keys: dict[str, Any] = {"size_px": list(model.size_px), "model": model.kind}
    if model.kind in FREE:
        return keys | {"C": model.C, **{key: getattr(model, key) for key in _OPENCV_KEYS}}
    keys.update({letter: getattr(model, letter) for letter in model.letters})
    if model.kind == "CAHVORE":
        keys.update(type=int(model.cahvore_type), linearity=float(model.linearity))
    return keys


def sensor_mode_of(
    record: SensorModeRecord | None, size_px: tuple[int, int], path: str | Path, place: str
) -> SensorMode | None:
    """Return a camera's sensor mode; None without. Raises BadFile if the crop is not inside the sensor."""
    if record is None:
        return None
    crop: Any = tuple(record.crop_px) if record.crop_px else None
    sensor: Any = tuple(record.sensor_px) if record.sensor_px else None
    try:
        return SensorMode(size_px, crop, sensor, FLIPS[record.flip])
    except ValueError as error:
        raise BadFile(path, f"{place}.sensor_mode", str(error)) from None


def sensor_mode_keys(mode: SensorMode | None) -> dict[str, Any]:
    """Return a camera's ``sensor_mode`` as files and answers have it, without the size; empty for None."""
    if mode is None:
        return {}
    keys: dict[str, Any] = {"flip": flip_name(mode.flip)}
    if mode.crop_px is not None and mode.sensor_px is not None:
        keys = {"sensor_px": list(mode.sensor_px), "crop_px": list(mode.crop_px), **keys}
    return {"sensor_mode": keys}


def joint_keys(joints: JointErrors) -> dict[str, Any]:
    """Return both joints' keys in the order of docs/reference/configuration.md."""
    return {
        name: {
            "harmonics_rad": [[float(part) for part in pair] for pair in axis.harmonics_rad],
            "backlash_rad": float(axis.backlash_rad),
        }
        for name, axis in (("pan", joints.pan), ("tilt", joints.tilt))
    }


def _dump(document: dict[str, Any], path: str | Path) -> bytes:
    try:
        return dump_mapping(document)
    except (TypeError, UnicodeEncodeError, RecursionError) as error:
        raise BadFile(path, "", f"cannot hold this: {error}") from None

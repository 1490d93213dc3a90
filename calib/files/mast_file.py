"""The mast file (``mastctl/mast/1``) and the camera file (``mastctl/camera/1``): strict in, atomic out.

Contract section 2. A and O are normalised on load; a note says so when that moves a pixel by more than
0.01. The digest of a file is the SHA-256 of its bytes. The version before a save is kept as
``NAME.previous.yaml`` (see `calib.files.atomic`).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from calib.errors import BadFile
from calib.files import (
    LARGEST_IMAGE_PX,
    TOLD_SHIFT_PX,
    CameraFile,
    blind_notes,
    build_model,
    digest_of,
    read_bytes,
)
from calib.files.atomic import save_bytes
from calib.files.yaml_text import MAX_BYTES, Section, dump_mapping, kind_of, parse_mapping
from calib.geometry.cahvor import COEFFICIENTS, FREE, KINDS, SPLINED, CameraModel, Kind
from calib.geometry.lenses.spline import SplineGrid
from calib.geometry.rig import MOST_HARMONICS, AxisJoint, JointErrors, Mast, Rig, RigCamera
from calib.geometry.sensor_mode import FLIPS, FlipName, SensorMode, flip_name

MAST_SCHEMA = "mastctl/mast/1"
CAMERA_SCHEMA = "mastctl/camera/1"

CAMERA_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
"""``<pair>_left`` and ``<pair>_right`` for the cameras of a pair; a single camera has no side."""
CAMERA_NAME_WORDS = "a camera's name is letters, digits, '_' and '-'"
_PAIR_NAME = CAMERA_NAME
_ROUNDED, _NO_ROTATION = 1e-15, 1e-3
_MODEL_KEYS = ("size_px", "model", "C")
CAHVORE_KEYS = ("A", "H", "V", "O", "R", "E", "type", "linearity")
OPENCV_KEYS = ("camera_matrix", "distortion", "rotation")
_MODEL_OPTIONS = (*CAHVORE_KEYS, *OPENCV_KEYS, "spline")


@dataclass(frozen=True, eq=False)
class StoredRig:
    """A rig as a mast file holds it: with the digest of the bytes, and sentences for the user."""

    rig: Rig
    digest: str
    path: Path
    notes: tuple[str, ...]


def load_rig(path: str | Path) -> StoredRig:
    """Read a mast file.

    Raises
    ------
    BadFile
        If it cannot be read or is no valid mast file: which key, what it holds, what is expected.
    """
    return parse_rig(read_bytes(path, MAX_BYTES), path)


def parse_rig(data: bytes, path: str | Path) -> StoredRig:
    """Read a mast file's bytes; ``path`` is for messages only. Raises BadFile as ``load_rig``."""
    document = parse_mapping(data, path)
    _check_schema(document, path, MAST_SCHEMA)
    optional: tuple[str, ...] = ("stereo", "joints", "fit", "provenance")
    top = Section(path, "", document, ("schema", "name", "mast", "cameras"), optional)
    mast = top.section("mast", ("translation_m", "rotation_rad"), ("axis_offset_m", "axis_twist_rad"))
    cameras: dict[str, RigCamera] = {}
    notes: tuple[str, ...] = ()
    for name in top.mapping("cameras"):
        if not CAMERA_NAME.fullmatch(name):
            raise top.bad(f"cameras.{name}", CAMERA_NAME_WORDS)
        place = f"cameras.{name}"
        optional = (*_MODEL_OPTIONS, "sensor_mode")
        section = Section(path, place, top.mapping("cameras")[name], ("on", *_MODEL_KEYS), optional)
        on = cast(Literal["head", "rover"], section.choice("on", ("head", "rover")))
        model, camera_notes = _model(section)
        cameras[name] = RigCamera(on, model, read_sensor_mode(section, model.size_px))
        notes += camera_notes
    rig = Rig(
        name=top.text("name"),
        mast=Mast(
            translation_m=mast.vector("translation_m"),
            rotation_rad=mast.vector("rotation_rad"),
            axis_offset_m=mast.number("axis_offset_m") if "axis_offset_m" in mast else 0.0,
            axis_twist_rad=mast.number("axis_twist_rad") if "axis_twist_rad" in mast else 0.0,
        ),
        cameras=cameras,
        stereo=read_stereo(top, cameras),
        fit=top.free("fit"),
        provenance=top.free("provenance"),
        joints=_joints(top.section("joints", (), ("pan", "tilt"))) if "joints" in top else JointErrors(),
    )
    return StoredRig(rig, digest_of(data), Path(path), notes)


def save_rig(rig: Rig, path: str | Path) -> StoredRig:
    """Save a mast file atomically, keep the version before it, and return what a reader will find.

    Raises
    ------
    BadFile
        If the rig is none that the file can hold, or the file system refuses; then nothing has changed.
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
            name: {"on": camera.on, **_model_keys(camera.model), **sensor_mode_keys(camera.sensor_mode)}
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


def load_camera(path: str | Path) -> CameraFile:
    """Read a camera file (``mastctl/camera/1``). Raises BadFile as ``load_rig``."""
    return parse_camera(read_bytes(path, MAX_BYTES), path)


def parse_camera(data: bytes, path: str | Path) -> CameraFile:
    """Read a camera file's bytes; ``path`` is for messages only. Raises BadFile as ``load_rig``."""
    document = parse_mapping(data, path)
    _check_schema(document, path, CAMERA_SCHEMA)
    top = Section(
        path, "", document, ("schema", "frame", *_MODEL_KEYS), (*_MODEL_OPTIONS, "fit", "provenance")
    )
    model, notes = _model(top)
    return CameraFile(
        model=model,
        frame=top.text("frame"),
        fit=top.free("fit"),
        provenance=top.free("provenance"),
        notes=notes,
        path=Path(path),
        digest=digest_of(data),
    )


def save_camera(camera: CameraFile, path: str | Path) -> CameraFile:
    """Save a camera file atomically and return what a reader will find. Raises BadFile as ``save_rig``."""
    document: dict[str, Any] = {"schema": CAMERA_SCHEMA, "frame": camera.frame, **_model_keys(camera.model)}
    for key in ("fit", "provenance"):
        if getattr(camera, key):
            document[key] = getattr(camera, key)
    data = _dump(document, path)
    stored = parse_camera(data, path)
    save_bytes(path, data)
    return stored


def _check_schema(document: dict[str, Any], path: str | Path, expected: str) -> None:
    """Refuse another schema before its keys are looked at."""
    if "schema" not in document:
        raise BadFile(path, "schema", f"the key is missing; 'schema: {expected}' is expected")
    if document["schema"] != expected:
        raise BadFile(path, "schema", f"{kind_of(document['schema'])} where '{expected}' is expected")


def _model(section: Section) -> tuple[CameraModel, tuple[str, ...]]:
    """Read the keys of one camera model."""
    kind = cast(Kind, section.choice("model", KINDS))
    size = section.integers("size_px", 2, 1, LARGEST_IMAGE_PX)
    opencv = kind in FREE
    for key in (*(CAHVORE_KEYS if opencv else OPENCV_KEYS), *(("spline",) if kind != SPLINED else ())):
        if key in section:
            raise section.bad(key, f"{kind} has no '{key}'; another 'model' has it")
    if opencv:
        model, notes = build_opencv(section, kind, (size[0], size[1]))
        return model, (*notes, *blind_notes(model, section.path, section.place))
    letters = str(kind)
    for letter in letters:
        if letter not in section:
            raise section.bad(letter, f"the key is missing; {kind} has it")
    vectors = {letter: section.vector(letter) for letter in letters}
    for letter in "ORE":
        # A vector that the kind has no use for is harmless only while it says nothing.
        if letter not in letters and letter in section and section.vector(letter).any() and letter != "O":
            raise section.bad(letter, f"{kind} has no {letter}; expected zeros or another 'model'")
    cahvore_type, linearity = 0, None
    if kind == "CAHVORE":
        if "type" not in section:
            raise section.bad("type", "the key is missing; CAHVORE has type 1, 2 or 3")
        cahvore_type = section.integer("type", 1, 3)
        linearity = section.number("linearity", 100.0) if "linearity" in section else None
        if cahvore_type == 3 and linearity is None:
            raise section.bad("linearity", "the key is missing; CAHVORE type 3 has it")
    else:
        for key in ("type", "linearity"):
            if key in section:
                raise section.bad(key, f"{kind} has no '{key}'; CAHVORE has it")
    return build_model(
        section.path, section.place, kind, (size[0], size[1]), vectors, cahvore_type, linearity
    )


def build_opencv(
    section: Section, kind: Kind, size_px: tuple[int, int]
) -> tuple[CameraModel, tuple[str, ...]]:
    """Return the camera of a section with ``camera_matrix``, ``distortion``, ``rotation`` and ``C``.

    A rotation of few digits is made one, with a note if that moves a pixel by more than 0.01.

    Raises
    ------
    BadFile
        If a key is missing or the numbers are no camera.
    """
    for key in (*OPENCV_KEYS, *(("spline",) if kind == SPLINED else ())):
        if key not in section:
            raise section.bad(key, f"the key is missing; {kind} has it")
    matrix = section.rows("camera_matrix", 3, 3)
    given = section.rows("rotation", 3, 3, 1.001)
    grid = _spline(section) if kind == SPLINED else None
    count = COEFFICIENTS[kind] if grid is None else 2 * grid.columns * grid.rows
    distortion = section.vector("distortion", 1e6, count)
    rotation, notes = given, tuple[str, ...]()
    if np.abs(given @ given.T - np.eye(3)).max() > _ROUNDED:
        turn, _, other = np.linalg.svd(given)
        rotation = turn @ other
    off = float(np.abs(rotation - given).max())
    if not off < _NO_ROTATION or np.linalg.det(rotation) < 0.0:
        raise section.bad("rotation", f"{given.tolist()} where a rotation is expected")
    try:
        model = CameraModel.of_matrix(kind, size_px, matrix, distortion, rotation, section.vector("C"), grid)
    except (ValueError, ArithmeticError) as error:
        raise section.bad("", f"is no usable camera: {error}") from None
    if not model.project(model.C + model.A)[1]:
        raise section.bad("distortion", "the lens folds at its axis: no image can be formed")
    if (shift_px := off * max(abs(matrix[0, 0]), abs(matrix[1, 1]))) > TOLD_SHIFT_PX:
        where = section.place or "camera"
        notes = (f"{where}: 'rotation' made one, which moves pixels by up to {shift_px:.2g} px",)
    return model, notes


def _spline(section: Section) -> SplineGrid:
    """Read how a camera's control points stand."""
    inner = section.section("spline", ("order", "columns", "rows", "fov_x_deg"))
    columns, rows = (inner.integer(key, 3, 1000) for key in ("columns", "rows"))
    try:
        return SplineGrid(inner.integer("order", 2, 3), columns, rows, inner.number("fov_x_deg", 360.0))
    except ValueError as error:
        raise section.bad("spline", str(error)) from None


def _model_keys(model: CameraModel) -> dict[str, Any]:
    """Return one camera model's keys in the order of docs/reference/configuration.md."""
    keys: dict[str, Any] = {"size_px": list(model.size_px), "model": model.kind}
    if model.spline is not None:
        keys["spline"] = asdict(model.spline)
    if model.kind in FREE:
        return keys | {"C": model.C, **{key: getattr(model, key) for key in OPENCV_KEYS}}
    keys.update({letter: getattr(model, letter) for letter in model.letters})
    if model.kind == "CAHVORE":
        keys.update(type=int(model.cahvore_type), linearity=float(model.linearity))
    return keys


def read_sensor_mode(camera: Section, size_px: tuple[int, int]) -> SensorMode | None:
    """Return the ``sensor_mode`` of a camera whose pictures are (width, height); None where it has none.

    Raises
    ------
    BadFile
        If a key is missing or the crop is not inside the sensor.
    """
    if "sensor_mode" not in camera:
        return None
    section = camera.section("sensor_mode", ("flip",), ("sensor_px", "crop_px"))
    flip = FLIPS[cast(FlipName, section.choice("flip", tuple(FLIPS)))]
    crop: Any = section.integers("crop_px", 4, 0, LARGEST_IMAGE_PX) if "crop_px" in section else None
    sensor: Any = section.integers("sensor_px", 2, 1, LARGEST_IMAGE_PX) if "sensor_px" in section else None
    try:
        return SensorMode(size_px, crop, sensor, flip)
    except ValueError as error:
        raise camera.bad("sensor_mode", str(error)) from None


def sensor_mode_keys(mode: SensorMode | None) -> dict[str, Any]:
    """Return a camera's ``sensor_mode`` as files and answers have it, without the size; empty for None."""
    if mode is None:
        return {}
    keys: dict[str, Any] = {"flip": flip_name(mode.flip)}
    if mode.crop_px is not None and mode.sensor_px is not None:
        keys = {"sensor_px": list(mode.sensor_px), "crop_px": list(mode.crop_px), **keys}
    return {"sensor_mode": keys}


def _joints(section: Section) -> JointErrors:
    """Read what the joints' readings are wrong by; an axis that is not there reads true."""
    axes: dict[str, AxisJoint] = {}
    for axis in section.values:
        one = section.section(axis, (), ("harmonics_rad", "backlash_rad"))
        pairs = one.pairs("harmonics_rad", MOST_HARMONICS) if "harmonics_rad" in one else ()
        backlash = one.number("backlash_rad") if "backlash_rad" in one else 0.0
        if backlash < 0.0:
            raise one.bad("backlash_rad", f"{backlash:g} where a width of 0 rad or more is expected")
        try:
            axes[axis] = AxisJoint(pairs, backlash)
        except ValueError as error:
            raise section.bad(axis, str(error)) from None
    return JointErrors(**axes)


def joint_keys(joints: JointErrors) -> dict[str, Any]:
    """Return both joints' keys in the order of docs/reference/configuration.md."""
    return {
        name: {
            "harmonics_rad": [[float(part) for part in pair] for pair in axis.harmonics_rad],
            "backlash_rad": float(axis.backlash_rad),
        }
        for name, axis in (("pan", joints.pan), ("tilt", joints.tilt))
    }


def read_stereo(top: Section, cameras: Mapping[str, object]) -> dict[str, tuple[str, str]]:
    """Return the stereo pairs under ``stereo``: (left, right) names of cameras that are there.

    Raises
    ------
    BadFile
        For a pair that is not two known cameras, left and right.
    """
    pairs: dict[str, tuple[str, str]] = {}
    for pair, names in top.mapping("stereo").items():
        key = f"stereo.{pair}"
        if not _PAIR_NAME.fullmatch(pair):
            raise top.bad(key, "a pair's name is letters, digits, '_' and '-'")
        if not isinstance(names, list) or len(names) != 2 or not all(isinstance(n, str) for n in names):
            raise top.bad(key, f"{kind_of(names)} where [left camera, right camera] is expected")
        for name, side in zip(names, ("_left", "_right"), strict=True):
            if name not in cameras:
                raise top.bad(
                    key, f"'{name}' is no camera of this file; there are {', '.join(cameras) or 'none'}"
                )
            if not name.endswith(side):
                raise top.bad(key, f"'{name}' where a camera named ...{side} is expected")
        pairs[pair] = (names[0], names[1])
    return pairs


def _dump(document: dict[str, Any], path: str | Path) -> bytes:
    try:
        return dump_mapping(document)
    except (TypeError, UnicodeEncodeError, RecursionError) as error:
        raise BadFile(path, "", f"cannot hold this: {error}") from None

"""One camera out of a file of any known format, recognized by content; written as one, with the losses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.errors import BadFile
from calib.files import CameraFile, read_bytes
from calib.files.atomic import save_bytes
from calib.files.cahvor_text import internal_parameters, looks_like_cahvor, parse_cahvor, save_cahvor
from calib.files.mast_file import CAMERA_SCHEMA, MAST_SCHEMA, StoredRig, parse_camera, parse_rig, save_camera
from calib.files.mrcal_kalibr_colmap import (
    format_colmap,
    format_kalibr,
    format_mrcal,
    looks_like_colmap,
    looks_like_kalibr,
    looks_like_mrcal,
    parse_colmap,
    parse_kalibr,
    parse_mrcal,
    refuse_mirrored,
)
from calib.files.opencv_ros import (
    format_camera_info,
    format_opencv,
    lens_pose,
    looks_like_camera_info,
    looks_like_opencv,
    parse_camera_info,
    parse_opencv,
    without_last_mark,
)
from calib.files.pds3 import MAX_FILE_BYTES, load_pds3_camera, looks_like_pds3
from calib.files.twin import (
    FISHEYE,
    GOOD_PX,
    TwinError,
    error_words,
    held_as,
    nearest_cahvor,
    nearest_opencv,
    nearest_square,
    twin_error,
)
from calib.files.yaml_text import parse_mapping
from calib.geometry.cahvor import FREE, SPLINED, CameraModel, Kind

KNOWN_FORMATS = (
    "a mast file, a camera file, a .cahvor file, a PDS3 label, OpenCV's or ROS's YAML, Kalibr's camchain, "
    "mrcal's .cameramodel or COLMAP's cameras.txt"
)

LIMIT_PX = 0.25
"""A conversion that moves a pixel by more than this is refused unless the caller sets another limit."""

_BY_SUFFIX = {
    ".cahvor": "cahvor",
    ".cameramodel": "mrcal",
    ".txt": "colmap",
    ".yaml": "mastctl",
    ".yml": "mastctl",
}
FORMATS = ("mastctl", "cahvor", "opencv", "ros", "kalibr", "mrcal", "colmap")

LENSES: dict[str, Kind] = {
    "radtan": "OPENCV4",
    "plumb_bob": "OPENCV5",
    "rational_polynomial": "OPENCV8",
    "thin_prism": "OPENCV12",
    "equidistant": FISHEYE,
    "tilted": "OPENCV14",
}
"""The lenses that can be asked for, by the kind that a camera then is."""

_OFFERED: dict[str, tuple[str, ...]] = {
    "opencv": ("plumb_bob", "rational_polynomial", "equidistant", "tilted"),
    "ros": ("plumb_bob", "rational_polynomial", "equidistant"),
    "kalibr": ("radtan", "equidistant"),
    "mrcal": ("cahvor", "plumb_bob", "rational_polynomial"),
    "colmap": ("radtan", "rational_polynomial", "equidistant"),
}
"""Each format's lenses that a camera of another family is fitted as, the plainest first."""

_HELD: dict[str, tuple[str, ...]] = {
    "opencv": ("radtan", "plumb_bob", "rational_polynomial", "thin_prism", "tilted", "equidistant"),
    "ros": ("plumb_bob", "rational_polynomial", "equidistant"),
    "kalibr": ("radtan", "equidistant"),
    "mrcal": ("radtan", "plumb_bob", "rational_polynomial", "thin_prism"),
    "colmap": ("radtan", "rational_polynomial", "equidistant"),
}
"""Each format's lenses that hold a camera of the same family as it is, the shortest first."""

_NO_POSE = {"ros": "a camera_info", "colmap": "a cameras.txt"}


@dataclass(frozen=True)
class CameraFiles:
    """Several cameras of one file, by name."""

    cameras: Mapping[str, CameraFile]
    path: Path


def load_any(path: str | Path) -> StoredRig | CameraFile | CameraFiles:
    """Read a mast file, or the camera (or cameras) of a file of any other known format.

    The content shows the format. Where it does not, the suffix decides which format's refusal helps most.

    Raises
    ------
    BadFile
        If the file is none of these, or is one but malformed.
    """
    data = read_bytes(path, MAX_FILE_BYTES)
    suffix = Path(path).suffix.lower()
    if looks_like_pds3(data) or suffix in (".lbl", ".img"):
        return load_pds3_camera(path)
    if looks_like_mrcal(data) or suffix == ".cameramodel":
        return parse_mrcal(data, path)
    document = _document(data)
    schema = document.get("schema")
    if schema == CAMERA_SCHEMA:
        return parse_camera(data, path)
    if schema == MAST_SCHEMA:
        return parse_rig(data, path)
    if looks_like_kalibr(document):
        return _one_or_all(parse_kalibr(data, path), path)
    if looks_like_camera_info(document):
        return parse_camera_info(data, path)
    if looks_like_opencv(data) or "camera_matrix" in document:
        return parse_opencv(data, path)
    if suffix in (".yaml", ".yml"):
        return parse_rig(data, path)
    if suffix == ".cahvor" or looks_like_cahvor(data):
        return parse_cahvor(data, path)
    if looks_like_colmap(data):
        return _one_or_all(parse_colmap(data, path), path)
    raise BadFile(path, "", f"is not {KNOWN_FORMATS}")


def _document(data: bytes) -> dict[str, object]:
    """The keys of a YAML file, none if the bytes are no YAML of ours or ROS's or Kalibr's."""
    try:
        return parse_mapping(without_last_mark(data.removeprefix(b"%YAML:1.0")), "")
    except BadFile:
        return {}


def _one_or_all(cameras: Mapping[str, CameraFile], path: str | Path) -> CameraFile | CameraFiles:
    return next(iter(cameras.values())) if len(cameras) == 1 else CameraFiles(cameras, Path(path))


@dataclass(frozen=True)
class Conversion:
    """What a conversion wrote.

    Attributes
    ----------
    path, format
        Where, and in which format.
    lost
        A sentence each: what the format could not hold.
    lens
        The lens of the format that was taken for each camera; empty where the format holds the model itself.
    errors
        How far each camera as written is from what it was made of; exact ones too.
    """

    path: Path
    format: str
    lost: tuple[str, ...]
    lens: tuple[str, ...] = ()
    errors: tuple[TwinError, ...] = ()

    @property
    def worst_px(self) -> float:
        """The largest of the errors; 0 where nothing was fitted."""
        return max((error.worst_px for error in self.errors), default=0.0)


def format_of(path: str | Path) -> str:
    """Return the format that a name asks for: by its suffix, or by the word before it (``left.ros.yaml``).

    Raises
    ------
    BadFile
        If the suffix is none of a known format.
    """
    suffixes = [suffix.lower() for suffix in Path(path).suffixes]
    if len(suffixes) > 1 and suffixes[-2][1:] in FORMATS:
        return suffixes[-2][1:]
    suffix = suffixes[-1] if suffixes else ""
    if suffix not in _BY_SUFFIX:
        raise BadFile(path, "", f"suffix '{suffix}' where {', '.join(_BY_SUFFIX)} is expected")
    return _BY_SUFFIX[suffix]


def save_any(
    camera: CameraFile | Mapping[str, CameraFile],
    path: str | Path,
    format: str = "",
    lens: str = "",
    limit_px: float = LIMIT_PX,
) -> Conversion:
    """Save a camera in the format named, else in the one that the file's name asks for (``format_of``).

    Parameters
    ----------
    camera
        One camera, or several by name for a format that holds several: ``kalibr``, ``colmap``.
    path
        The file.
    format
        One of ``FORMATS``; '' takes what the name asks for.
    lens
        The lens to take where the format has several (``radtan``, ``plumb_bob``, ``rational_polynomial``,
        ``equidistant``, ``tilted``, ``cahvor``); '' takes the plainest that comes near enough, else the one
        that comes nearest.
    limit_px
        The largest distance between a pixel of the camera and of what is written, anywhere in the image.

    Raises
    ------
    BadFile
        If the format or lens is unknown or cannot hold this, a pixel would move by more than ``limit_px``,
        or the file cannot be saved; then nothing has changed.
    """
    cameras = {"camera": camera} if isinstance(camera, CameraFile) else dict(camera)
    to = format or format_of(path)
    if to not in FORMATS:
        raise BadFile(path, "", f"format '{to[:20]}' where one of {', '.join(FORMATS)} is expected")
    if len(cameras) != 1 and to not in ("kalibr", "colmap"):
        raise BadFile(
            path, "", f"{len(cameras)} cameras where one is expected; kalibr and colmap hold several"
        )
    if len({one.frame for one in cameras.values()}) > 1 and to == "kalibr":
        raise BadFile(path, "", "the cameras are in several frames; a camchain places them in one")
    if to in ("mastctl", "cahvor"):
        if lens:
            raise BadFile(path, "", f"'{to}' holds the camera's own model; leave the lens out")
        ((name, only),) = cameras.items()
        if to == "mastctl":
            save_camera(only, path)
            return Conversion(Path(path), CAMERA_SCHEMA, ())
        twin, errors = _as_cahvor(name, only, path, limit_px)
        lost = save_cahvor(twin, path)
        return Conversion(Path(path), "cahvor", lost, (twin.model.kind,) if errors else (), errors)
    return _save_twins(cameras, path, to, lens, limit_px)


def _as_cahvor(
    name: str, camera: CameraFile, path: str | Path, limit_px: float
) -> tuple[CameraFile, tuple[TwinError, ...]]:
    """The camera, or its nearest twin of the CAHV family and how near that is."""
    if camera.model.kind not in FREE:
        return camera, ()
    try:
        with np.errstate(all="ignore"):
            model = nearest_cahvor(camera.model)
            error = twin_error(camera.model, model)
    except (ValueError, np.linalg.LinAlgError) as problem:
        raise BadFile(path, "", f"the camera has no twin in this format: {problem}") from None
    _hold(error, limit_px, f"'{name}' as {model.kind}", "", path)
    return replace(camera, model=model, fit={}), (error,)


def _hold(error: TwinError, limit_px: float, what: str, why: str, path: str | Path) -> None:
    if not error.worst_px <= limit_px:
        far = "does not see all of the image" if np.isinf(error.worst_px) else f"is {error_words(error)}"
        raise BadFile(path, "", f"{what} {far}; the limit is {limit_px:g} px{why}")


def _save_twins(
    cameras: Mapping[str, CameraFile], path: str | Path, to: str, lens: str, limit_px: float
) -> Conversion:
    """Write the nearest cameras that a format of other lenses holds."""
    offered = tuple(dict.fromkeys((*_OFFERED[to], *_HELD[to])))
    if lens and lens not in offered:
        raise BadFile(path, "", f"lens '{lens[:20]}' where one of {', '.join(offered)} is expected for {to}")
    found: dict[str, tuple[str, CameraModel, TwinError]] = {}
    for name, camera in cameras.items():
        refuse_mirrored(camera.model, path)
        found[name] = _nearest(camera.model, to, lens, path)
        taken, _, error = found[name]
        _hold(error, limit_px, f"'{name}' as {taken}", _why(camera.model), path)
    frame = next(iter(cameras.values())).frame
    twins = {name: twin for name, (_, twin, _) in found.items()}
    first = next(iter(twins.values()))
    match to:
        case "kalibr":
            data = format_kalibr(twins, frame)
        case "colmap":
            data = format_colmap(twins)
        case "ros":
            ((name, (taken, _, _)),) = found.items()
            data = format_camera_info(first, taken, name)
        case "mrcal":
            data = format_mrcal(first, frame)
        case _:
            data = format_opencv(first, frame)
    save_bytes(path, data)
    lost = list(_lost(cameras, twins, to, frame))
    return Conversion(
        Path(path),
        to,
        tuple(lost),
        tuple(t for t, _, _ in found.values()),
        tuple(e for _, _, e in found.values()),
    )


def _nearest(model: CameraModel, to: str, lens: str, path: str | Path) -> tuple[str, CameraModel, TwinError]:
    """Lens, twin and error: the camera itself where the format holds it, else the plainest lens that is good
    enough, else the nearest of them."""
    if model.kind == SPLINED and to == "mrcal" and not lens and abs(model.camera_matrix[0, 1]) < 1e-9:
        return "splined", model, twin_error(model, model)
    for name in (lens,) if lens else _HELD[to]:
        if name in LENSES and model.kind != "CAHV" and (same := held_as(model, LENSES[name])) is not None:
            return name, same, twin_error(model, same)
    best: tuple[str, CameraModel, TwinError] | None = None
    problem = ""
    for name in (lens,) if lens else _OFFERED[to]:
        try:
            with np.errstate(all="ignore"):
                twin = _twin(model, name)
                error = twin_error(model, twin, model.moving)
        except (ValueError, np.linalg.LinAlgError) as reason:
            problem = str(reason)
            continue
        if best is None or error.worst_px < 0.5 * best[2].worst_px:
            best = name, twin, error
        if error.worst_px <= GOOD_PX:
            break
    if best is None:
        raise BadFile(path, "", f"the camera has no twin in this format: {problem}")
    return best


def _twin(model: CameraModel, lens: str) -> CameraModel:
    """The nearest camera of a lens; the camera itself where that is one."""
    if lens != "cahvor":
        return nearest_opencv(model, LENSES[lens])
    near = nearest_cahvor(model)
    return near if _is_square(near) else nearest_square(near)


def _is_square(model: CameraModel) -> bool:
    """Whether H and V are at right angles as far as numbers can say."""
    return abs(internal_parameters(model)["Theta"] + np.pi / 2) < 1e-12


def _why(model: CameraModel) -> str:
    """What of a camera other families have no place for, as the end of a sentence."""
    off_rad = internal_parameters(model)["Theta"] + np.pi / 2
    reasons = []
    if abs(off_rad) > 1e-5:
        reasons.append(f"H and V are {1e3 * off_rad:.2g} mrad off a right angle")
    if model.moving:
        reasons.append("the entrance point moves")
    if (beside := float(np.arccos(min(1.0, float(model.A @ model.O))))) > 1e-5:
        reasons.append(f"O is {1e3 * beside:.2g} mrad beside A")
    return f" ({', '.join(reasons)})" if reasons else ""


def _lost(
    cameras: Mapping[str, CameraFile], twins: Mapping[str, CameraModel], to: str, frame: str
) -> tuple[str, ...]:
    """What a format of other lenses cannot hold, a sentence each."""
    lost = []
    if to in _NO_POSE:
        for name, twin in twins.items():
            pose = lens_pose(twin)
            rows = ", ".join(f"[{', '.join(f'{value:.9g}' for value in row)}]" for row in pose.rotation)
            where = ", ".join(f"{value:.9g}" for value in pose.translation_m)
            lost.append(
                f"{_NO_POSE[to]} cannot hold where '{name}' is: in '{frame}' at [{where}] m, its x, y, z the "
                f"columns of [{rows}]"
            )
    elif to in ("mrcal", "kalibr"):
        lost.append(f"the pose is in the frame '{frame}', whose name is only a comment of the file")
    for key in ("fit", "provenance"):
        if any(getattr(camera, key) for camera in cameras.values()):
            lost.append(f"'{to}' cannot hold '{key}'")
    return tuple(lost)

"""One camera out of a file of any known format, recognized by content; written as one, with the losses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.errors import BadFile
from calib.files import UNKNOWN_FRAME, CameraFile, read_bytes, save_bytes
from calib.files.cahvor_text import format_cahvor, internal_parameters, looks_like_cahvor, parse_cahvor
from calib.files.mast_file import CAMERA_SCHEMA, StoredRig, parse_camera, parse_rig, save_camera
from calib.files.mrcal_kalibr import (
    format_kalibr,
    format_mrcal,
    looks_like_kalibr,
    looks_like_mrcal,
    parse_kalibr,
    parse_mrcal,
)
from calib.files.opencv_ros import (
    format_camera_info,
    format_opencv,
    looks_like_calibration,
    looks_like_storage,
    parse_calibration,
    read_document,
)
from calib.files.twin import (
    FISHEYE,
    TwinError,
    as_kind,
    error_sentence,
    nearest_cahvor,
    nearest_opencv,
    nearest_square,
    plainest,
    twin_error,
)
from calib.geometry.cahvor import FREE, CameraModel, Kind

LIMIT_PX = 0.25
"""A conversion that moves a pixel by more than this is refused unless the caller sets another limit."""

_BY_SUFFIX = {".cahvor": "cahvor", ".cameramodel": "mrcal", ".yaml": "mastctl", ".yml": "mastctl"}
FORMATS = ("mastctl", "cahvor", "opencv", "ros", "kalibr", "mrcal")

LENSES: dict[str, Kind] = {
    "radtan": "OPENCV4",
    "plumb_bob": "OPENCV5",
    "rational_polynomial": "OPENCV8",
    "thin_prism": "OPENCV12",
    "equidistant": FISHEYE,
    "tilted": "OPENCV14",
}
"""The lenses that can be requested, by the kind that a camera then is."""

_LENSES_OF: dict[str, tuple[str, ...]] = {
    "opencv": ("radtan", "plumb_bob", "rational_polynomial", "thin_prism", "tilted", "equidistant"),
    "ros": ("plumb_bob", "rational_polynomial", "equidistant"),
    "kalibr": ("radtan", "equidistant"),
    "mrcal": ("cahvor", "radtan", "plumb_bob", "rational_polynomial", "thin_prism"),
    "cahvor": ("cahvor",),
}
"""Each format's lenses, the shortest first."""


def load_any(path: str | Path) -> StoredRig | CameraFile | dict[str, CameraFile]:
    """Read a mast file, or the camera, or the cameras by name, of a file of any other known format.

    The content shows the format. Where it does not, the suffix decides which format's refusal helps most.
    Raises BadFile if the file is none of these, or is one but malformed.
    """
    data = read_bytes(path, 1 << 28)  # mrcal keeps all its measurements in a camera's file
    suffix = Path(path).suffix.lower()
    if looks_like_mrcal(data) or suffix == ".cameramodel":
        return parse_mrcal(data, path)
    refusal = None
    try:
        document = read_document(data, path)
    except BadFile as error:
        document, refusal = {}, error
    schema = document.get("schema")
    if schema == CAMERA_SCHEMA:
        return parse_camera(data, path)
    if schema is not None or len({"mast", "cameras", "stereo"} & set(document)) > 1:
        return parse_rig(data, path)
    if looks_like_kalibr(document):
        cameras = parse_kalibr(data, path)
        return next(iter(cameras.values())) if len(cameras) == 1 else cameras
    if looks_like_calibration(document):
        return parse_calibration(data, path)
    if suffix == ".cahvor" or looks_like_cahvor(data):
        return parse_cahvor(data, path)
    if refusal is not None and (looks_like_storage(data) or suffix in (".yaml", ".yml", ".xml", ".json")):
        raise refusal
    known = (
        "a mast file, a camera file, a .cahvor file, OpenCV's YAML, XML or JSON, ROS's camera_info, Kalibr's "
    )
    raise BadFile(path, "", f"is not one of these formats: {known}camchain or mrcal's .cameramodel")


@dataclass(frozen=True)
class Conversion:
    """What a conversion wrote.

    ``lost`` says, a sentence each, what the format could not hold; ``lens`` is the lens of the format that
    was taken for each camera, empty where the format holds the model itself; ``errors`` are how far each
    camera as written is from what it was made of, exact ones too.
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
    """Return the format that a name requests: by its suffix, or by what precedes it (``left.ros.yaml``).

    Raises BadFile if the suffix is none of a known format.
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

    ``kalibr`` holds several cameras by name. ``lens`` is the lens to take where the format has several
    (``radtan``, ``plumb_bob``, ``rational_polynomial``, ``equidistant``, ``tilted``, ``cahvor``); '' takes
    the plainest within the limit that is at most twice as far off as the nearest, else the nearest.
    ``limit_px`` is the largest distance between a pixel of the camera and of what is written, anywhere in the
    image.

    Raises BadFile if the format or lens is unknown or cannot hold this, a pixel would move by more than
    ``limit_px``, or the file cannot be saved; then nothing has changed.
    """
    cameras = {"camera": camera} if isinstance(camera, CameraFile) else dict(camera)
    to = format or format_of(path)
    if to not in FORMATS:
        raise BadFile(path, "", f"format '{to[:20]}' where one of {', '.join(FORMATS)} is expected")
    if len(cameras) != 1 and to != "kalibr":
        raise BadFile(path, "", f"{len(cameras)} cameras where one is expected; kalibr holds several")
    if len({one.frame for one in cameras.values()}) > 1 and to == "kalibr":
        raise BadFile(path, "", "the cameras are in several frames; a camchain places them in one")
    if lens and to in ("mastctl", "cahvor"):
        raise BadFile(path, "", f"'{to}' holds the camera's own model; leave the lens out")
    if lens and lens not in _LENSES_OF[to]:
        known = ", ".join(_LENSES_OF[to])
        raise BadFile(path, "", f"lens '{lens[:20]}' where one of {known} is expected for {to}")
    name, only = next(iter(cameras.items()))
    if to == "mastctl":
        save_camera(only, path)
        return Conversion(Path(path), CAMERA_SCHEMA, ())
    if to == "cahvor" and only.model.kind not in FREE:
        save_bytes(path, format_cahvor(only.model))
        return Conversion(Path(path), to, _lost(cameras, {}, to, only.frame))
    found = {name: _within_limit(name, one.model, path, to, lens, limit_px) for name, one in cameras.items()}
    first, twin, _ = found[name]
    twins = {name: twin for name, (_, twin, _) in found.items()}
    formatted = {
        "cahvor": lambda: format_cahvor(twin),
        "kalibr": lambda: format_kalibr(twins, only.frame),
        "ros": lambda: format_camera_info(twin, first, name),
        "mrcal": lambda: format_mrcal(twin, only.frame),
        "opencv": lambda: format_opencv(twin, only.frame),
    }
    save_bytes(path, formatted[to]())
    lost = _lost(cameras, twins, to, only.frame)
    lenses, _, errors = zip(*found.values(), strict=True)
    return Conversion(Path(path), to, lost, lenses, errors)


def _within_limit(
    name: str, model: CameraModel, path: str | Path, to: str, lens: str, limit_px: float
) -> tuple[str, CameraModel, TwinError]:
    """As `nearest_lens`; refused if it is too far off."""
    try:
        taken, twin, error = nearest_lens(model, to, lens, limit_px)
    except ValueError as problem:
        raise BadFile(path, "", f"the camera has no twin in this format: {problem}") from None
    if not error.worst_px <= limit_px:
        far = "does not see all of the image" if np.isinf(error.worst_px) else f"is {error_sentence(error)}"
        reason = f"'{name}' as {taken} {far}; the limit is {limit_px:g} px{_why(model)}"
        raise BadFile(path, "", reason)
    return taken, twin, error


def nearest_lens(
    model: CameraModel, to: str, lens: str = "", limit_px: float = np.inf
) -> tuple[str, CameraModel, TwinError]:
    """Return the lens of a format that serves a camera, the camera with that lens, and its error.

    The camera keeps its numbers where the format holds them; else its lens is the `plainest` that serves.
    Raises ValueError if its image is mirrored, or no lens of the format sees most of it.
    """
    if to != "cahvor" and np.cross(model.H, model.V) @ model.A < 0.0:
        raise ValueError("its image is mirrored (H x V is against A)")
    lenses = (lens,) if lens else _LENSES_OF[to]
    for name in lenses:
        if name in LENSES and model.kind != "CAHV" and (same := as_kind(model, LENSES[name])) is not None:
            return name, same, twin_error(model, same)
    if len(lenses) > 3:  # the others are as near as one of these, or nearly so
        lenses = tuple(one for one in lenses if one not in ("radtan", "thin_prism"))
    problems = [""]

    def twins() -> Iterator[CameraModel]:
        for name in lenses:
            try:
                with np.errstate(all="ignore"):
                    twin = (
                        nearest_cahvor(model, limit_px)
                        if name == "cahvor"
                        else nearest_opencv(model, LENSES[name])
                    )
                    off_rad = internal_parameters(twin)["Theta"] + np.pi / 2  # H and V's of a right angle
                    if name == "cahvor" != to and abs(off_rad) > 1e-12:
                        twin = nearest_square(twin)
            except (ValueError, np.linalg.LinAlgError) as reason:
                problems.append(str(reason))
            else:
                yield twin

    if (found := plainest(model, twins(), limit_px)) is None:
        raise ValueError(problems[-1])
    name_of = {kind: name for name, kind in LENSES.items()}
    name = found[0].kind if to == "cahvor" else name_of.get(found[0].kind, "cahvor")
    return name, *found


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
    """What a format cannot hold, a sentence each."""
    lost = []
    if to == "ros":
        for name, twin in twins.items():
            pose = twin.pose
            rows = ", ".join(f"[{', '.join(f'{value:.9g}' for value in row)}]" for row in pose.rotation)
            where = ", ".join(f"{value:.9g}" for value in pose.translation_m)
            lost.append(
                f"a camera_info cannot hold where '{name}' is: in '{frame}' at [{where}] m, its x, y, z the "
                f"columns of [{rows}]"
            )
    elif to in ("mrcal", "kalibr"):
        lost.append(f"the pose is in the frame '{frame}', whose name is only a comment of the file")
    elif to == "cahvor" and frame != UNKNOWN_FRAME:
        lost.append(f"a .cahvor file cannot hold the name of the frame ('{frame}')")
    for key in ("fit", "provenance"):
        if any(getattr(camera, key) for camera in cameras.values()):
            lost.append(f"'{to}' cannot hold '{key}'")
    return tuple(lost)

"""What the camera files of other programs share: keys as pydantic models, and a camera of OpenCV's numbers.

A program's keys have other names from release to release; one name each is read. A key that is not read is
noted, unless it may change the camera: then the file is refused.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import numpy as np
from pydantic import BeforeValidator, Field

from calib.errors import BadFile
from calib.files import CameraFile, blind_notes
from calib.files.records import Number, Record, problem, read_record
from calib.files.twin import ODD, LensFamily, kind_of_lens
from calib.files.yaml_text import kind_of
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
LENSES: dict[LensName, tuple[LensFamily, tuple[int, ...]]] = {
    "plumb_bob": ("pinhole", (0, 4, 5)),
    "rational_polynomial": ("pinhole", (8,)),
    "equidistant": ("equidistant", (4,)),
    "fisheye": ("equidistant", (4,)),
    "kannala_brandt": ("equidistant", (4,)),
    "radtan": ("pinhole", (4,)),
    "pinhole": ("pinhole", (0, *opencv.COUNTS)),
    "none": ("pinhole", (0,)),
}
"""Each name of a lens: its family, and how many coefficients it says there are."""

_LENS_KEY = re.compile(
    r"fish_?eye|omni|distor|dist_?coef|lens|model|(?:^|_)(?:xi|skew|alpha|mirror\w*)$", re.I
)
_SPREAD_KEY = re.compile(r"std|dev|sigma|cov|err", re.I)
"""Unknown keys that may change what a lens does, but for those that say how well it is known."""

_NEAR = 0.85
"""How alike (difflib's ratio) a key that is not read and a known one must be for a misspelling."""


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


Numbers = Annotated[list[Number], BeforeValidator(_flat)]
Matrix33 = Annotated[list[Number], Field(min_length=9, max_length=9), BeforeValidator(_flat)]
Matrix44 = Annotated[list[Number], Field(min_length=16, max_length=16), BeforeValidator(_flat)]


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
    remedies: Mapping[str, str] | None = None,
) -> tuple[Kind, Source]:
    """Return the record of another program's keys, and where it was read, with a note of unread keys.

    ``other_names`` are further names of a record's keys, ``ignored`` keys that say nothing of the camera,
    ``remedies`` what to do where a key is missing. Raises BadFile as `calib.files.records.read_record`, or if
    an unread key may change the camera, is nearly a known one, or contradicts another name of the same.
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
            hint = f"; rename '{near[0]}', if that is it" if near else (remedies or {}).get(field, "")
            raise source.bad(field, f"the key is missing{hint}")
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


def matrix_of(numbers: Sequence[float]) -> FloatArray:
    """Return fx, fy, cx, cy as a camera matrix (3, 3)."""
    fx, fy, cx, cy = numbers
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def pose_of(source: Source, key: str, numbers: Sequence[Any]) -> Rigid:
    """Return the 16 numbers of a matrix as a rigid transform; a rotation of few digits is made one."""
    matrix = np.reshape(np.array(numbers, dtype=np.float64), (4, 4))
    turn, _, other = np.linalg.svd(matrix[:3, :3])
    rotation = turn @ other
    off = np.abs(rotation - matrix[:3, :3]).max()
    if not off < 1e-3 or np.linalg.det(rotation) < 0.0 or matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise source.bad(key, "no rotation and translation: (4, 4) with a last row 0, 0, 0, 1 is expected")
    return Rigid(rotation, matrix[:3, 3])


def lens_pose(camera: CameraModel) -> Rigid:
    """Return the camera's axes (x right, y down, z ahead) and C in its frame."""
    return Rigid(camera.rotation.T, camera.C)


def matrix44(pose: Rigid) -> FloatArray:
    """Return a transform as (4, 4)."""
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = pose.rotation, pose.translation_m
    return whole


def coefficients(source: Source, key: str, name: LensName, values: Sequence[float]) -> FloatArray:
    """Return the coefficients (n,) that cv2 takes of those under a lens's name; a note if these differ.

    Raises BadFile if cv2 takes no such number of them.
    """
    numbers = np.array(values, dtype=np.float64)
    family, counts = LENSES[name]
    if name == "none" and numbers.any():
        reason = (
            f"{len(numbers)} coefficients, and distortion_model 'none'; name it: plumb_bob or equidistant"
        )
        raise source.bad(key, reason)
    found = numbers
    if family == "equidistant":
        if len(numbers) not in (0, 4) and (len(numbers) < 4 or numbers[4:].any()):
            raise source.bad(key, f"{len(numbers)} coefficients where 4 are expected for '{name}'")
        found = numbers[:4] if len(numbers) else np.zeros(4)
    elif len(numbers) not in (0, *opencv.COUNTS):
        expected = ", ".join(map(str, (0, *opencv.COUNTS)))
        raise source.bad(key, f"{len(numbers)} coefficients where one of {expected} is expected")
    if len(numbers) not in counts and name != "none":
        usual = " or ".join(map(str, counts))
        place = source.bad(key, "").place
        source.notes.append(
            f"{place}: {len(numbers)} coefficients where '{name}' has {usual}; read as cv2 does"
        )
    return found


def lens_camera(
    source: Source,
    family: LensFamily,
    size_px: Sequence[int],
    matrix: FloatArray,
    distortion: FloatArray,
    frame_from_camera: Rigid,
    frame: str,
    digest: str,
) -> CameraFile:
    """Return the camera of numbers that were read, with a note of the part of its image that has no ray.

    One without a lens is a CAHV. Raises BadFile if the numbers are no camera, or as `blind_notes`.
    """
    if np.abs(distortion).max(initial=0.0) > 1e6:
        raise source.bad("", f"coefficients {distortion.tolist()} where numbers up to 1e6 are expected")
    focal_px, pose = matrix[[0, 1], [0, 1]], frame_from_camera
    if not ((np.abs(focal_px) > 1e-3) & (np.abs(focal_px) < 1e7)).all() or np.abs(matrix[:2, 2]).max() > 1e7:
        raise source.bad("", f"focal length {focal_px.tolist()} where pixels are expected")
    if focal_px.prod() < 0.0:
        raise source.bad("", f"focal lengths {focal_px.tolist()} of two signs: a mirrored image is not read")
    if focal_px[1] < 0.0:  # the same as a camera turned about z by half a turn
        pose = pose @ Rigid(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
        matrix = matrix * [[-1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, 1.0]]
        if family == "pinhole":
            distortion = distortion * np.where(np.isin(np.arange(len(distortion)), ODD), -1.0, 1.0)
    try:
        kind, size = kind_of_lens(family, distortion), (size_px[0], size_px[1])
        model = CameraModel.of_matrix(kind, size, matrix, distortion, pose.rotation.T, pose.translation_m)
    except ValueError as error:
        raise source.bad("", str(error)) from None
    notes = (*source.notes, *blind_notes(model, source.path, source.place))
    return CameraFile(model, frame, {}, {}, notes, Path(source.path), digest)


def lens_numbers(camera: CameraModel) -> FloatArray:
    """Return the coefficients (n,) as other programs write them: four zeros where there is no lens."""
    return camera.distortion if len(camera.distortion) else np.zeros(4)

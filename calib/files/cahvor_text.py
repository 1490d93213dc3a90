"""The ``.cahvor`` text files of JPL's camera-model library and of mrcal.

Lines ``KEY = value`` in any order, ``#`` comments. ``Model`` is ``CAHV``, ``CAHVOR``, ``CAHVORE1``,
``CAHVORE2`` or ``CAHVORE3,linearity``, each followed by text that is ignored. ``S`` and ``S internal`` head
matrices, one row a line: the covariance of the vectors' components, and of Hs, Hc, Vs, Vc, Theta (all five
follow from the vectors); neither is read, and zeros are written. JPL's readers find keys by scanning forward
for ``C =`` or ``Hs    =`` with exactly these blanks, so this writer keeps JPL's order and blanks. Numbers are
in shortest round-trip form instead of nine decimals.

Sources: VICAR ``cmod_stdio_*.c`` (what is written and scanned for), mrcal ``cahvor.py`` (what is accepted).
"""

from __future__ import annotations

import math
import re
from difflib import get_close_matches
from pathlib import Path
from typing import cast

import numpy as np

from calib.errors import BadFile
from calib.files import UNKNOWN_FRAME, CameraFile, build_model, text_of
from calib.geometry.cahvor import CameraModel, Kind

_LINE = re.compile(r"\s*([A-Za-z]\w*(?: internal)?)\s*=\s*(.*?)\s*")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_MODEL = re.compile(r"(?:(CAHVORE)\s*([123])\s*(?:,\s*([^\s=]+))?|(CAHVOR|CAHV))\s*(?:=.*)?")
_MODEL_NAMES = {
    "CAHV": "perspective, linear",
    "CAHVOR": "perspective, distortion",
    "CAHVORE1": "perspective, distortion, pupil",
    "CAHVORE2": "fish-eye",
    "CAHVORE3": "general",
}
_KNOWN = ("Model", "Dimensions", *"CAHVORE", "Hs", "Hc", "Vs", "Vc", "Theta")


def looks_like_cahvor(data: bytes) -> bool:
    """Return whether the bytes begin like a .cahvor file: a line ``Model =``, ``Dimensions =`` or ``C =``."""
    return re.search(rb"^[ \t]*(?:Model|Dimensions|C)[ \t]*=", data[:1_000_000], re.MULTILINE) is not None


def parse_cahvor(data: bytes, path: str | Path) -> CameraFile:
    """Read a .cahvor file's bytes; its frame is ``unknown``.

    Raises BadFile if it is no camera: which line, what it holds, what is expected.
    """
    values, unread = _lines(text_of(data, path), path)
    kind, cahvore_type, linearity = _kind(values, path)
    for letter in kind:
        if letter not in values:
            raise BadFile(path, letter, f"the line '{letter} = x y z' is missing; {kind} has it")
    vectors = {letter: _numbers(values, letter, 3, path) for letter in kind}
    for letter in set("RE") & set(values) - set(kind):
        if any(_numbers(values, letter, 3, path)):
            raise BadFile(path, letter, f"{kind} has no {letter}; expected zeros or another Model")
    if "Dimensions" not in values:
        raise BadFile(path, "Dimensions", "the line 'Dimensions = width height' is missing")
    width, height = _numbers(values, "Dimensions", 2, path)
    if not all(number.is_integer() and 0 < number < 1e6 for number in (width, height)):
        raise BadFile(path, "Dimensions", f"'{values['Dimensions'][0]}' where width and height are expected")
    model, notes = build_model(path, "", kind, (int(width), int(height)), vectors, cahvore_type, linearity)
    notes += tuple(f"{key} is not read" for key in unread)
    return CameraFile(model, UNKNOWN_FRAME, {}, {}, notes, Path(path))


def format_cahvor(model: CameraModel) -> bytes:
    """Return the .cahvor text of a camera of the CAHV family."""
    comma, name = "", str(model.kind)
    if model.kind == "CAHVORE":
        name = f"CAHVORE{model.cahvore_type}"
        # without exponent, which mrcal's pattern for the linearity does not know
        linearity = np.format_float_positional(model.linearity, unique=True, trim="0")
        comma = f",{linearity}" if model.cahvore_type == 3 else ""
    lines = [
        "# camera model in CAHVOR vectors, metres and pixels; the centre of the first pixel is (0, 0)",
        "",
        f"Model = {name}{comma} = {_MODEL_NAMES[name]}",
        "",
        f"Dimensions = {model.size_px[0]} {model.size_px[1]}",
        "",
        *(f"{letter} = {' '.join(map(repr, getattr(model, letter).tolist()))}" for letter in model.kind),
    ]
    size = 3 * len(model.kind)
    lines += ["", "S =", *[" 0.0" * size] * size, ""]
    internal = internal_parameters(model)
    theta = internal.pop("Theta")
    lines += [f"{key:<5} = {value!r}" for key, value in internal.items()]
    lines += [f"Theta = {theta!r} ({math.degrees(theta):.6f} deg)", ""]
    return "\n".join([*lines, "S internal =", *[" 0.0" * 5] * 5, "", ""]).encode()


def internal_parameters(model: CameraModel) -> dict[str, float]:
    """Return Hs, Hc, Vs, Vc in pixels and Theta in radians, all following from A, H, V.

    Hc = H·A, Hs = |H - Hc A|, likewise V; Theta is the angle from V' to H' about A, -π/2 without skew, as
    JPL's library signs it (cmod ``cmod_cahv_internal``).
    """
    a, h, v = model.A, model.H, model.V
    hc, vc = float(h @ a), float(v @ a)
    across, down = h - hc * a, v - vc * a
    theta = math.atan2(float(np.cross(down, across) @ a), float(down @ across))
    hs, vs = float(np.linalg.norm(across)), float(np.linalg.norm(down))
    return {"Hs": hs, "Hc": hc, "Vs": vs, "Vc": vc, "Theta": theta}


Values = dict[str, tuple[str, int]]


def _lines(text: str, path: str | Path) -> tuple[Values, list[str]]:
    """Split the text into values with their lines, and what this reader has no use for."""
    values: Values = {}
    unread = []
    matrix: tuple[str, int] | None = None
    for number, line in enumerate(text.split("\n"), 1):
        stripped = line.strip()
        if not stripped or stripped.startswith("#"):
            continue
        match = _LINE.fullmatch(line)
        if match is None and matrix is None:
            raise BadFile(path, f"line {number}", f"'{stripped[:40]}' where 'KEY = value' is expected")
        if match is None:
            if any(_number(part, path, number) for part in stripped.split()):
                unread.append("line {1}, '{0} =',".format(*matrix or ()))
            continue
        key, value = match.groups()
        if key in values:
            raise BadFile(path, f"line {number}", f"a second '{key} ='; one is expected")
        values[key], matrix = (value, number), None
        if key in ("S", "S internal"):
            matrix = key, number
        elif re.match("DISTORTION|LENSMODEL", key):
            raise BadFile(path, f"line {number}", f"{key}; CAHV, CAHVOR and CAHVORE are read, no other lens")
        elif key not in _KNOWN:
            unread.append(f"line {number}, '{key[:40]} =',")
    _refuse_misread(values, path)
    return values, list(dict.fromkeys(unread))


def _refuse_misread(values: Values, path: str | Path) -> None:
    """Refuse a key that is not read and may change the camera: misspelled, or one letter as a vector's."""
    missing = {name.lower(): name for name in _KNOWN if name not in values}
    for key, (_, line) in values.items():
        if key in (*_KNOWN, "S"):
            continue
        near = get_close_matches(key.lower(), missing, n=1, cutoff=0.8)
        if near or len(key) == 1:
            hint = (
                f"the nearest known is '{missing[near[0]]} ='" if near else f"known are {', '.join(_KNOWN)}"
            )
            raise BadFile(path, f"line {line}", f"unknown key '{key} ='; {hint}")


def _kind(values: Values, path: str | Path) -> tuple[Kind, int, float | None]:
    """Read the Model line; without one the letters tell CAHV from CAHVOR, as in mrcal."""
    if "Model" not in values:
        if "E" in values:
            raise BadFile(path, "Model", "the line is missing; a model with E has 'Model = CAHVORE1|2|3,p'")
        return ("CAHVOR" if "R" in values else "CAHV"), 0, None
    value, line = values["Model"]
    match = _MODEL.fullmatch(value)
    if match is None or (match[2] == "3" and match[3] is None):
        expected = "CAHV, CAHVOR, CAHVORE1, CAHVORE2 or CAHVORE3,linearity"
        raise BadFile(path, f"line {line}", f"Model '{value[:40]}' where {expected} is expected")
    if match[4]:
        return cast(Kind, match[4]), 0, None
    number = None if match[3] is None else _number(match[3], path, line)
    if number is not None and abs(number) > 100:
        reason = f"linearity {number:g} where a number from -100 to 100 is expected"
        raise BadFile(path, f"line {line}", reason)
    return "CAHVORE", int(match[2]), number


def _number(text: str, path: str | Path, line: int) -> float:
    value = float(text) if _NUMBER.fullmatch(text) else math.nan
    if not math.isfinite(value):
        raise BadFile(path, f"line {line}", f"'{text[:40]}' where a finite number is expected")
    return value


def _numbers(values: Values, key: str, count: int, path: str | Path) -> list[float]:
    text, line = values[key]
    parts = text.split()
    if len(parts) != count:
        raise BadFile(path, f"line {line}", f"{key} has {len(parts)} numbers where {count} are expected")
    return [_number(part, path, line) for part in parts]

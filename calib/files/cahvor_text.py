"""The ``.cahvor`` text files of JPL's camera-model library and of mrcal.

Lines ``KEY = value`` in any order, ``#`` comments. ``Model`` is ``CAHV``, ``CAHVOR``, ``CAHVORE1``,
``CAHVORE2`` or ``CAHVORE3,linearity``, each followed by text that is ignored. ``S`` and ``S internal`` head
matrices, one row a line: the covariance of the vectors' components, and of Hs, Hc, Vs, Vc, Theta (all five
follow from the vectors). JPL's readers find keys by scanning forward for ``C =`` or ``Hs    =`` with exactly
these blanks, so this writer keeps JPL's order and blanks. Numbers are in shortest round-trip form instead of
nine decimals.

The format has no place for the frame's name, provenance, or a fit other than the covariance of the vectors.
Sources: VICAR ``cmod_stdio_*.c`` (what is written and scanned for), mrcal ``cahvor.py`` (what is accepted).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, cast

import numpy as np

from calib.errors import BadFile
from calib.files import UNKNOWN_FRAME, CameraFile, build_model, digest_of, text_of
from calib.files.atomic import save_bytes
from calib.files.yaml_text import plain
from calib.geometry.cahvor import CameraModel, Kind
from calib.geometry.rigid import FloatArray

MAX_BYTES = 1_000_000

_LINE = re.compile(r"\s*([A-Za-z]\w*(?: internal)?)\s*=\s*(.*?)\s*")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_MODEL = re.compile(r"(?:(CAHVORE)\s*([123])\s*(?:,\s*([^\s=]+))?|(CAHVOR|CAHV))\s*(?:=.*)?")
_SCALARS = ("Hs", "Hc", "Vs", "Vc", "Theta")
_MODEL_NAMES = {"CAHV": "perspective, linear", "CAHVOR": "perspective, distortion"}
_CAHVORE_NAMES = {1: "perspective, distortion, pupil", 2: "fish-eye", 3: "general"}


def looks_like_cahvor(data: bytes) -> bool:
    """Return whether the bytes begin like a .cahvor file: a line ``Model =``, ``Dimensions =`` or ``C =``."""
    return re.search(rb"^[ \t]*(?:Model|Dimensions|C)[ \t]*=", data[:MAX_BYTES], re.MULTILINE) is not None


def parse_cahvor(data: bytes, path: str | Path) -> CameraFile:
    """Read a .cahvor file's bytes; its frame is ``unknown``, a covariance that is not zero goes into ``fit``.

    Raises BadFile if it is no camera: which line, what it holds, what is expected.
    """
    values, matrices, unread = _lines(text_of(data, path), path)
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
    size = _numbers(values, "Dimensions", 2, path)
    if not all(number.is_integer() and 0 < number < 1e6 for number in size):
        raise BadFile(path, "Dimensions", f"'{values['Dimensions'][0]}' where width and height are expected")
    model, notes = build_model(path, "", kind, (int(size[0]), int(size[1])), vectors, cahvore_type, linearity)
    notes += tuple(f"{key} is not read" for key in unread)
    fit: dict[str, Any] = {}
    if "S" in matrices:
        covariance = _matrix(matrices["S"], parameter_order(kind), path)
        if covariance.any():
            fit = {"parameters": list(parameter_order(kind)), "covariance": covariance.tolist()}
    return CameraFile(model, UNKNOWN_FRAME, fit, {}, notes, Path(path), digest_of(data))


def parameter_order(kind: str) -> tuple[str, ...]:
    """Return the order of the covariance's rows: C_x, C_y, C_z, A_x, ... R_0, R_1, R_2, E_0, E_1, E_2."""
    return tuple(f"{letter}_{i}" for letter in kind for i in ("012" if letter in "RE" else "xyz"))


def save_cahvor(camera: CameraFile, path: str | Path) -> tuple[str, ...]:
    """Save a camera as .cahvor text and return, a sentence each, what the format could not hold. Raises
    BadFile.
    """
    text, lost = format_cahvor(camera)
    save_bytes(path, text.encode("utf-8"))
    return lost


def format_cahvor(camera: CameraFile) -> tuple[str, tuple[str, ...]]:
    """Return the .cahvor text of a camera, and what of the camera the format cannot hold."""
    model = camera.model
    if model.kind not in (*_MODEL_NAMES, "CAHVORE"):
        raise ValueError(f".cahvor text holds CAHV, CAHVOR and CAHVORE, not {model.kind}; use save_any")
    lines = [
        "# camera model in CAHVOR vectors, metres and pixels; the centre of the first pixel is (0, 0)",
        "",
    ]
    if model.kind == "CAHVORE":
        comma = f",{_fixed(model.linearity)}" if model.cahvore_type == 3 else ""
        name = _CAHVORE_NAMES[model.cahvore_type]
        lines += [f"Model = CAHVORE{model.cahvore_type}{comma} = {name}"]
    else:
        lines += [f"Model = {model.kind} = {_MODEL_NAMES[model.kind]}"]
    lines += ["", f"Dimensions = {model.size_px[0]} {model.size_px[1]}", ""]
    lines += [f"{letter} = {' '.join(map(repr, getattr(model, letter).tolist()))}" for letter in model.kind]

    order = parameter_order(model.kind)
    covariance = _covariance_of(camera.fit, order)
    lines += ["", "S ="]
    lines += [
        " " + " ".join(map(repr, row))
        for row in (np.zeros(2 * (len(order),)) if covariance is None else covariance).tolist()
    ]
    internal = internal_parameters(model)
    lines += [""] + [f"{key:<5} = {internal[key]!r}" for key in _SCALARS[:4]]
    lines += [f"Theta = {internal['Theta']!r} ({math.degrees(internal['Theta']):.6f} deg)"]
    lines += ["", "S internal ="] + [" 0.0 0.0 0.0 0.0 0.0"] * 5 + [""]

    lost = []
    if camera.frame != UNKNOWN_FRAME:
        lost.append(f"a .cahvor file cannot hold the name of the frame ('{camera.frame}')")
    if camera.fit and covariance is None:
        lost.append("a .cahvor file cannot hold 'fit', only a covariance of the vectors' components")
    elif set(camera.fit) - {"parameters", "covariance"}:
        lost.append("a .cahvor file holds the covariance of 'fit', not the rest of it")
    if camera.provenance:
        lost.append("a .cahvor file cannot hold 'provenance'")
    return "\n".join(lines) + "\n", tuple(lost)


def internal_parameters(model: CameraModel) -> dict[str, float]:
    """Return Hs, Hc, Vs, Vc in pixels and Theta in radians, all following from A, H, V.

    Hc = H·A, Hs = |H - Hc A|, likewise V; Theta is the angle from V' to H' about A, -π/2 without skew, as
    JPL's library signs it (cmod ``cmod_cahv_internal``).
    """
    a, h, v = model.A, model.H, model.V
    hc, vc = float(h @ a), float(v @ a)
    across, down = h - hc * a, v - vc * a
    theta = math.atan2(float(np.cross(down, across) @ a), float(down @ across))
    return {
        "Hs": float(np.linalg.norm(across)),
        "Hc": hc,
        "Vs": float(np.linalg.norm(down)),
        "Vc": vc,
        "Theta": theta,
    }


Values = dict[str, tuple[str, int]]
Rows = list[tuple[str, int]]


def _lines(text: str, path: str | Path) -> tuple[Values, dict[str, Rows], list[str]]:
    """Split the text into values, matrices, and the keys of lines that this reader has no use for."""
    values: Values = {}
    matrices: dict[str, Rows] = {}
    rows: Rows | None = None
    unread = []
    for number, line in enumerate(text.split("\n"), 1):
        stripped = line.strip()
        if not stripped or stripped.startswith("#"):
            continue
        match = _LINE.fullmatch(line)
        if match is None:
            if rows is None:
                raise BadFile(path, f"line {number}", f"'{stripped[:40]}' where 'KEY = value' is expected")
            rows.append((stripped, number))
            continue
        key, value = match.groups()
        if key in values or key in matrices:
            raise BadFile(path, f"line {number}", f"a second '{key} ='; one is expected")
        rows = None
        if key in ("S", "S internal"):
            rows = matrices[key] = [(value, number)] if value else []
        elif re.match("DISTORTION|LENSMODEL", key):
            raise BadFile(path, f"line {number}", f"{key}; CAHV, CAHVOR and CAHVORE are read, no other lens")
        else:
            values[key] = (value, number)
            if key not in ("Model", "Dimensions", *"CAHVORE", *_SCALARS):
                unread.append(f"line {number}, '{key[:40]} =',")
    _refuse_misread(values, path)
    return values, matrices, unread


def _refuse_misread(values: Values, path: str | Path) -> None:
    """Refuse a key that is not read and may change the camera: misspelled, or one letter as a vector's."""
    known = ("Model", "Dimensions", *"CAHVORE", *_SCALARS)
    missing = {name.lower(): name for name in known if name not in values}
    for key, (_, line) in values.items():
        if key in known:
            continue
        near = get_close_matches(key.lower(), missing, n=1, cutoff=0.8)
        if near or len(key) == 1:
            hint = f"the nearest known is '{missing[near[0]]} ='" if near else f"known are {', '.join(known)}"
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


def _matrix(rows: Rows, order: Sequence[str], path: str | Path) -> FloatArray:
    """Read the covariance: as many rows and columns as the model has components."""
    size = len(order)
    table = [[_number(part, path, line) for part in text.split()] for text, line in rows]
    if len(table) != size or any(len(row) != size for row in table):
        shape = f"{len(table)} rows of {sorted({len(row) for row in table})} numbers"
        raise BadFile(path, "S", f"{shape} where {size} rows of {size} are expected")
    covariance = np.array(table)
    if not np.allclose(covariance, covariance.T, rtol=1e-6, atol=1e-300) or (covariance.diagonal() < 0).any():
        raise BadFile(path, "S", "is not symmetric with a diagonal from zero up, as a covariance is")
    return covariance


def _covariance_of(fit: Any, order: Sequence[str]) -> FloatArray | None:
    """Return the covariance in a ``fit``, if it is that of the model's components in their order."""
    fit = plain(fit)
    if fit.get("parameters") != list(order):
        return None
    try:
        covariance = np.array(fit.get("covariance"), dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return covariance if covariance.shape == (len(order), len(order)) else None


def _fixed(value: float) -> str:
    """Write a number without exponent (mrcal's pattern for the linearity knows none), nothing lost."""
    return str(np.format_float_positional(value, unique=True, trim="0"))

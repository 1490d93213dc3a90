"""PDS3 products: a label, attached to its image or detached, with camera model, mast angles and image.

Names in the labels of MER and MSL. A camera is group ``GEOMETRIC_CAMERA_MODEL`` (MSL: ``..._PARMS``) with
MODEL_TYPE and MODEL_COMPONENT_1..9 (C A H V O R E, then T = type and P = linearity). The mast is group
``PMA_ARTICULATION_STATE`` (MER) or ``RSM_ARTICULATION_STATE_PARMS`` (MSL) with ``AZIMUTH-MEASURED`` and
``ELEVATION-MEASURED`` among its angle names. Only MEASURED angles go with the camera model of a label:
REQUESTED and FINAL differ by milliradians.

A label is in the Object Description Language: ``KEYWORD = value``, groups and objects, up to ``END``. Values
are integers (also ``2#0101#``), reals, words, quoted text (line breaks inside become a blank), a number with
a ``<unit>``, sequences ``(1, 2)`` and sets ``{A, B}``. Dates and times stay words. Source: PDS Standards
Reference 3.8, chapter 12. One pass with one pattern: time and memory grow as the text does, depth is bounded.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, cast

import numpy as np
from numpy.typing import NDArray

from calib.errors import BadFile
from calib.files import LARGEST_IMAGE_PX, build_model, read_bytes
from calib.geometry.cahvor import CameraModel, Kind

MAX_FILE_BYTES = 1 << 30
MAX_DEPTH = 16
_MAX_DIGITS = 400

MAX_LABEL_BYTES = 1_000_000
"""A label is looked for in the first bytes of a file; the longest known have some 60 kB."""

_FIRST = re.compile(
    rb"(?:\s|/\*[^*]*\*/|CCSD[0-9A-Z]+|[A-Z]+_VERSION_ID\s*=\s*\"?ODL)*PDS_VERSION_ID\s*=\s*\"?PDS3"
)
_COMPONENTS = {"CAHV": 4, "CAHVOR": 6, "CAHVORE": 7}
_SAMPLES = {
    **dict.fromkeys(("MSB_INTEGER", "INTEGER", "SUN_INTEGER", "MAC_INTEGER"), ">i"),
    **dict.fromkeys(("MSB_UNSIGNED_INTEGER", "UNSIGNED_INTEGER", "SUN_UNSIGNED_INTEGER"), ">u"),
    **dict.fromkeys(("LSB_INTEGER", "PC_INTEGER", "VAX_INTEGER"), "<i"),
    **dict.fromkeys(("LSB_UNSIGNED_INTEGER", "PC_UNSIGNED_INTEGER", "VAX_UNSIGNED_INTEGER"), "<u"),
    **dict.fromkeys(("IEEE_REAL", "FLOAT", "REAL", "SUN_REAL", "MAC_REAL"), ">f"),
    "PC_REAL": "<f",
}
_BITS = {"i": (8, 16, 32), "u": (8, 16, 32), "f": (32, 64)}
_TOKEN = re.compile(
    r"""(?P<blank>\s+|/\*.*?\*/)
      | "(?P<text>[^"]*)"
      | '(?P<symbol>[^'\r\n]*)'
      | <(?P<unit>[^<>\r\n]*)>
      | (?P<based>[-+]?\d+\#[0-9A-Za-z]+\#)
      | (?P<mark>[=(){},;])
      | (?P<word>(?:[^\s=(){},;"'<>/]|/(?!\*))+)""",
    re.VERBOSE | re.DOTALL,
)
_INT = re.compile(r"[-+]?\d+")
_REAL = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_OPEN = {"GROUP": "GROUP", "BEGIN_GROUP": "GROUP", "OBJECT": "OBJECT", "BEGIN_OBJECT": "OBJECT"}
_CLOSE = {"END_GROUP": "GROUP", "END_OBJECT": "OBJECT"}
_CLOSING = {"(": ")", "{": "}"}


class Quantity(NamedTuple):
    """A number with its unit, as the label writes it (``rad``, ``deg``, ``BYTES``)."""

    value: float | int
    unit: str


@dataclass(frozen=True)
class LabelBlock:
    """A ``GROUP`` or ``OBJECT`` of a label, or the whole label, whose kind and name are ''.

    Values are int, float, str, Quantity, or a tuple of these; the first, where a keyword is there twice.
    """

    kind: str
    name: str
    values: Mapping[str, Any] = field(default_factory=dict)
    blocks: tuple[LabelBlock, ...] = ()

    def every(self) -> Iterator[LabelBlock]:
        """Give every block inside, at any depth, in the label's order."""
        for block in self.blocks:
            yield block
            yield from block.every()


def parse_label(text: str, path: str | Path) -> LabelBlock:
    """Return the label at the beginning of the text; everything after its ``END`` is ignored.

    Raises BadFile if the text is no label or has no ``END``: at which line, what is there, what is expected.
    """
    return _Parser(text, path).label()


def _number_in(block: LabelBlock, key: str, path: str | Path) -> float:
    """Return a keyword's number of at most 1e9 in size, its unit left out; raises BadFile."""
    value = block.values.get(key)
    value = value.value if isinstance(value, Quantity) else value
    if not isinstance(value, (int, float)) or not abs(value) <= 1e9:
        raise BadFile(path, f"{block.name}.{key}", f"{_shown(value)} where a number up to 1e9 is expected")
    return float(value)


def _integer_in(block: LabelBlock, key: str, path: str | Path, low: int, high: int) -> int:
    """Return a keyword's integer from low to high, its unit left out; raises BadFile."""
    value = block.values.get(key)
    value = value.value if isinstance(value, Quantity) else value
    if not isinstance(value, int) or not low <= value <= high:
        place = f"{block.name}.{key}" if block.name else key
        raise BadFile(path, place, f"{_shown(value)} where an integer from {low} to {high} is expected")
    return value


def _vector_in(block: LabelBlock, key: str, path: str | Path) -> list[float]:
    """Return a keyword's three numbers, their units left out; raises BadFile."""
    value = block.values.get(key)
    items = value if isinstance(value, tuple) and not isinstance(value, Quantity) else ()
    numbers = [item.value if isinstance(item, Quantity) else item for item in items]
    if len(numbers) != 3 or not all(isinstance(n, (int, float)) and abs(n) <= 1e9 for n in numbers):
        raise BadFile(path, f"{block.name}.{key}", f"{_shown(value)} where three numbers are expected")
    return [float(n) for n in numbers]


def _shown(value: Any) -> str:
    """Return a value as a refusal shows it."""
    return "nothing" if value is None else f"{value!r:.60}"


class _Parser:
    """Reads one label; ``kind`` and ``word`` are the token at hand."""

    def __init__(self, text: str, path: str | Path) -> None:
        self.text = text
        self.path = path
        self.start = self.end = 0
        self.kind = self.word = ""
        self.step()

    def step(self) -> None:
        """Go to the next token that is no blank or comment; at the end of the text its kind is ''."""
        while True:
            self.start = self.end
            match = _TOKEN.match(self.text, self.end)
            if match is None:
                if self.end < len(self.text):
                    self.fail("a value is expected")
                self.kind = self.word = ""
                return
            self.end = match.end()
            self.kind = str(match.lastgroup)
            self.word = match[self.kind]
            if self.kind != "blank":
                return

    def fail(self, expected: str) -> NoReturn:
        """Refuse the token at hand."""
        line = self.text.count("\n", 0, self.start) + 1
        found = self.text[self.start : self.start + 20].split("\n")[0].strip()
        what = repr(found) if found else "the end of the label"
        raise BadFile(self.path, f"line {line}", f"{what} where {expected}")

    def is_mark(self, mark: str) -> bool:
        return self.kind == "mark" and self.word == mark

    def label(self) -> LabelBlock:
        """Read statements up to END."""
        stack: list[tuple[str, str, dict[str, Any], list[LabelBlock]]] = [("", "", {}, [])]
        while True:
            if self.kind != "word":
                self.fail("a keyword or END is expected")
            keyword = self.word
            if keyword == "END" and len(stack) == 1:
                kind, name, values, blocks = stack[0]
                return LabelBlock(kind, name, values, tuple(blocks))
            self.step()
            if keyword in _CLOSE:
                kind, name, values, blocks = stack[-1]
                if kind != _CLOSE[keyword]:
                    self.fail(f"no {_CLOSE[keyword]} is open to be ended")
                if self.is_mark("="):
                    self.step()
                    if self.word != name:
                        self.fail(f"the end of {kind} {name[:40]} is expected")
                    self.step()
                stack.pop()
                stack[-1][3].append(LabelBlock(kind, name, values, tuple(blocks)))
                continue
            if not self.is_mark("="):
                self.fail(f"'=' is expected after {keyword[:40]}")
            self.step()
            if keyword in _OPEN:
                if self.kind not in ("word", "text", "symbol"):
                    self.fail(f"the name of a {_OPEN[keyword]} is expected")
                if len(stack) > MAX_DEPTH:
                    self.fail(f"no more than {MAX_DEPTH} groups in one another are expected")
                stack.append((_OPEN[keyword], self.word, {}, []))
                self.step()
            else:
                value = self.value(0)
                stack[-1][2].setdefault(keyword, value)
            if self.is_mark(";"):
                self.step()

    def value(self, depth: int) -> Any:
        """Read a value, and the unit after a number."""
        if self.kind == "mark" and self.word in _CLOSING:
            return self.sequence(depth)
        if self.kind == "text":
            value: Any = " ".join(self.word.split())
        elif self.kind == "based":
            base, digits, _ = self.word.split("#")
            try:
                value = int(digits, int(base))
            except ValueError:
                self.fail("a number with a base from 2 to 36 is expected")
        elif self.kind == "word" and len(self.word) <= _MAX_DIGITS and _INT.fullmatch(self.word):
            value = int(self.word)
        elif self.kind == "word" and len(self.word) <= _MAX_DIGITS and _REAL.fullmatch(self.word):
            value = float(self.word)
        elif self.kind in ("word", "symbol"):
            value = self.word
        else:
            self.fail("a value is expected")
        self.step()
        if self.kind == "unit" and not isinstance(value, str):
            value = Quantity(value, self.word.strip())
            self.step()
        return value

    def sequence(self, depth: int) -> tuple[Any, ...]:
        """Read a sequence or a set."""
        if depth == MAX_DEPTH:
            self.fail(f"no more than {MAX_DEPTH} sequences in one another are expected")
        closing = _CLOSING[self.word]
        self.step()
        items = []
        while not self.is_mark(closing):
            items.append(self.value(depth + 1))
            if self.is_mark(","):
                self.step()
            elif not self.is_mark(closing):
                self.fail(f"',' or '{closing}' is expected")
        self.step()
        return tuple(items)


def _read_pixels(
    path: Path, root: LabelBlock, block: LabelBlock, data: bytes, size_px: tuple[int, int]
) -> tuple[NDArray[Any] | None, tuple[str, ...]]:
    """Return the pixels that a label points to, and notes.

    Raises BadFile if the samples are of a kind that is not read, the pointer is malformed, or the file is too
    short.
    """
    width, height = size_px
    code = _SAMPLES.get(str(block.values.get("SAMPLE_TYPE")))
    if code is None:
        found = str(block.values.get("SAMPLE_TYPE", "nothing"))[:40]
        raise BadFile(path, "IMAGE.SAMPLE_TYPE", f"{found} where one of {', '.join(_SAMPLES)} is expected")
    bits = _integer_in(block, "SAMPLE_BITS", path, 1, 64)
    if bits not in _BITS[code[1]]:
        raise BadFile(path, "IMAGE.SAMPLE_BITS", f"{bits} where one of {_BITS[code[1]]} is expected")
    if "BANDS" in block.values and _integer_in(block, "BANDS", path, 1, 10**6) != 1:
        raise BadFile(path, "IMAGE.BANDS", f"{block.values['BANDS']} where 1 is expected")
    if str(block.values.get("ENCODING_TYPE", "N/A")) not in ("N/A", "NONE"):
        raise BadFile(path, "IMAGE.ENCODING_TYPE", "compressed pixels; plain samples are expected")
    before, after = (
        _integer_in(block, key, path, 0, 1 << 20) if key in block.values else 0
        for key in ("LINE_PREFIX_BYTES", "LINE_SUFFIX_BYTES")
    )
    name, offset = _pointer(path, root)
    source = path
    if name:
        beside = _beside(path, name)
        if beside is None:
            return None, (f"{name} is not beside the label; there is no image",)
        source, data = beside, read_bytes(beside, MAX_FILE_BYTES)
    line_bytes = before + width * bits // 8 + after
    if offset + height * line_bytes > len(data):
        raise BadFile(
            source, "IMAGE", f"{len(data)} bytes where at least {offset + height * line_bytes} are expected"
        )
    lines = np.frombuffer(data, np.uint8, height * line_bytes, offset).reshape(height, line_bytes)
    pixels = np.ascontiguousarray(lines[:, before : before + width * bits // 8])
    dtype = np.dtype(f"{code}{bits // 8}")
    return pixels.view(dtype).astype(dtype.newbyteorder("=")), ()


def _pointer(path: Path, root: LabelBlock) -> tuple[str, int]:
    """Return where ^IMAGE points: a file's name ('' for the label's own file) and a byte offset."""
    pointer = root.values.get("^IMAGE")
    items = list(pointer) if isinstance(pointer, tuple) and not isinstance(pointer, Quantity) else [pointer]
    name = str(items.pop(0)) if items and isinstance(items[0], str) else ""
    where = items[0] if items else 1
    if len(items) > 1 or (name and not re.fullmatch(r"[\w.+-]+", name)):
        raise BadFile(path, "^IMAGE", "a record, or a file beside the label with a record, is expected")
    if (
        isinstance(where, Quantity)
        and where.unit.upper() in ("BYTES", "BYTE")
        and isinstance(where.value, int)
    ):
        start, unit_bytes = where.value, 1
    elif isinstance(where, int) and not isinstance(where, Quantity):
        start = where
        unit_bytes = 1 if start == 1 else _integer_in(root, "RECORD_BYTES", path, 1, 1 << 24)
    else:
        raise BadFile(path, "^IMAGE", "a record number or a number <BYTES> is expected")
    if not 1 <= start <= 1 << 40:
        raise BadFile(path, "^IMAGE", f"{start} where a record from 1 on is expected")
    return name, (start - 1) * unit_bytes


def _beside(path: Path, name: str) -> Path | None:
    """Return the file of that name beside the label, in whichever case it is written."""
    for candidate in (name, name.lower(), name.upper()):
        if (path.parent / candidate).is_file():
            return path.parent / candidate
    return None


@dataclass(frozen=True, eq=False)
class PdsProduct:
    """The values of a label that a pointing program needs.

    Attributes
    ----------
    camera_model
        In ``frame``, for the image of ``size_px``; None if the label has none of the CAHV family.
    frame
        REFERENCE_COORD_SYSTEM_NAME of the camera model (``ROVER_FRAME``, ``ROVER_NAV_FRAME``).
    azimuth_measured_rad, elevation_measured_rad
        The mast's measured angles; None if the label has none.
    image
        (lines, samples) in the machine's byte order, of the label's sample type; None if its file is absent
        or was not requested.
    size_px
        (width, height) = (LINE_SAMPLES, LINES).
    """

    label: LabelBlock
    camera_model: CameraModel | None
    frame: str
    azimuth_measured_rad: float | None
    elevation_measured_rad: float | None
    image: NDArray[Any] | None
    size_px: tuple[int, int]
    product_id: str
    notes: tuple[str, ...]


def looks_like_pds3(data: bytes) -> bool:
    """Return whether the bytes begin with a PDS3 label."""
    return _FIRST.match(data[:4096]) is not None


def read_product(path: str | Path, with_image: bool = True) -> PdsProduct:
    """Read a label and, unless ``image`` is false, the image that it points to.

    Raises BadFile if the file is no PDS3 product with an IMAGE object, or what it says of camera, angles or
    image is malformed; the place names group and keyword.
    """
    data = read_bytes(path, MAX_FILE_BYTES)
    label = _label(data, path)
    image_block = next((b for b in label.every() if b.kind == "OBJECT" and b.name == "IMAGE"), None)
    if image_block is None:
        raise BadFile(path, "IMAGE", "the label has no OBJECT = IMAGE")
    size = (
        _integer_in(image_block, "LINE_SAMPLES", path, 1, LARGEST_IMAGE_PX),
        _integer_in(image_block, "LINES", path, 1, LARGEST_IMAGE_PX),
    )
    model, frame, notes = _camera(label, Path(path), size)
    azimuth, elevation = _mast_angles(label, Path(path))
    image = None
    if with_image:
        image, image_notes = _read_pixels(Path(path), label, image_block, data, size)
        notes += image_notes
    return PdsProduct(
        label=label,
        camera_model=model,
        frame=frame,
        azimuth_measured_rad=azimuth,
        elevation_measured_rad=elevation,
        image=image,
        size_px=size,
        product_id=str(label.values.get("PRODUCT_ID", "")),
        notes=notes,
    )


def _label(data: bytes, path: str | Path) -> LabelBlock:
    if not looks_like_pds3(data):
        raise BadFile(path, "line 1", "does not begin with 'PDS_VERSION_ID = PDS3'")
    return parse_label(data[:MAX_LABEL_BYTES].decode("latin-1"), path)


def _camera(
    label: LabelBlock, path: Path, size_px: tuple[int, int]
) -> tuple[CameraModel | None, str, tuple[str, ...]]:
    """Return the camera model, its frame, and notes."""
    blocks = [b for b in label.every() if b.name.startswith("GEOMETRIC_CAMERA_MODEL")]
    kinds = [b for b in blocks if b.values.get("MODEL_TYPE") in _COMPONENTS]
    if not kinds:
        return None, "", ()
    block = kinds[0]
    notes = () if len(kinds) == 1 else (f"the first of {len(kinds)} camera models of the label is read",)
    kind = cast(Kind, block.values["MODEL_TYPE"])
    count = _COMPONENTS[kind]
    vectors = {
        letter: _vector_in(block, f"MODEL_COMPONENT_{number}", path)
        for number, letter in zip(range(1, count + 1), kind, strict=True)
    }
    cahvore_type, linearity = 0, None
    if kind == "CAHVORE":
        number = _number_in(block, "MODEL_COMPONENT_8", path)
        if number not in (1.0, 2.0, 3.0):
            raise BadFile(
                path, f"{block.name}.MODEL_COMPONENT_8", f"{number:g} where type 1, 2 or 3 is expected"
            )
        cahvore_type = int(number)
        if "MODEL_COMPONENT_9" in block.values:
            linearity = _number_in(block, "MODEL_COMPONENT_9", path)
        elif cahvore_type == 3:
            raise BadFile(path, f"{block.name}.MODEL_COMPONENT_9", "the linearity of type 3 is missing")
    model, model_notes = build_model(path, block.name, kind, size_px, vectors, cahvore_type, linearity)
    frame = block.values.get("REFERENCE_COORD_SYSTEM_NAME")
    if not isinstance(frame, str) or not frame.isprintable() or not frame:
        raise BadFile(path, f"{block.name}.REFERENCE_COORD_SYSTEM_NAME", "the frame's name is missing")
    return model, frame, notes + model_notes


def _mast_angles(label: LabelBlock, path: Path) -> tuple[float | None, float | None]:
    """Return measured azimuth and elevation of the mast, radians; None where the label has no such group."""
    for block in label.every():
        if not re.match("(PMA|RSM)_ARTICULATION_STATE", block.name):
            continue
        names = block.values.get("ARTICULATION_DEVICE_ANGLE_NAME", ())
        angles = block.values.get("ARTICULATION_DEVICE_ANGLE", ())
        place = f"{block.name}.ARTICULATION_DEVICE_ANGLE"
        if not isinstance(names, tuple) or not isinstance(angles, tuple) or len(names) != len(angles):
            raise BadFile(path, place, "as many angles as angle names are expected")
        if "AZIMUTH-MEASURED" in names and "ELEVATION-MEASURED" in names:
            azimuth, elevation = (
                _radians(angles[names.index(name)], path, place)
                for name in ("AZIMUTH-MEASURED", "ELEVATION-MEASURED")
            )
            return azimuth, elevation
    return None, None


def _radians(value: Any, path: Path, place: str) -> float:
    unit = value.unit.lower() if isinstance(value, Quantity) else "rad"
    number = value.value if isinstance(value, Quantity) else value
    factor = {"rad": 1.0, "radian": 1.0, "radians": 1.0, "deg": math.pi / 180, "degree": math.pi / 180}
    if not isinstance(number, (int, float)) or not abs(number) <= 1e6 or unit not in factor:
        raise BadFile(path, place, f"{value!r:.60} where an angle in <rad> or <deg> is expected")
    return float(number) * factor[unit]

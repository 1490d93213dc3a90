"""A sheet of paper with a board on it, two bars to measure, and text that says what it is."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from itertools import pairwise

from calib.targets.boards import AnyBoard, AprilGrid, Charuco, Checkerboard, DotBoard
from calib.targets.pattern import Spots, pattern_of
from mastctl.errors import MastctlError

PAPERS_MM = {
    "A0": (841.0, 1189.0), "A1": (594.0, 841.0), "A2": (420.0, 594.0), "A3": (297.0, 420.0),
    "A4": (210.0, 297.0), "A5": (148.0, 210.0), "letter": (215.9, 279.4),
    "legal": (215.9, 355.6), "tabloid": (279.4, 431.8),
}  # fmt: skip

MARGIN_MM = 10.0
"""What printers leave white at the rim, and a little more."""

GAP_MM, BAR_MM, LINE_MM, TICK_MM = 7.0, 10.0, 0.25, 4.0
"""White around the board, a bar's length is a multiple of, how thick it is, its ends."""

TEXT_MM, SMALL_MM = 3.6, 2.6
FOOT_MM = 26.0
SIDE_MM = 7.0

Rectangle = tuple[float, float, float, float]


@dataclass(frozen=True)
class TextLine:
    """A line of text: the left end of its baseline (mm), its height, and whether it is turned upwards."""

    x_mm: float
    y_mm: float
    height_mm: float
    text: str
    upwards: bool = False


@dataclass(frozen=True)
class Sheet:
    """What is printed, in millimetres from the paper's upper left corner, x right and y down.

    Black are the rectangles (left, top, right, bottom) and ellipses (x, y, half width, half height).
    ``bar_m`` are the lengths of the bars across and down, metres.
    """

    size_mm: tuple[float, float]
    rectangles: tuple[Rectangle, ...]
    ellipses: tuple[Rectangle, ...]
    lines: tuple[TextLine, ...]
    middle_mm: tuple[float, float]
    bar_m: tuple[float, float]


class TooLarge(MastctlError):
    """A board that the paper has no room for."""

    code, exit_code = "too_large", 2


def largest_mm(paper_mm: tuple[float, float]) -> tuple[float, float]:
    """Return how wide and high a board may be on a paper."""
    return (
        paper_mm[0] - 2 * MARGIN_MM - 2 * SIDE_MM - 2.0,
        paper_mm[1] - 2 * MARGIN_MM - FOOT_MM - GAP_MM,
    )


def sheet_of(board: AnyBoard, paper_mm: tuple[float, float], name: str) -> Sheet:
    """Lay a board out on paper. Raises TooLarge if it does not fit, with what would."""
    width_mm, height_mm = (1000.0 * size for size in board.size_m)
    wide_mm, high_mm = largest_mm(paper_mm)
    if width_mm > wide_mm + 1e-6 or height_mm > high_mm + 1e-6:
        key = {"aprilgrid": "tag", "dots": "spacing"}.get(board.kind, "square")
        part = min(wide_mm / width_mm, high_mm / height_mm)
        fits_mm = math.floor(10_000.0 * part * getattr(board, f"{key}_m")) / 10
        raise TooLarge(
            f"the board is {width_mm:.0f} x {height_mm:.0f} mm, and paper of "
            f"{paper_mm[0]:g} x {paper_mm[1]:g} mm has room for {wide_mm:.0f} x {high_mm:.0f} mm; "
            f"--{key}-mm {fits_mm:g} would fit, or fewer columns and rows, or --landscape"
        )
    left, top = (paper_mm[0] - width_mm) / 2, MARGIN_MM + (high_mm + GAP_MM - height_mm) / 2
    middle = left + width_mm / 2, top + height_mm / 2
    rectangles, ellipses = _printed(board, middle)
    across_mm, down_mm = (max(BAR_MM, BAR_MM * math.floor(size / BAR_MM)) for size in (width_mm, height_mm))
    foot = top + height_mm + GAP_MM
    side = left - SIDE_MM
    bars = [*_bar(left, foot, across_mm, False), *_bar(side, top, down_mm, True)]
    texts = (
        (6.0, TEXT_MM, description(board)),
        (10.5, SMALL_MM, f"mastctl board {name}    this side up, x to the right, y down, z into the paper"),
        (14.5, SMALL_MM, "Print at 100 % (no fit to page), glue flat. Write the lengths of the bars:"),
        (18.5, SMALL_MM, f"mastctl board measured {name}.yaml --across-mm ... --down-mm ..."),
    )
    lines = [
        TextLine(left + across_mm / 2 - 22.0, foot - 1.2, SMALL_MM, f"{across_mm:g} mm across: measure it"),
        TextLine(side - 1.2, top + down_mm / 2 + 20.0, SMALL_MM, f"{down_mm:g} mm down: measure it", True),
        *(TextLine(left, foot + below_mm, height_mm, text) for below_mm, height_mm, text in texts),
    ]
    bar_m = across_mm / 1000, down_mm / 1000
    return Sheet(paper_mm, (*rectangles, *bars), tuple(ellipses), tuple(lines), middle, bar_m)


def description(board: AnyBoard) -> str:
    """Return the kind and measures of a board, in one line."""
    across = f"{board.columns} x {board.rows}"
    match board:
        case Charuco():
            old = ", drawn as before OpenCV 4.6" if board.legacy else ""
            return (
                f"ChArUco, {across} squares of {_mm(board.square_m)} mm, "
                f"markers of {_mm(board.marker_m)} mm, {board.dictionary}{_ids(board.first_id)}{old}"
            )
        case AprilGrid():
            return (
                f"AprilGrid, {across} tags of {_mm(board.tag_m)} mm, "
                f"{_mm(board.gap_m)} mm apart, {board.family}{_ids(board.first_id)}"
            )
        case DotBoard():
            return f"Dots, {across}, {_mm(board.spacing_m)} mm apart, {_mm(board.dot_diameter_m)} mm across"
        case Checkerboard():
            return f"Chessboard, {across} squares of {_mm(board.square_m)} mm"


def _ids(first: int) -> str:
    return f" from {first}" if first else ""


def _printed(board: AnyBoard, middle: tuple[float, float]) -> tuple[list[Rectangle], list[Rectangle]]:
    """The board's own rectangles and ellipses."""
    pattern = pattern_of(board)
    x, y = middle
    if isinstance(pattern, Spots):
        half, aspect = 500.0 * pattern.diameter_m, pattern.aspect
        places = [(x + 1000.0 * a, y + 1000.0 * b) for b in pattern.y_m for a in pattern.x_m]
        return [], [(*place, half, half * aspect) for place in places]
    cells = [
        (x + 1000.0 * a, y + 1000.0 * b, x + 1000.0 * c, y + 1000.0 * d)
        for a, b, c, d in pattern.rectangles_m()
    ]
    return cells, []


def _bar(x: float, y: float, length: float, down: bool) -> list[Rectangle]:
    """A bar with ends whose outer sides are its length apart."""
    line = (x, y - LINE_MM / 2, x + length, y + LINE_MM / 2)
    ends = [
        (x, y - TICK_MM / 2, x + LINE_MM, y + TICK_MM / 2),
        (x + length - LINE_MM, y - TICK_MM / 2, x + length, y + TICK_MM / 2),
    ]
    if not down:
        return [line, *ends]
    return [(x - (t - y), y + (a - x), x - (s - y), y + (b - x)) for a, s, b, t in (line, *ends)]


def _mm(metres: float) -> str:
    return f"{1000.0 * metres:.3f}".rstrip("0").rstrip(".")


PT_PER_MM = 72 / 25.4
DOT_POINTS = 8
"""Curves an ellipse is made of: the middle of such a dot is exact by symmetry."""


def pdf_of(sheet: Sheet) -> bytes:
    """Return the sheet as PDF 1.4, one page, that asks viewers not to scale it."""
    width, height = (size * PT_PER_MM for size in sheet.size_mm)
    # millimetres with y down from here on
    content = [f"{PT_PER_MM:.9f} 0 0 {-PT_PER_MM:.9f} 0 {height:.6f} cm", "0 g"]
    if sheet.rectangles:
        content += [f"{_n(a)} {_n(b)} {_n(c - a)} {_n(d - b)} re" for a, b, c, d in sheet.rectangles]
        content.append("f")
    for ellipse in sheet.ellipses:
        content += _pdf_ellipse(*ellipse)
    content += [_pdf_text(one) for one in sheet.lines]
    stream = zlib.compress("\n".join(content).encode("cp1252", "replace"), 9)
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.6f} {height:.6f}] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        f"<< /Length {len(stream)} /Filter /FlateDecode >>\nstream\n".encode() + stream + b"\nendstream",
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
    ]
    out = bytearray(b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n")
    begins = []
    for k, one in enumerate(objects, 1):
        begins.append(len(out))
        out += f"{k} 0 obj\n".encode() + one + b"\nendobj\n"
    table = len(out)
    out += f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n".encode()
    out += b"".join(f"{begin:010d} 00000 n \n".encode() for begin in begins)
    out += f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{table}\n%%EOF\n".encode()
    return bytes(out)


def _pdf_ellipse(x: float, y: float, rx: float, ry: float) -> list[str]:
    """Eight curves (each an eighth of the way round), filled."""
    step = 2 * math.pi / DOT_POINTS
    reach = 4 / 3 * math.tan(step / 4)
    places = [(math.cos(k * step), math.sin(k * step)) for k in range(DOT_POINTS + 1)]
    lines = [f"{_n(x + rx)} {_n(y)} m"]
    for (c0, s0), (c1, s1) in pairwise(places):
        points = (c0 - reach * s0, s0 + reach * c0), (c1 + reach * s1, s1 - reach * c1), (c1, s1)
        lines.append(" ".join(f"{_n(x + rx * c)} {_n(y + ry * s)}" for c, s in points) + " c")
    return [*lines, "f"]


def _pdf_text(line: TextLine) -> str:
    text = line.text.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
    turn = "0 -1 -1 0" if line.upwards else "1 0 0 -1"
    return f"BT /F1 {_n(line.height_mm)} Tf {turn} {_n(line.x_mm)} {_n(line.y_mm)} Tm ({text}) Tj ET"


def _n(value: float) -> str:
    """A number to a tenth of a micrometre, without an exponent."""
    return f"{value:.4f}".rstrip("0").rstrip(".") or "0"

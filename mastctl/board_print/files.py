"""Sheets as PDF and SVG: filled rectangles, ellipses and lines of text, in true size."""

from __future__ import annotations

import math
import zlib
from itertools import pairwise
from xml.sax.saxutils import escape

from mastctl.board_print.sheet import Sheet, Words

PT_PER_MM = 72 / 25.4
DOT_POINTS = 8
"""Curves an ellipse is made of: the middle of such a dot is exact by symmetry."""


def svg_of(sheet: Sheet) -> bytes:
    """Return the sheet as SVG; one unit is a millimetre."""
    width, height = sheet.size_mm
    boxes = "".join(f"M{_n(a)} {_n(b)}H{_n(c)}V{_n(d)}H{_n(a)}Z" for a, b, c, d in sheet.rectangles)
    spots = "\n".join(
        f'<ellipse cx="{_n(x)}" cy="{_n(y)}" rx="{_n(rx)}" ry="{_n(ry)}"/>' for x, y, rx, ry in sheet.ellipses
    )
    lines = "\n".join(_svg_words(one) for one in sheet.words)
    paper = f'width="{_n(width)}mm" height="{_n(height)}mm" viewBox="0 0 {_n(width)} {_n(height)}"'
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<svg xmlns="http://www.w3.org/2000/svg" {paper}>
<rect width="{_n(width)}" height="{_n(height)}" fill="white"/>
<path d="{boxes}"/>
{spots}
<g font-family="Helvetica, Arial, sans-serif">
{lines}
</g>
</svg>
"""
    return text.encode()


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
    content += [_pdf_words(one) for one in sheet.words]
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


def _pdf_words(words: Words) -> str:
    text = words.text.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
    turn = "0 -1 -1 0" if words.upwards else "1 0 0 -1"
    return f"BT /F1 {_n(words.height_mm)} Tf {turn} {_n(words.x_mm)} {_n(words.y_mm)} Tm ({text}) Tj ET"


def _svg_words(words: Words) -> str:
    x, y = _n(words.x_mm), _n(words.y_mm)
    turn = f' transform="rotate(-90 {x} {y})"' if words.upwards else ""
    return f'<text x="{x}" y="{y}" font-size="{_n(words.height_mm)}"{turn}>{escape(words.text)}</text>'


def _n(value: float) -> str:
    """A number to a tenth of a micrometre, without an exponent."""
    return f"{value:.4f}".rstrip("0").rstrip(".") or "0"

"""Pieces of a self-contained HTML page: head and style, tables, figures, inlined pictures.

Everything that is put in is escaped here; nothing refers to a file or an address outside the page.
"""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Sequence
from typing import Any

escape = html.escape


def page(title: str, parts: Iterable[str]) -> str:
    """Return a whole page; ``title`` is plain text, ``parts`` are HTML."""
    return _HEAD.replace("TITLE", escape(title)) + "\n".join(parts) + "\n</body></html>\n"


def table(headings: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table with escaped cells."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in headings)
    body = "".join("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def bullets(lines: Sequence[str]) -> str:
    """Return a list of plain sentences."""
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def image_tag(content: bytes, kind: str, alt: str) -> str:
    """Return an inlined image; ``kind`` is ``png`` or ``jpeg``."""
    return f'<img alt="{escape(alt)}" src="data:image/{kind};base64,{base64.b64encode(content).decode()}">'


def plot_tag(figure: Any, alt: str, dpi: int = 110) -> str:
    """Return a matplotlib figure as an inlined PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return image_tag(buffer.getvalue(), "png", alt)


def figure(tag: str, caption: str) -> str:
    """Return a picture with its caption."""
    return f"<figure>{tag}<figcaption>{escape(caption)}</figcaption></figure>"


def badge(word: str, kind: str = "") -> str:
    """Return a word on a coloured ground; ``kind`` chooses the colour (see the style below)."""
    return f'<span class="badge {escape(kind)}">{escape(word)}</span>'


_HEAD = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>TITLE</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body { font: 15px/1.5 system-ui, sans-serif; color: #222;
  max-width: 1200px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.6em; } h2 { font-size: 1.2em; margin-top: 2em; border-bottom: 1px solid #ddd; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .25em .7em; text-align: right; border-bottom: 1px solid #eee; white-space: nowrap; }
td:last-child, th:last-child { text-align: left; white-space: normal; } th { background: #f4f1ee; }
img { max-width: 100%; } .row { display: flex; gap: 12px; margin-bottom: 1.2em; align-items: flex-start; }
figure { margin: 0; flex: 1 1 0; min-width: 0; } .row figure:first-child { flex: 1.35 1 0; }
.row.pairs figure:first-child { flex: 1 1 0; }
figcaption { font-size: .85em; color: #555; }
.badge { font-size: .55em; vertical-align: middle; padding: .3em .7em; border-radius: 1em;
  background: #777; color: #fff; }
.badge.simulated { background: #1f6f8b; } .badge.real { background: #c1440e; }
.badge.good { background: #2d7d46; } .badge.care { background: #b26a00; } .badge.bad { background: #b3261e; }
</style></head><body>
"""

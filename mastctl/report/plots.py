"""Plots: one row of colours, one kind of axes, one way into a page or a file, all by matplotlib.

It is an extra of the installation (``report``): ask `installed` before a plot is begun.
"""

from __future__ import annotations

import io
from typing import Any

from mastctl.report.pictures import Figure, data_url

BLUE, RUST, GREEN, VIOLET, AMBER, GREY = "#1f6f8b", "#c1440e", "#2d7d46", "#7a4b9d", "#b26a00", "#555555"
COLOURS = (BLUE, RUST, GREEN, VIOLET, AMBER, GREY)
DPI = 110


def installed() -> bool:
    """Tell whether plots can be drawn here."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        return False
    return True


def new(width_inch: float, height_inch: float) -> Any:
    """Return an empty matplotlib figure, which no screen and no global state knows of."""
    from matplotlib import figure

    return figure.Figure(figsize=(width_inch, height_inch), layout="constrained")


def errors_upwards(axis: Any) -> None:
    """Give an axes a logarithmic ordinate with plain numbers on it, and a grid."""
    from matplotlib.ticker import LogLocator

    axis.set_yscale("log")
    axis.yaxis.set_minor_locator(LogLocator(subs=(2, 3, 5)))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter("{x:g}")
    axis.tick_params(which="both", labelsize=8)
    axis.grid(alpha=0.25, which="both")


def bgr(colour: str) -> tuple[int, int, int]:
    """Return a plot's colour (``#rrggbb``) as OpenCV draws it."""
    blue, green, red = (int(colour[i : i + 2], 16) for i in (5, 3, 1))
    return blue, green, red


def as_png(figure: Any) -> bytes:
    """Return a plot as the bytes of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


def plot(figure: Any, alt: str, caption: str = "", kind: str = "lines") -> Figure:
    """Return a plot as a figure of a page; ``kind`` as `Figure` has it."""
    return Figure(data_url(as_png(figure), "png"), alt, caption, kind)

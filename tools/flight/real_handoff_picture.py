"""The picture of real_handoff.py: targets of one frame, what became of them in the next.

Opportunity's frames are NASA/JPL-Caltech images, in the public domain; the credit is printed on the picture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from calib.rigid import FloatArray
from calib.tracking.track import TrackSettings
from tools.flight.mer import View
from tools.flight.real_handoff import Carried

matplotlib.use("Agg")

CREDIT = "Images: NASA/JPL-Caltech (Opportunity Navcam, 2015-07-24)"
COLOURS = {"good": "#3ddc84", "misfit": "#ffd23f"}
OTHER, PREDICTED = "#bbbbbb", "#ff4f4f"
ARROW_PX = 60.0
"""Pixels of the picture that an arrow takes for one pixel of residual."""
ZOOM_PX = 26
EXAMPLES = 3


def draw(first: View, second: View, ways: Mapping[str, Sequence[Carried]], path: Path) -> None:
    """Draw a pair: all targets with their residuals, and some of them large."""
    figure = Figure(figsize=(11.0, 8.6), layout="constrained")
    grid = figure.add_gridspec(2, 2 * EXAMPLES, height_ratios=(2.6, 1))
    left, right = figure.add_subplot(grid[0, :EXAMPLES]), figure.add_subplot(grid[0, EXAMPLES:])
    some = ways["neighbours"]
    _frame(left, first, "targets: accepted, refused by the misfit, not found")
    _frame(right, second, f"found; arrows: found less predicted, {ARROW_PX:.0f} times")
    for one in some:
        colour = COLOURS.get(one.verdict, OTHER)
        left.plot(*one.pixel_px, ".", color=colour, ms=4)
        if one.verdict in COLOURS:
            right.plot(*one.found_px, ".", color=colour, ms=4)
            end = one.found_px + ARROW_PX * (one.found_px - one.predicted_px)
            right.annotate("", end, one.found_px, arrowprops={"arrowstyle": "->", "color": colour, "lw": 1.0})
    level = [one for one in ways["level"] if one.verdict == "good"]
    # Of the accepted by range: the nearest, the middle and the farthest, as seen in the first frame.
    order = sorted(level, key=lambda one: -one.pixel_px[1])
    for column, index in enumerate(np.linspace(0, len(order) - 1, EXAMPLES).astype(int)):
        one = order[index]
        _zoom(figure.add_subplot(grid[1, 2 * column]), first, one.pixel_px, "target", one.pixel_px)
        axes = figure.add_subplot(grid[1, 2 * column + 1])
        _zoom(axes, second, one.predicted_px, "predicted (level), found", one.found_px)
        axes.plot(*one.predicted_px, "x", color=PREDICTED, ms=8, mew=1.5)
        _ellipse(axes, one)
    figure.supxlabel(CREDIT, fontsize=8, color="#555555", x=0.99, ha="right")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(
        path, dpi=100, pil_kwargs={"quality": 74, "optimize": True} if path.suffix == ".jpg" else None
    )


def _stretched(image: np.ndarray) -> np.ndarray:
    """Return a frame with its shadows lifted, for the eye only."""
    clear = cv2.createCLAHE(clipLimit=2.0, tileGridSize=(6, 6))
    return np.asarray(clear.apply(np.clip(image * 1.6, 0, 255).astype(np.uint8)))


def _frame(axes: Axes, view: View, title: str) -> None:
    axes.imshow(_stretched(view.image), cmap="gray", vmin=0, vmax=255, interpolation="antialiased")
    angles = f"pan {np.degrees(view.pan_rad):.2f}°, tilt {np.degrees(view.tilt_rad):.2f}°"
    axes.set_title(f"{title}\n{angles}", fontsize=9)
    height, width = view.image.shape
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=(), yticks=())


def _zoom(axes: Axes, view: View, middle_px: FloatArray, title: str, cross_px: FloatArray) -> None:
    axes.imshow(_stretched(view.image), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    x, y = middle_px
    axes.set(xlim=(x - ZOOM_PX, x + ZOOM_PX), ylim=(y + ZOOM_PX, y - ZOOM_PX), xticks=(), yticks=())
    axes.plot(*cross_px, "+", color=COLOURS["good"], ms=12, mew=1.5)
    axes.set_title(f"{title}\n({2 * ZOOM_PX} px wide)", fontsize=8)


def _ellipse(axes: Axes, one: Carried) -> None:
    """The window's ellipse: as many sigmas of the prediction as the tracker searches."""
    values, vectors = np.linalg.eigh(one.spread_px2)
    width, height = 2 * TrackSettings().sigmas * np.sqrt(values[::-1])
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    shape = {"fill": False, "color": PREDICTED, "lw": 1.2}
    axes.add_patch(Ellipse((one.predicted_px[0], one.predicted_px[1]), width, height, angle=angle, **shape))

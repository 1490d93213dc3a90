"""The pictures of docs/evidence/validation.md. Part of flight_validation.py.

Opportunity's frames are NASA/JPL-Caltech images, in the public domain; the credit is printed on each picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from calib.geometry.rigid import FloatArray
from tools.flight import mer

matplotlib.use("Agg")

CREDIT = "Images: NASA/JPL-Caltech (Opportunity Navcam, 2015-07-24)"
TARGET, AIM, FOUND, LINE = "#ffd23f", "#ff4f4f", "#3ddc84", "#4fc3f7"
DOTS_M = (3, 4, 6, 10)
ZOOM_PX = 32
ARROW_PX = 60.0
"""Pixels of the picture that an arrow takes for one pixel of residual."""
OVERLAP_PX = (400, 100, 1000)
"""Part of the later frames that the earlier ones see: right, top and bottom edge."""


@dataclass(frozen=True, eq=False)
class PicturePair:
    """Two views with the features found in both, and the residuals after a free turn of the second."""

    name: str
    first: mer.FlightView
    second: mer.FlightView
    carried: Sequence[mer.CarriedFeatures]
    turned_px: FloatArray


def stretched(image: np.ndarray) -> np.ndarray:
    """Return a frame with its shadows lifted, for the eye only."""
    clear = cv2.createCLAHE(clipLimit=2.0, tileGridSize=(6, 6)).apply(
        np.clip(image * 1.6, 0, 255).astype(np.uint8)
    )
    return np.asarray(clear)


def pointing(first: mer.FlightView, second: mer.FlightView, done: mer.Rehearsal, path: Path) -> None:
    """Draw a feature in one frame, and its line, aim and finding in the other."""
    figure = Figure(figsize=(11.0, 7.6), layout="constrained")
    grid = figure.add_gridspec(2, 4, height_ratios=(2.35, 1))
    left, right = figure.add_subplot(grid[0, :2]), figure.add_subplot(grid[0, 2:])
    _frame(left, first, "the feature, clicked")
    _frame(right, second, "the head pointed: where it is aimed, where it is found")
    _mark(left, done.carried.pixel_px, TARGET, 40)
    _mark(right, done.carried.found_px, FOUND, 40)
    near = figure.add_subplot(grid[1, 0])
    _zoom(near, first, done.carried.pixel_px, "feature")
    near.plot(*done.carried.pixel_px, "+", color=TARGET, ms=16, mew=1.8)
    found = figure.add_subplot(grid[1, 2])
    _zoom(found, second, done.carried.found_px, "aim, found, line with 3, 4, 6, 10 m")
    _line(found, first, done.carried.pixel_px, second)
    found.plot(*done.aim_px, "x", color=AIM, ms=11, mew=1.8)
    found.plot(*done.carried.found_px, "+", color=FOUND, ms=16, mew=1.8)
    _words(figure.add_subplot(grid[1, 1]), _told(first, done))
    _words(figure.add_subplot(grid[1, 3]), _measured(second, done))
    _save(figure, path)


def residuals(pairs: Sequence[PicturePair], path: Path) -> None:
    """Draw what is left across the epipolar lines, magnified, and how much of it one turn a pair explains."""
    figure = Figure(figsize=(11.0, 5.6), layout="constrained")
    grid = figure.add_gridspec(1, len(pairs) + 1, width_ratios=(*(1 for _ in pairs), 1.5))
    for column, pair in enumerate(pairs):
        axes = figure.add_subplot(grid[0, column])
        _frame(axes, pair.second, pair.name)
        axes.set(xlim=(0, OVERLAP_PX[0]), ylim=(OVERLAP_PX[2], OVERLAP_PX[1]))
        for one in pair.carried:
            end = one.found_px + ARROW_PX * one.across_px * _across(pair.first, one, pair.second)
            _arrow(axes, one.found_px, end, AIM)
            axes.plot(*one.found_px, ".", color=FOUND, ms=4)
        axes.add_patch(Rectangle((215, 125), 175, 50, color="black", alpha=0.7))
        _arrow(axes, np.array([230.0, 150.0]), np.array([230.0 + ARROW_PX, 150.0]), AIM)
        axes.text(240 + ARROW_PX, 150, "1 px", color="white", va="center", fontsize=9)
    axes = figure.add_subplot(grid[0, -1])
    bins = np.linspace(-1.6, 1.6, 65)
    for pair, colour in zip(pairs, (LINE, AIM), strict=True):
        axes.hist([one.across_px for one in pair.carried], bins, color=colour, alpha=0.75, label=pair.name)
        axes.hist(pair.turned_px, bins, histtype="step", color=colour, lw=1.6, label="  after a free turn")
    axes.set_xlabel("across the epipolar line, px")
    axes.set_ylabel("features")
    axes.legend(frameon=False, fontsize=9)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    _save(figure, path)


def prediction(measured_mrad: FloatArray, printed_mrad: FloatArray, path: Path) -> None:
    """Draw how far the predicted labels are off, beside a perfect mast with labels of six digits."""
    figure = Figure(figsize=(7.5, 3.4), layout="constrained")
    axes = figure.add_subplot()
    bins = np.linspace(0.0, 10.0, 41)
    weights = np.full(len(printed_mrad), len(measured_mrad) / len(printed_mrad))
    axes.hist(measured_mrad * 1e3, bins, color="#4a7fb5", label="306 labels, predicted from twelve")
    axes.hist(
        printed_mrad * 1e3,
        bins,
        weights=weights,
        histtype="step",
        color="#c0392b",
        lw=1.6,
        label="a perfect mast, labels printed with six digits",
    )
    axes.axvline(5.0, color="black", lw=1.0, ls=":", label="wanted: 5 µrad rms")
    axes.set_xlabel("orientation error, µrad")
    axes.set_ylabel("labels")
    axes.legend(frameon=False, fontsize=9)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.savefig(path, dpi=110)


def _frame(axes: Axes, view: mer.FlightView, title: str) -> None:
    """A whole frame with its angles."""
    axes.imshow(stretched(view.image), cmap="gray", vmin=0, vmax=255, interpolation="antialiased")
    angles = f"pan {np.degrees(view.pan_rad):.2f}°, tilt {np.degrees(view.tilt_rad):.2f}°"
    axes.set_title(f"{title}\n{angles}" if title else angles, fontsize=10)
    axes.set(xlim=(-0.5, 1023.5), ylim=(1023.5, -0.5), xticks=(), yticks=())


def _mark(axes: Axes, pixel_px: FloatArray, colour: str, half_px: float) -> None:
    """A square around a pixel."""
    axes.add_patch(Rectangle(pixel_px - half_px, 2 * half_px, 2 * half_px, fill=False, color=colour, lw=1.6))


def _line(axes: Axes, first: mer.FlightView, pixel_px: FloatArray, second: mer.FlightView) -> None:
    """The epipolar line from 2 m to far away, with a dot at each of some ranges between."""
    _, pixels = mer.epipolar_line(first.camera, pixel_px, second.camera)
    axes.plot(*pixels.T, color=LINE, lw=1.2)
    ray = first.camera.ray(pixel_px)
    dots, _ = second.camera.project(ray.origins_m + np.array(DOTS_M)[:, None] * ray.directions)
    axes.plot(*dots.T, "o", color=LINE, ms=3)
    near, far = pixels[-1], pixels[0]
    axes.text(
        near[0], near[1] - 1.5, f"{mer.NEAREST_M:g} m", color=LINE, fontsize=9, va="bottom", ha="center"
    )
    axes.text(far[0] + 1, far[1] - 1.5, "far", color=LINE, fontsize=9, va="bottom", ha="center")


def _across(first: mer.FlightView, one: mer.CarriedFeatures, second: mer.FlightView) -> FloatArray:
    """Unit vector across a feature's epipolar line, on the side that counts as positive."""
    _, pixels = mer.epipolar_line(first.camera, one.pixel_px, second.camera)
    at = int(np.clip(np.argmin(np.linalg.norm(pixels - one.found_px, axis=1)), 1, len(pixels) - 2))
    along = pixels[at + 1] - pixels[at - 1]
    return np.array([-along[1], along[0]]) / np.linalg.norm(along)


def _arrow(axes: Axes, start: FloatArray, end: FloatArray, colour: str) -> None:
    """An arrow from one pixel to another."""
    axes.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": colour, "lw": 1.2})


def _zoom(axes: Axes, view: mer.FlightView, pixel_px: FloatArray, title: str) -> None:
    """A small piece of a frame, every pixel seen."""
    axes.imshow(stretched(view.image), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    x, y = pixel_px
    axes.set(xlim=(x - ZOOM_PX, x + ZOOM_PX), ylim=(y + ZOOM_PX, y - ZOOM_PX), xticks=(), yticks=())
    axes.set_title(f"{title} ({2 * ZOOM_PX} px wide)", fontsize=9)


def _told(first: mer.FlightView, done: mer.Rehearsal) -> list[tuple[str, str]]:
    """What the pointing was asked."""
    x, y = done.carried.pixel_px
    range_m = float(np.linalg.norm(done.position_m - first.camera.C))
    px, py, pz = done.position_m
    return [
        ("black", f"+ feature at ({x:.0f}, {y:.0f}) px"),
        ("black", f"range from its neighbours: {range_m:.2f} m"),
        ("black", f"rover frame ({px:.2f}, {py:.2f}, {pz:.2f}) m"),
        ("black", "to the image centre:"),
        ("black", f"  pan {done.centre.pan_rad:.5f}, tilt {done.centre.tilt_rad:.5f} rad"),
    ]


def _measured(second: mer.FlightView, done: mer.Rehearsal) -> list[tuple[str, str]]:
    """What came of it."""
    (ax, ay), (fx, fy), (dx, dy) = done.aim_px, done.carried.found_px, done.residual_px
    return [
        (AIM, f"x aimed at ({ax:.2f}, {ay:.2f}) px"),
        ("black", f"  pan {done.solution.pan_rad:.5f}, tilt {done.solution.tilt_rad:.5f} rad"),
        ("#1e9e58", f"+ found at ({fx:.2f}, {fy:.2f}) px"),
        ("black", f"residual ({dx:+.2f}, {dy:+.2f}) px"),
        ("black", f"across the line {abs(done.carried.across_px):.2f} px"),
    ]


def _words(axes: Axes, lines: Sequence[tuple[str, str]]) -> None:
    """Lines of text in a panel of their own."""
    axes.axis("off")
    for row, (colour, text) in enumerate(lines):
        axes.text(0.0, 0.86 - 0.17 * row, text, color=colour, fontsize=9.5, transform=axes.transAxes)


def _save(figure: Figure, path: Path) -> None:
    """Write with the credit, as JPEG."""
    figure.supxlabel(CREDIT, fontsize=8, color="#555555", x=0.99, ha="right")
    figure.savefig(path, dpi=100, pil_kwargs={"quality": 82, "optimize": True})

"""What is drawn of a calibration: each function returns a matplotlib figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calib.adjust.result import Calibration, ImageResiduals
from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid
from calib.targets.boards import Board
from mastctl.calibration.landing import PointingMap
from mastctl.report import plots

FITTED, CHECK, LEFT_OUT = plots.BLUE, plots.RUST, "#999999"
ARROW_PART = 0.025
"""The typical residual is drawn this part of the image's width long; check images have their own scale."""

MANY_DOTS = 2500
NAME_ROOM_M = 0.5
"""A board's name is left out where another name is nearer than this."""


def residuals(calibration: Calibration, camera: str) -> Any:
    """Draw the residuals of a camera's dots as arrows over its image: fitted images, and check images."""
    mine = [image for image in calibration.images if image.camera == camera]
    fitted = dots_of(mine, lambda image: image.used)
    check = dots_of(mine, lambda image: np.full(len(image.used), image.purpose == "check"))
    out = dots_of(mine, lambda image: ~image.used & (image.purpose != "check"))
    shown = [("fitted images", fitted, FITTED)] + ([("check images", check, CHECK)] if len(check[0]) else [])
    figure = plots.new(11.5, 4.3)
    axes = figure.subplots(1, 2, sharey=True)
    for axis, (title, (places, arrows), colour) in zip(axes, shown, strict=False):
        _arrows(axis, places, arrows, colour, calibration.rig.cameras[camera].model.size_px)
        axis.set_title(f"{camera}, {title}", fontsize=10)
    if len(out[0]):
        axes[0].scatter(*out[0].T, marker="x", s=16, color=LEFT_OUT, label="left out", zorder=3)
        axes[0].legend(loc="upper right", fontsize=7, framealpha=0.8)
    for axis in axes[len(shown) :]:
        axis.set_axis_off()
    axes[0].set_ylabel("y, px")
    return figure


def _arrows(axis: Any, places: np.ndarray, arrows: np.ndarray, colour: str, size_px: tuple[int, int]) -> None:
    """Residuals at their dots, the typical one a fixed part of the image long, and how long that is."""
    over_picture(axis, size_px)
    if not len(places):
        axis.set_xlabel("x, px")
        return
    scale = arrow_scale(arrows, size_px[0])
    draw_arrows(axis, places, arrows, colour, scale)
    axis.set_xlabel(f"x, px; arrows drawn {1 / scale:.0f} times as long")


def over_picture(axis: Any, size_px: tuple[int, int]) -> None:
    """Give an axes the extent of a picture, y downwards."""
    width, height = size_px
    axis.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")


def arrow_scale(arrows: np.ndarray, width_px: int) -> float:
    """Return what a pixel of the drawing is of a residual (n, 2), the typical one `ARROW_PART` long."""
    typical = float(np.sqrt(np.mean(np.sum(arrows**2, axis=1)))) if len(arrows) else 0.0
    return max(typical, 1e-9) / (ARROW_PART * width_px)


def draw_arrows(
    axis: Any, places: np.ndarray, arrows: np.ndarray, colour: str, scale: float, label: str | None = None
) -> None:
    """Draw residuals (n, 2) at their places (n, 2), at most some `MANY_DOTS` of them."""
    step = -(-len(places) // MANY_DOTS) or 1
    axis.quiver(
        *places[::step].T, *arrows[::step].T, color=colour, angles="xy", scale_units="xy",
        scale=scale, width=0.0018, headwidth=4, headlength=5, alpha=0.8, label=label,
    )  # fmt: skip


def boards(calibration: Calibration, board: Board) -> Any:
    """Draw every board and camera in the rover frame, from above and from the side."""
    figure = plots.new(10.5, 5.2)
    plan, side = figure.subplots(1, 2)
    corners = board.dots_in_board_m(
        [0, 0, board.rows - 1, board.rows - 1, 0], [0, board.columns - 1, board.columns - 1, 0, 0]
    )
    purposes: dict[tuple[str, str], str] = {}
    for image in calibration.images:
        purposes.setdefault((image.setup, image.placement), image.purpose)
    colour_of = {"camera": FITTED, "mast": plots.GREEN, "check": CHECK}
    labelled: set[str] = set()
    names: list[np.ndarray] = []
    for key, pose in calibration.rover_from_board.items():
        purpose = purposes.get(key, "camera")
        outline = pose.points(corners)
        label = None if purpose in labelled else f"boards: {purpose}"
        labelled.add(purpose)
        for axis, (across, up) in ((plan, (1, 0)), (side, (0, 2))):
            axis.plot(outline[:, across], outline[:, up], color=colour_of[purpose], lw=1.5, label=label)
        place = outline[1, [1, 0]]
        free = all(abs(place - other) @ (0.35, 1.0) > NAME_ROOM_M for other in names)
        if purpose != "camera" and free:  # those of a ring stand too close together for names
            names.append(place)
            name = plan.annotate(
                key[1], place, fontsize=7, color="0.25", xytext=(2, 2), textcoords="offset points"
            )
            name.set_parse_math(False)  # a name with two dollars is no formula
    _eyes(calibration.rig, plan, side)
    plan.set(xlabel="y (right), m", ylabel="x (ahead), m", title="from above", aspect="equal")
    side.set(xlabel="x (ahead), m", ylabel="z (down), m", title="from the right side", aspect="equal")
    side.invert_yaxis()
    for axis in (plan, side):
        axis.grid(alpha=0.25)
    plan.legend(fontsize=7, loc="best")
    return figure


def errors_by(calibration: Calibration) -> Any:
    """Draw each image's rms over the board's range, its angle to the line of sight, pan and tilt."""
    figure = plots.new(11.5, 3.6)
    axes = figure.subplots(1, 4, sharey=True)
    values: Sequence[tuple[str, Any]] = (
        ("range, m", lambda image: image.range_m),
        ("board turned away, deg", lambda image: np.degrees(image.incidence_rad)),
        ("pan, deg", lambda image: None if image.pan_rad is None else np.degrees(image.pan_rad)),
        ("tilt, deg", lambda image: None if image.tilt_rad is None else np.degrees(image.tilt_rad)),
    )
    cameras = list(calibration.rig.cameras)
    for axis, (label, value) in zip(axes, values, strict=True):
        for index, camera in enumerate(cameras):
            for purpose, marker in (("fitted", "o"), ("check", "^")):
                points = [
                    (value(image), _image_rms(image))
                    for image in calibration.images
                    if image.camera == camera
                    and (image.purpose == "check") == (purpose == "check")
                    and value(image) is not None
                    and (image.purpose == "check" or image.used.any())
                ]
                if points:
                    colour = plots.COLOURS[index % len(plots.COLOURS)]
                    name = camera if purpose == "fitted" else None
                    axis.scatter(*np.array(points, dtype=float).T, s=18, marker=marker, color=colour,
                                 alpha=0.75, label=name)  # fmt: skip
        axis.set_xlabel(label)
        plots.errors_upwards(axis)
    axes[0].set_ylabel("rms of an image, px an axis")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=6, fontsize=8)
    return figure


def correlation(names: Sequence[str], covariance: np.ndarray, title: str) -> Any:
    """Draw the correlation of parameters as a coloured square; numbers where they are few."""
    spread = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    matrix = covariance / np.outer(spread, spread)
    few = len(names) <= 10
    figure = plots.new(5.6 if few else 7.4, 4.8 if few else 6.6)
    axis = figure.subplots()
    shown = axis.imshow(matrix, vmin=-1, vmax=1, cmap="RdBu_r", interpolation="nearest")
    if few:
        ticks, labels = list(map(float, range(len(names)))), [_short(name) for name in names]
        for i in range(len(names)):
            for j in range(len(names)):
                strong = abs(matrix[i, j]) > 0.6
                axis.text(j, i, f"{matrix[i, j]:.2f}", ha="center", va="center", fontsize=7,
                          color="white" if strong else "black")  # fmt: skip
    else:
        groups = _groups(names)
        ticks, labels = [(a + b) / 2 - 0.5 for a, b in groups.values()], list(groups)
        for a, _ in groups.values():
            axis.axhline(a - 0.5, color="0.4", lw=0.5)
            axis.axvline(a - 0.5, color="0.4", lw=0.5)
    axis.set_xticks(ticks, labels, rotation=45, ha="right", fontsize=7)
    axis.set_yticks(ticks, labels, fontsize=7)
    axis.set_title(title)
    figure.colorbar(shown, ax=axis, shrink=0.8)
    return figure


def pointing_map(found: PointingMap, calibration: Calibration, what: str) -> Any:
    """Draw a map over pan and tilt, both ways of naming a target, with the survey's own joint angles."""
    figure = plots.new(11.5, 3.9)
    axes = figure.subplots(1, 2, sharey=True)
    joints = {
        (image.pan_rad, image.tilt_rad)
        for image in calibration.images
        if image.pan_rad is not None and image.tilt_rad is not None and image.used.any()
    }
    for axis, values, title in (
        (axes[0], found.by_click, "clicked in the pair, off the middle"),
        (axes[1], found.by_position, "given as a position in the rover frame"),
    ):
        pan, tilt = np.degrees(found.pan_rad), np.degrees(found.tilt_rad)
        shown = axis.pcolormesh(pan, tilt, values, shading="nearest", cmap="viridis")
        figure.colorbar(shown, ax=axis, label=f"{what}, px")
        if np.isfinite(values).any() and np.nanmax(values) > 1.0001 * np.nanmin(values):
            lines = axis.contour(pan, tilt, values, colors="white", linewidths=0.7)
            axis.clabel(lines, fontsize=7)
        if joints:
            axis.scatter(*np.degrees(np.array(sorted(joints))).T, s=12, c="white", edgecolors="black", lw=0.5)
        axis.set(xlabel="pan, deg", title=f"{found.camera}, {found.range_m:g} m: {title}")
        axis.title.set_fontsize(9)
    axes[0].set_ylabel("tilt, deg")
    return figure


def dots_of(images: Sequence[ImageResiduals], which: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (n, 2) and residuals (n, 2) of those dots of images that ``which`` picks, by a mask."""
    places = [image.pixels_px[which(image)] for image in images]
    arrows = [image.residuals_px[which(image)] for image in images]
    if not places:
        return np.empty((0, 2)), np.empty((0, 2))
    return np.concatenate(places), np.concatenate(arrows)


def _image_rms(image: ImageResiduals) -> float:
    return float(np.sqrt(np.mean(image.residuals_px[told(image)] ** 2)))


def told(image: ImageResiduals) -> np.ndarray:
    """Return which of an image's dots count: all of a check image, of others those that were fitted."""
    return np.ones(len(image.used), dtype=bool) if image.purpose == "check" else image.used


def _eyes(rig: Rig, plan: Any, side: Any) -> None:
    """The cameras with the head straight ahead, and the mast's foot of the pan axis."""
    for index, name in enumerate(rig.cameras):
        model = rig.camera_in_rover(name, 0.0, 0.0)
        ahead = Rigid(np.eye(3), model.C).points(0.8 * np.asarray(model.A))
        for axis, (across, up) in ((plan, (1, 0)), (side, (0, 2))):
            axis.plot([model.C[across], ahead[across]], [model.C[up], ahead[up]], lw=1,
                      color="black", label="cameras at pan 0, tilt 0" if index == 0 else None)  # fmt: skip
            axis.plot(model.C[across], model.C[up], "k.", ms=4)


def _short(name: str) -> str:
    """``mast.translation_m.x`` as ``t x``."""
    words: Mapping[str, str] = {"translation_m": "t", "rotation_rad": "θ"}
    _, key, *axis = name.split(".")
    return " ".join([words.get(key, key), *axis])


def _groups(names: Sequence[str]) -> dict[str, tuple[int, int]]:
    """First and last + 1 index of the mast's and of each camera's parameters."""
    groups: dict[str, tuple[int, int]] = {}
    for index, name in enumerate(names):
        first, second, *_ = name.split(".")
        group = first if first == "mast" else second
        groups[group] = (groups.get(group, (index, 0))[0], index + 1)
    return groups

"""What is drawn of a survey's or a bench's calibration: each function returns a matplotlib figure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from calib.adjust.result import BenchCalibration, FittedRig, ImageResiduals
from calib.geometry.covariance import RigCovariance
from calib.geometry.rig import JOINTS_NAMES, AxisJoint, Rig
from calib.geometry.rigid import FloatArray
from calib.plan.knowledge import ExpectedPointing
from calib.survey.records import Survey
from mastctl.report import pictures

CELLS = (16, 12)
"""Of an image in which corners are counted."""

ARROW_PART = 0.025
"""The typical residual is drawn this part of the image's width long."""

MANY_DOTS = 2500

SIDES = ((1, pictures.BLUE, "came from smaller angles"), (-1, pictures.RUST, "came from larger angles"),
         (0, pictures.GREY, "came from either side"))  # fmt: skip


def cells_seen(fit: FittedRig, camera: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return how many fitted corners each of an image's `CELLS` has, (columns, rows), and the edges, px."""
    width, height = fit.rig.cameras[camera].model.size_px
    places, _ = _dots(_of_camera(fit, camera))
    return np.histogram2d(
        places[:, 0], places[:, 1], bins=CELLS, range=((-0.5, width - 0.5), (-0.5, height - 0.5))
    )


def coverage(fit: FittedRig, cameras: Sequence[str]) -> Any:
    """Draw where in each camera's image corners were seen, and how many."""
    figure, axes = _image_of_each(fit.rig, cameras)
    for axis, name in zip(axes, cameras, strict=True):
        counts, xs, ys = cells_seen(fit, name)
        shown = axis.pcolormesh(xs, ys, np.ma.masked_equal(counts.T, 0), cmap="viridis", vmin=0)
        seen = float((counts > 0).mean())
        title = f"{name}: {counts.sum():.0f} corners over {100 * seen:.0f} % of the image"
        axis.set_title(title, fontsize=10)
        axis.set_facecolor("#dddddd")
        figure.colorbar(shown, ax=axis, label="corners a cell", shrink=0.8)
    return figure


def residuals(fit: FittedRig, cameras: Sequence[str]) -> Any:
    """Draw each camera's residuals as arrows over its image, fitted ones and those that were not."""
    figure, axes = _image_of_each(fit.rig, cameras)
    for axis, name in zip(axes, cameras, strict=True):
        width = fit.rig.cameras[name].model.size_px[0]
        for check, colour, label in ((False, pictures.BLUE, "fitted"), (True, pictures.RUST, "not fitted")):
            places, arrows = _dots(_of_camera(fit, name, check))
            if not check:
                scale = _arrow_scale(arrows, width)
            if len(places):
                step = -(-len(places) // MANY_DOTS)
                axis.quiver(
                    *places[::step].T, *arrows[::step].T, color=colour, angles="xy", scale_units="xy",
                    scale=scale, width=0.0018, headwidth=4, headlength=5, alpha=0.8, label=label,
                )  # fmt: skip
        out = [image.pixels_px[~image.used] for image in _of_camera(fit, name)]
        if out and len(left_out := np.concatenate(out)):
            axis.scatter(*left_out.T, marker="x", s=14, color=pictures.GREY, label="left out")
        rms = fit.rms_px.get(name, (float("nan"),) * 2)
        axis.set_title(f"{name}: rms {rms[0]:.3f}, {rms[1]:.3f} px", fontsize=10)
        axis.set_xlabel(f"x, px; arrows drawn {1 / scale:.0f} times as long")
        axis.legend(loc="lower right", fontsize=7, framealpha=0.8)
    return figure


def over_images(fit: FittedRig, cameras: Sequence[str]) -> Any:
    """Draw each image's mean residual over the joint that moves it (pan in x, tilt in y), and its rms over
    the board's range and its angle to the line of sight."""
    figure = pictures.new_plot(11.5, 5.8)
    panels: Sequence[tuple[str, str, Callable[[ImageResiduals], tuple[float | None, float, float]]]] = (
        ("pan read, deg", "mean residual in x, px", lambda i: (_degrees(i.pan_rad), *_mean(i, 0))),
        ("tilt read, deg", "mean residual in y, px", lambda i: (_degrees(i.tilt_rad), *_mean(i, 1))),
        ("range, m", "rms, px an axis", lambda i: (i.range_m, _rms(i), 0.0)),
        ("board turned away, deg", "rms, px an axis", lambda i: (_degrees(i.incidence_rad), _rms(i), 0.0)),
    )
    axes = figure.subplots(2, 2).ravel()
    for axis, (across, up, value) in zip(axes, panels, strict=True):
        for index, name in enumerate(cameras):
            for check in (False, True):
                points = [value(image) for image in _of_camera(fit, name, check) if _counted(image).any()]
                known = np.array([one for one in points if one[0] is not None], dtype=float)
                if len(known):
                    axis.errorbar(
                        *known.T, fmt="^" if check else "o", ms=4, lw=0.8, alpha=0.75,
                        color=pictures.COLOURS[index % len(pictures.COLOURS)],
                        label=f"{name}{', not fitted' if check else ''}",
                    )  # fmt: skip
        axis.set(xlabel=across, ylabel=up)
        axis.grid(alpha=0.25)
    figure.legend(*axes[2].get_legend_handles_labels(), loc="outside upper center", ncols=4, fontsize=8)
    return figure


def joint_curves(fit: BenchCalibration, survey: Survey) -> Any:
    """Draw what each joint's reading is wrong by: the fitted curve, its 95 % band, what each image says."""
    figure = pictures.new_plot(11.5, 4.2)
    known = RigCovariance(fit.parameter_names, fit.covariance)
    for axis, joint in zip(figure.subplots(1, 2), ("pan", "tilt"), strict=True):
        model: AxisJoint = getattr(fit.rig.joints, joint)
        seen = _by_joint(fit, survey, joint)
        low, high = (min(s[0] for s in seen), max(s[0] for s in seen)) if seen else (-1.0, 1.0)
        read = np.linspace(low - 0.15, high + 0.15, 200)
        for side, colour, label in SIDES:
            mine = np.array([(one[0], one[1]) for one in seen if one[2] == side])
            if not len(mine):
                continue
            approach = np.full(len(read), float(side))
            curve = np.asarray(model.true_rad(read, approach)) - read
            spread = 1.96 * _curve_sigma(known, joint, model, read, approach)
            degrees, band = np.degrees(read), (1e3 * (curve - spread), 1e3 * (curve + spread))
            axis.plot(degrees, 1e3 * curve, color=colour, lw=1.4, label=label)
            axis.fill_between(degrees, *band, color=colour, alpha=0.18, lw=0)
            axis.scatter(np.degrees(mine[:, 0]), 1e3 * mine[:, 1], s=12, color=colour, alpha=0.75)
        axis.axhline(0.0, color="0.6", lw=0.8)
        axis.grid(alpha=0.25)
        axis.set(xlabel=f"{joint} read, deg", ylabel="true less read, mrad", title=f"{joint}")
        axis.legend(fontsize=7)
    return figure


def workspace(aim: ExpectedPointing, covariance: FloatArray, fit: FittedRig) -> Any:
    """Draw the predicted pointing error over pan and tilt, by range, with the attitudes of the images."""
    squares = np.einsum("ip,pq,iq->i", aim.to_rig, covariance, aim.to_rig).reshape(-1, 2).mean(axis=1)
    places = np.array(aim.places)
    taken = sorted({(i.pan_rad, i.tilt_rad) for i in fit.images if i.pan_rad is not None})
    ranges = np.unique(places[:, 2]).tolist()
    figure = pictures.new_plot(3.9 * len(ranges), 3.6)
    axes = np.atleast_1d(figure.subplots(1, len(ranges), sharey=True))
    pans, tilts = np.unique(places[:, 0]), np.unique(places[:, 1])
    maps = np.full((len(ranges), len(tilts), len(pans)), np.nan)
    for index in np.ndindex(*maps.shape):
        here = (places == (pans[index[2]], tilts[index[1]], ranges[index[0]])).all(axis=1)
        if here.any():
            maps[index] = np.sqrt(max(float(squares[here].mean()), 0.0))
    for axis, range_m, values in zip(axes, ranges, maps, strict=True):
        shown = axis.pcolormesh(
            np.degrees(pans), np.degrees(tilts), values, shading="gouraud", cmap="viridis", vmin=0,
            vmax=np.nanmax(maps),
        )  # fmt: skip
        axis.scatter(*np.degrees(np.array(taken)).T, s=10, c="white", edgecolors="black", lw=0.4)
        axis.set(xlabel="pan, deg", title=f"target at {range_m:g} m")
        axis.set_xlim(np.degrees(pans[0]), np.degrees(pans[-1]))
        axis.set_ylim(np.degrees(tilts[0]), np.degrees(tilts[-1]))
    axes[0].set_ylabel("tilt, deg")
    figure.colorbar(shown, ax=axes, label="first pointing, rms an axis, px")
    return figure


def _image_of_each(rig: Rig, cameras: Sequence[str]) -> tuple[Any, Any]:
    """A figure with an axes of each camera's image, y downwards."""
    figure = pictures.new_plot(5.6 * len(cameras), 4.4)
    axes = np.atleast_1d(figure.subplots(1, len(cameras)))
    for axis, name in zip(axes, cameras, strict=True):
        width, height = rig.cameras[name].model.size_px
        axis.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel="x, px")
    axes[0].set_ylabel("y, px")
    return figure, axes


def _arrow_scale(arrows: np.ndarray, width_px: int) -> float:
    """What a pixel of the drawing is of a residual (n, 2), the typical one `ARROW_PART` long."""
    typical = float(np.sqrt(np.mean(np.sum(arrows**2, axis=1)))) if len(arrows) else 0.0
    return max(typical, 1e-9) / (ARROW_PART * width_px)


def _of_camera(fit: FittedRig, camera: str, check: bool = False) -> list[ImageResiduals]:
    return [i for i in fit.images if i.camera == camera and (i.purpose == "check") == check]


def _counted(image: ImageResiduals) -> np.ndarray:
    """Which of an image's dots count: all of a check image, of others those that were fitted."""
    return np.ones(len(image.used), dtype=bool) if image.purpose == "check" else image.used


def _dots(images: Sequence[ImageResiduals]) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) and residuals (n, 2) of the dots of images that count."""
    places = [image.pixels_px[_counted(image)] for image in images]
    arrows = [image.residuals_px[_counted(image)] for image in images]
    return np.concatenate([np.empty((0, 2)), *places]), np.concatenate([np.empty((0, 2)), *arrows])


def _degrees(angle_rad: float | None) -> float | None:
    return None if angle_rad is None else float(np.degrees(angle_rad))


def _mean(image: ImageResiduals, part: int) -> tuple[float, float]:
    """Mean residual of an image and its sigma, were its corners independent."""
    values = image.residuals_px[_counted(image), part]
    return float(values.mean()), float(values.std() / np.sqrt(len(values)))


def _rms(image: ImageResiduals) -> float:
    return float(np.sqrt(np.mean(image.residuals_px[_counted(image)] ** 2)))


def _curve_sigma(
    known: RigCovariance, joint: str, model: AxisJoint, read: FloatArray, approach: FloatArray
) -> FloatArray:
    """One sigma of a joint's curve; of numbers that were not fitted nothing is unsure."""
    names = [name for name in JOINTS_NAMES if name.startswith(f"joints.{joint}.")]
    rates = model.rates(read, approach)
    inside = known.among(names)
    return np.asarray(np.sqrt(np.maximum(np.einsum("ip,pq,iq->i", rates, inside, rates), 0.0)))


def _by_joint(fit: BenchCalibration, survey: Survey, joint: str) -> list[tuple[float, float, int]]:
    """Each head image's reading, what it says the reading is wrong by, and the side it came from."""
    out = []
    part = 0 if joint == "pan" else 1
    sides = {image.name: int(getattr(image, f"{joint}_approach")) for image in survey.images}
    model: AxisJoint = getattr(fit.rig.joints, joint)
    for image in fit.images:
        read = image.pan_rad if joint == "pan" else image.tilt_rad
        if read is None or image.purpose == "check" or not image.used.any():
            continue
        focal_px = fit.rig.cameras[image.camera].model.focal_px[part]
        shrunk = np.cos(image.tilt_rad or 0.0) if joint == "pan" else 1.0
        # A head that truly turned further right shows everything further left: predicted less measured grows.
        sign = 1.0 if joint == "pan" else -1.0
        mean = float(np.mean(image.residuals_px[image.used, part]))
        wrong = float(model.true_rad(read, sides[image.name])) - read
        out.append((read, wrong + sign * mean / (focal_px * max(shrunk, 0.2)), sides[image.name]))
    return out

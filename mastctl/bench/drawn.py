"""What is drawn of a bench: each function returns a matplotlib figure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from calib.adjust.result import BenchCalibration, ImageResiduals
from calib.geometry.covariance import RigCovariance
from calib.geometry.parameters import predict
from calib.geometry.rig import JOINTS_NAMES, AxisJoint, Rig
from calib.geometry.rigid import FloatArray, rigid_rates
from calib.plan.knowledge import ExpectedPointing
from calib.survey.records import Survey
from mastctl.bench.differences import Difference
from mastctl.calibration.drawn import arrow_scale, dots_of, draw_arrows, over_picture, told
from mastctl.report import plots

CELLS = (16, 12)
"""Of a picture in which corners are counted."""

RANGES_M = (2.0, 10.0)
SIDES = ((1, plots.BLUE, "came from smaller angles"), (-1, plots.RUST, "came from larger angles"),
         (0, plots.GREY, "came from either side"))  # fmt: skip


def cells_seen(calibration: BenchCalibration, camera: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return how many fitted corners each of an image's `CELLS` has, (columns, rows), and the edges, px."""
    width, height = calibration.rig.cameras[camera].model.size_px
    places, _ = dots_of(_mine(calibration, camera), told)
    return np.histogram2d(
        places[:, 0], places[:, 1], bins=CELLS, range=((-0.5, width - 0.5), (-0.5, height - 0.5))
    )


def coverage(calibration: BenchCalibration, cameras: Sequence[str]) -> Any:
    """Draw where in each camera's picture corners were seen, and how many."""
    figure = plots.new(5.6 * len(cameras), 4.2)
    axes = np.atleast_1d(figure.subplots(1, len(cameras)))
    for axis, name in zip(axes, cameras, strict=True):
        width, height = calibration.rig.cameras[name].model.size_px
        counts, xs, ys = cells_seen(calibration, name)
        shown = axis.pcolormesh(xs, ys, np.ma.masked_equal(counts.T, 0), cmap="viridis", vmin=0)
        axis.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel="x, px")
        seen = float((counts > 0).mean())
        axis.set_title(
            f"{name}: {counts.sum():.0f} corners over {100 * seen:.0f} % of the picture", fontsize=10
        )
        axis.set_facecolor("#dddddd")
        figure.colorbar(shown, ax=axis, label="corners a cell", shrink=0.8)
    axes[0].set_ylabel("y, px")
    return figure


def residuals(calibration: BenchCalibration, cameras: Sequence[str]) -> Any:
    """Draw each camera's residuals as arrows over its picture, fitted ones and those that were not."""
    figure = plots.new(5.6 * len(cameras), 4.4)
    axes = np.atleast_1d(figure.subplots(1, len(cameras)))
    for axis, name in zip(axes, cameras, strict=True):
        size_px = calibration.rig.cameras[name].model.size_px
        over_picture(axis, size_px)
        scale = arrow_scale(dots_of(_mine(calibration, name), told)[1], size_px[0])
        for check, colour, label in ((False, plots.BLUE, "fitted"), (True, plots.RUST, "not fitted")):
            places, arrows = dots_of(_mine(calibration, name, check), told)
            if len(places):
                draw_arrows(axis, places, arrows, colour, scale, label)
        out, _ = dots_of(_mine(calibration, name), lambda image: ~image.used)
        if len(out):
            axis.scatter(*out.T, marker="x", s=14, color=plots.GREY, label="left out")
        rms = calibration.rms_px.get(name, (float("nan"),) * 2)
        axis.set_title(f"{name}: rms {rms[0]:.3f}, {rms[1]:.3f} px", fontsize=10)
        axis.set_xlabel(f"x, px; arrows drawn {1 / scale:.0f} times as long")
        axis.legend(loc="lower right", fontsize=7, framealpha=0.8)
    axes[0].set_ylabel("y, px")
    return figure


def against_joints(calibration: BenchCalibration, cameras: Sequence[str]) -> Any:
    """Draw each picture's mean residual over the joint that moves it: pan moves it in x, tilt in y."""
    figure = plots.new(11.5, 5.6)
    axes = figure.subplots(2, 2, sharex="col")
    for column, (joint, way) in enumerate((("pan", 0), ("tilt", 1))):
        for row, part in enumerate((way, 1 - way)):
            axis = axes[row, column]
            for index, name in enumerate(cameras):
                for check in (False, True):
                    mine = _mine(calibration, name, check)
                    points = [(_read(image, joint), *_mean(image, part)) for image in mine]
                    values = np.array([one for one in points if one[0] is not None], dtype=float)
                    if len(values):
                        axis.errorbar(
                            np.degrees(values[:, 0]), values[:, 1], values[:, 2], fmt="^" if check else "o",
                            ms=4, lw=0.8, color=plots.COLOURS[index % len(plots.COLOURS)], alpha=0.75,
                            label=f"{name}{', not fitted' if check else ''}",
                        )  # fmt: skip
            axis.axhline(0.0, color="0.6", lw=0.8)
            axis.grid(alpha=0.25)
            axis.set_ylabel(f"mean residual in {'xy'[part]}, px")
        axes[1, column].set_xlabel(f"{joint} read, deg")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=4, fontsize=8)
    return figure


def joint_curves(calibration: BenchCalibration, survey: Survey) -> Any:
    """Draw what each joint's reading is wrong by: the fitted curve, its 95 % band, what each picture says."""
    figure = plots.new(11.5, 4.2)
    for axis, joint in zip(figure.subplots(1, 2), ("pan", "tilt"), strict=True):
        model: AxisJoint = getattr(calibration.rig.joints, joint)
        seen = _by_joint(calibration, survey, joint)
        low, high = (min(s[0] for s in seen), max(s[0] for s in seen)) if seen else (-1.0, 1.0)
        read = np.linspace(low - 0.15, high + 0.15, 200)
        for side, colour, label in SIDES:
            mine = np.array([(one[0], one[1]) for one in seen if one[2] == side])
            if not len(mine):
                continue
            approach = np.full(len(read), float(side))
            curve = np.asarray(model.true_rad(read, approach)) - read
            spread = 1.96 * _curve_sigma(_known(calibration), joint, model, read, approach)
            axis.plot(np.degrees(read), 1e3 * curve, color=colour, lw=1.4, label=label)
            axis.fill_between(
                np.degrees(read),
                1e3 * (curve - spread),
                1e3 * (curve + spread),
                color=colour,
                alpha=0.18,
                lw=0,
            )
            axis.scatter(np.degrees(mine[:, 0]), 1e3 * mine[:, 1], s=12, color=colour, alpha=0.75)
        axis.axhline(0.0, color="0.6", lw=0.8)
        axis.grid(alpha=0.25)
        axis.set(xlabel=f"{joint} read, deg", ylabel="true less read, mrad", title=f"{joint}")
        axis.legend(fontsize=7)
    return figure


def lens_uncertainty(calibration: BenchCalibration, cameras: Sequence[str]) -> Any:
    """Draw how sure projection is over each picture, 95 %: in all, and with the camera's motion taken out."""
    figure = plots.new(5.6 * len(cameras), 7.6)
    axes = figure.subplots(2, len(cameras), squeeze=False)
    for column, name in enumerate(cameras):
        whole, lens = projection_sigma(calibration.rig, _known(calibration), name)
        width, height = calibration.rig.cameras[name].model.size_px
        for axis, values, what in (
            (axes[0, column], whole, "where the camera is and its lens"),
            (axes[1, column], lens, "its lens alone"),
        ):
            shown = axis.imshow(
                1.96 * values, extent=(-0.5, width - 0.5, height - 0.5, -0.5), cmap="viridis", vmin=0
            )
            figure.colorbar(shown, ax=axis, label="95 %, px", shrink=0.85)
            axis.set_title(f"{name}: {what}", fontsize=10)
    for row in axes:
        row[0].set_ylabel("y, px")
    for axis in axes[1]:
        axis.set_xlabel("x, px")
    return figure


def workspace(found: Sequence[tuple[float, float, float, float]], looked: FloatArray) -> Any:
    """Draw the predicted pointing error over pan and tilt, by range, with the attitudes that were taken.

    ``found`` has pan, tilt, radians, range, metres, and rms per axis, pixels; ``looked`` (n, 2) pan and tilt.
    """
    table = np.array(found)
    ranges = np.unique(table[:, 2]).tolist()
    figure = plots.new(3.9 * len(ranges), 3.6)
    axes = np.atleast_1d(figure.subplots(1, len(ranges), sharey=True))
    top = float(table[:, 3].max())
    for axis, range_m in zip(axes, ranges, strict=True):
        mine = table[table[:, 2] == range_m]
        pans, tilts = np.unique(mine[:, 0]), np.unique(mine[:, 1])
        values = np.full((len(tilts), len(pans)), np.nan)
        values[np.searchsorted(tilts, mine[:, 1]), np.searchsorted(pans, mine[:, 0])] = mine[:, 3]
        shown = axis.pcolormesh(
            np.degrees(pans), np.degrees(tilts), values, shading="gouraud", cmap="viridis", vmin=0, vmax=top
        )
        axis.scatter(*np.degrees(looked).T, s=10, c="white", edgecolors="black", lw=0.4)
        axis.set(xlabel="pan, deg", title=f"target at {range_m:g} m")
        axis.set_xlim(np.degrees(pans[0]), np.degrees(pans[-1]))
        axis.set_ylim(np.degrees(tilts[0]), np.degrees(tilts[-1]))
    axes[0].set_ylabel("tilt, deg")
    figure.colorbar(shown, ax=axes, label="first pointing, rms an axis, px")
    return figure


def differences(found: Sequence[Difference]) -> Any:
    """Draw how far each camera's lens is from the former mast file's, the implied motion taken out."""
    figure = plots.new(5.6 * len(found), 4.4)
    axes = np.atleast_1d(figure.subplots(1, len(found)))
    for axis, one in zip(axes, found, strict=True):
        arrows = one.lens_px
        typical = max(float(np.nanmax(np.linalg.norm(arrows, axis=1))), 1e-9)
        scale = typical / (0.05 * one.size_px[0])
        axis.quiver(
            *one.pixels_px.T, *arrows.T, color=plots.BLUE, angles="xy", scale_units="xy", scale=scale,
            width=0.003, headwidth=4, headlength=5,
        )  # fmt: skip
        over_picture(axis, one.size_px)
        axis.set_title(
            f"{one.camera}: lens apart by {typical:.2f} px at most, {one.rms_px:.2f} px rms", fontsize=10
        )
        axis.set_xlabel(f"x, px; arrows drawn {1 / scale:.1f} times as long")
    axes[0].set_ylabel("y, px")
    return figure


def projection_sigma(
    rig: Rig, known: RigCovariance, camera: str, range_m: float = 5.0
) -> tuple[FloatArray, FloatArray]:
    """Return one sigma of projected pixels (h, w), rms per axis: in all, and with a rigid motion taken out.

    Points lie ``range_m`` from the camera and count as exact in the frame that it is mounted on.
    """
    model = rig.cameras[camera].model
    width, height = model.size_px
    columns, rows = 24, max(2, round(24 * height / width))
    x, y = np.meshgrid((np.arange(columns) + 0.5) * width / columns, (np.arange(rows) + 0.5) * height / rows)
    rays = model.ray(np.stack([x.ravel(), y.ravel()], axis=-1))
    points = rays.origins_m + range_m * rays.directions
    seen = predict(model, points)
    prefix = f"cameras.{camera}."
    at = [i for i, name in enumerate(known.names) if name.startswith(prefix)]
    covariance = np.asarray(known.covariance)[np.ix_(at, at)]
    jacobian = seen.d_step.reshape(-1, seen.d_step.shape[2])
    motion = rigid_rates(seen.d_points, points, np.asarray(model.C)).reshape(len(jacobian), 6)
    basis, _ = np.linalg.qr(motion)
    lens = jacobian - basis @ (basis.T @ jacobian)
    sigmas = []
    for rates in (jacobian, lens):
        variance = np.einsum("ip,pq,iq->i", rates, covariance, rates).reshape(-1, 2).mean(axis=1)
        sigmas.append(np.sqrt(np.maximum(variance, 0.0)).reshape(rows, columns))
    return sigmas[0], sigmas[1]


def pointing_table(aim: ExpectedPointing, covariance: FloatArray) -> list[tuple[float, float, float, float]]:
    """Return pan, tilt, range and the rms per axis, pixels, of each place of a workspace."""
    found: dict[tuple[float, float, float], list[float]] = {}
    rows = np.einsum("ip,pq,iq->i", aim.to_rig, covariance, aim.to_rig)
    squares: FloatArray = rows.reshape(-1, 2).mean(axis=1)
    for at, square in zip(aim.places, squares.tolist(), strict=True):
        found.setdefault(at, []).append(square)
    return [(*at, float(np.sqrt(max(float(np.mean(values)), 0.0)))) for at, values in found.items()]


def _known(calibration: BenchCalibration) -> RigCovariance:
    return RigCovariance(calibration.parameter_names, calibration.covariance)


def _curve_sigma(
    known: RigCovariance, joint: str, model: AxisJoint, read: FloatArray, approach: FloatArray
) -> FloatArray:
    """One sigma of a joint's curve; of numbers that were not fitted nothing is unsure."""
    names = [name for name in JOINTS_NAMES if name.startswith(f"joints.{joint}.")]
    at = [known.names.index(name) if name in known.names else -1 for name in names]
    free = [k for k, index in enumerate(at) if index >= 0]
    if not free:
        return np.zeros(len(read))
    rates = model.rates(read, approach)[:, free]
    inside = np.asarray(known.covariance)[np.ix_([at[k] for k in free], [at[k] for k in free])]
    return np.asarray(np.sqrt(np.maximum(np.einsum("ip,pq,iq->i", rates, inside, rates), 0.0)))


def _by_joint(calibration: BenchCalibration, survey: Survey, joint: str) -> list[tuple[float, float, int]]:
    """Each head picture's reading, what it says the reading is wrong by, and the side it came from."""
    out = []
    sides = {image.name: int(getattr(image, f"{joint}_approach")) for image in survey.images}
    for image in calibration.images:
        read = _read(image, joint)
        if read is None or image.purpose == "check" or not image.used.any():
            continue
        side = sides[image.name]
        camera = calibration.rig.cameras[image.camera].model
        part = 0 if joint == "pan" else 1
        focal_px = camera.focal_px[0 if joint == "pan" else 1]
        shrunk = np.cos(image.tilt_rad or 0.0) if joint == "pan" else 1.0
        # A head that truly turned further right shows everything further left: predicted less measured grows.
        sign = 1.0 if joint == "pan" else -1.0
        mean = float(np.mean(image.residuals_px[image.used, part]))
        model: AxisJoint = getattr(calibration.rig.joints, joint)
        wrong = float(model.true_rad(read, side)) - read
        out.append((read, wrong + sign * mean / (focal_px * max(shrunk, 0.2)), side))
    return out


def _read(image: ImageResiduals, joint: str) -> float | None:
    return image.pan_rad if joint == "pan" else image.tilt_rad


def _mean(image: ImageResiduals, part: int) -> tuple[float, float]:
    """Mean residual of a picture and its sigma, were its corners independent."""
    values = image.residuals_px[told(image), part]
    if not len(values):
        return 0.0, 0.0
    return float(values.mean()), float(values.std() / np.sqrt(len(values)))


def _mine(calibration: BenchCalibration, camera: str, check: bool = False) -> list[ImageResiduals]:
    return [i for i in calibration.images if i.camera == camera and (i.purpose == "check") == check]

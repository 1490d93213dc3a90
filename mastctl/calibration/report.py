"""What a calibration leaves to read: one self-contained HTML page that says whether to trust it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib.adjust.hypotheses import Finding
from calib.adjust.result import HELD_FIXED, BenchCalibration, Calibration, FittedRig, ImageResiduals
from calib.files import save_bytes
from calib.files.mast_file import StoredRig
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.plan.knowledge import ExpectedPointing
from calib.survey.records import Survey
from mastctl.as_json import readable
from mastctl.calibration.landing import expected_pointing, pointing_change
from mastctl.calibration.verdict import CalibrationVerdict, stated
from mastctl.report import pages, pictures
from mastctl.report.pages import Table, number, x_y

AnyFit = Calibration | BenchCalibration

WORST_IMAGES = 12


def write_report(
    folder: Path,
    survey: Survey,
    fit: AnyFit,
    verdict: CalibrationVerdict,
    saved: StoredRig,
    former: Rig | None,
    promised_px: Mapping[str, float] | None = None,
    **own: Any,
) -> Path:
    """Write the page into ``folder`` (made if need be) in one step and return it.

    A page that was there is kept as ``NAME.previous.html``. ``former`` is the rig to compare with,
    ``promised_px`` what the fit promised of images that were not fitted, rms per axis by camera. ``own``:
    ``worth``, ``pointings``, tables of a bench; ``warnings``, ``undetected``, sentences of a survey. Raises
    OSError, BadFile if it cannot be written; then the file is as it was.
    """
    if isinstance(fit, BenchCalibration):
        title, method, file = "Bench calibration", "bench", "bench.html"
        parts: dict[str, Any] = {"terms": _terms(fit), "wider": None, "station": None}
    else:
        title, file = "Mast calibration", "calibration.html"
        method = f"{fit.method}, {fit.mast_parameters} mast parameters"
        wider, station = finding_table("wider model", fit.wider), _station_table(fit)
        parts = {"terms": None, "wider": wider, "station": station}
    plots = None
    if pictures.can_plot():
        plots = [
            (heading, pictures.plot(figure, alt, caption, "map" if alt.startswith("maps") else "lines"))
            for heading, figure, alt, caption in _drawings(survey, fit)
        ]
    date = str(saved.rig.provenance.get("date", "")).replace("T", " ").replace("+00:00", " UTC")
    page = pages.page(
        "calibration.html",
        title=title,
        badge=pages.Badge(verdict.advice.upper(), verdict.grade),
        facts=[
            ("survey", survey.folder.resolve().name),
            ("digest", survey.digest[:12]),
            ("method", method),
            ("mast file", f"{saved.path.name} ({saved.digest[:12]})"),
            ("fitted in", f"{fit.seconds:.1f} s"),
            ("made", f"{date} by {saved.rig.provenance.get('program')}"),
        ],
        reasons=[(pages.Badge(one.grade, one.grade), one.sentence) for one in verdict.reasons],
        mast=mast_table(fit),
        cameras=camera_table(fit, promised_px),
        measurements=sigma_table(survey, fit),
        boards=finding_table("placement", fit.contradictions),
        notes=fit.notes,
        held_fixed=fit.gauges if isinstance(fit, BenchCalibration) else HELD_FIXED,
        left_out=[outlier.sentence for outlier in fit.outliers],
        plots=plots,
        changes=[] if former is None else list(_changes(fit.rig, former)),
        worst_images=_worst_images(fit),
        **parts,
        **{"worth": None, "pointings": None, "warnings": (), "undetected": (), **own},
    )
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / file
    save_bytes(path, readable(page).encode())
    return path


def mast_table(fit: FittedRig) -> Table:
    """Return the mast's parameters with their sigmas, one row each."""
    mast, sigma = fit.rig.mast, fit.sigma["mast"]

    def row(name: str, value: float, spread: float, unit: str) -> list[str]:
        fixed = spread == 0.0
        return [name, f"{value:+.5f} {unit}", "not fitted" if fixed else f"± {1000 * spread:.2f} m{unit}"]

    rows = [
        row(f"{letter}{axis}", getattr(mast, key)[index], sigma[key][index], unit)
        for key, unit, letter in (("translation_m", "m", "t"), ("rotation_rad", "rad", "θ"))
        for index, axis in enumerate("xyz")
    ]
    for key, unit in (("axis_offset_m", "m"), ("axis_twist_rad", "rad")):
        if sigma[key] > 0.0:
            rows.append(row(key, getattr(mast, key), sigma[key], unit))
    return Table(("parameter", "value", "sigma"), rows)


def camera_table(fit: FittedRig, promised_px: Mapping[str, float] | None = None) -> Table:
    """Return the cameras: images, dots, rms of the fit x and y, rms of check images x and y."""
    rows = []
    for name in fit.rig.cameras:
        mine = [i for i in fit.images if i.camera == name and i.purpose != "check" and i.used.any()]
        checks = [i for i in fit.images if i.camera == name and i.purpose == "check"]
        rows.append(
            [
                name,
                f"{len(mine)}",
                f"{sum(int(i.used.sum()) for i in mine)}",
                x_y(fit.rms_px.get(name), 3),
                f"{len(checks)}",
                x_y(fit.check_rms_px.get(name), 3),
                *([] if promised_px is None else [number(promised_px.get(name), 3)]),
            ]
        )
    headings = ("camera", "images", "dots", "rms x, y px", "checks", "check rms x, y px")
    return Table((*headings, *([] if promised_px is None else ["promised px"])), rows)


def sigma_table(survey: Survey, fit: FittedRig) -> Table | None:
    """Return stated and found sigma of each kind, or None where the method does not weigh by them."""
    if not fit.components:
        return None
    rows = []
    for c in fit.components:
        sigma, unit, _ = stated(survey, fit.images, c.kind)
        found = f"{c.factor * sigma:.3g} ± {c.factor_sigma * sigma:.1g} {unit}"
        rows.append(
            [
                c.kind,
                f"{sigma:.3g} {unit}",
                found if np.isfinite(c.factor) else "not determined",
                f"{c.redundancy:.0f} of {c.count}",
                f"{c.weighed:.2f}",
            ]
        )
    return Table(("measurements", "stated sigma", "found", "redundant numbers", "taken times"), rows)


def finding_table(heading: str, findings: Sequence[Finding]) -> Table | None:
    """Return what hypotheses would gain, or None where none was tested."""
    if not findings:
        return None
    rows = [
        [
            one.name,
            f"{one.numbers}",
            f"{one.gain:.1f}",
            f"{one.chance:.2g}",
            one.sentence if one.significant else "no more than chance",
        ]
        for one in findings
    ]
    return Table((heading, "numbers", "gain in chi-square", "chance", ""), rows)


def _drawings(survey: Survey, fit: AnyFit) -> Iterable[tuple[str, Any, str, str]]:
    """Heading, figure, what it shows for those who cannot see it, caption."""
    cameras = [name for name in fit.rig.cameras if any(i.camera == name for i in fit.images)]
    yield (
        "Where in the images the board was seen",
        _coverage(fit, cameras),
        "maps of the corners over each camera's image",
        "Corners in cells of the image; gray cells have seen none, and the lens is extrapolated there.",
    )
    yield (
        "Residuals over the images",
        _residuals(fit, cameras),
        "residual arrows over each camera's image",
        "Predicted less measured. They should look like noise: arrows that grow to the corners are the "
        "lens's, arrows that all point one way in an image a joint's, a tape's or a prism's.",
    )
    yield (
        "Residuals by joint angle, distance and angle of the board",
        _over_images(fit, cameras),
        "mean residual of each image over pan and tilt, rms over range and angle",
        "An error of a joint moves whole images: pan in x, tilt in y. A wave is a harmonic, two levels are "
        "backlash. Triangles: images that were not fitted.",
    )
    expected = expected_pointing(fit)
    if expected is not None:
        yield (
            "How sure pointing is over the workspace",
            _workspace(*expected, fit),
            "maps of the predicted pointing error over pan and tilt",
            "One sigma an axis of a first pointing, by the calibration; dots are images.",
        )


def _changes(rig: Rig, former: Rig) -> Iterable[str]:
    """By how much pointing differs from the former mast file."""
    for pair, change in pointing_change(rig, former).items():
        yield (
            f"pointing {pair} at what was clicked would change by {change['median_px']:.2f} px, at most "
            f"{change['most_px']:.2f}; at a position in the rover frame by "
            f"{change['position_median_px']:.2f} px, at most {change['position_most_px']:.2f}"
        )


def _terms(fit: BenchCalibration) -> Table:
    rows = []
    for term in fit.terms:
        size = float(np.linalg.norm(term.values))
        spread = float(np.sqrt(np.mean(term.sigma**2))) if len(term.sigma) else 0.0
        length = any(name.endswith("_m") or ".bow_m" in name for name in term.term.parameters)
        rows.append(
            [
                term.name,
                "in" if term.entered else "left out",
                f"{1e3 * size:.2f} ± {1e3 * spread:.2f} {'mm' if length else 'mrad'}",
                f"{term.moves_px:.2f}" if term.entered else "",
                f"{term.chi2:.1f}",
            ]
        )
    return Table(("term", "", "size", "moves pixels by, rms px", "chi-square gained"), rows)


def _station_table(fit: Calibration) -> Table:
    """Rms of the residuals of prisms by set-up and of tapes by placement, worst first."""
    groups: dict[tuple[str, str, str], list[float]] = {}
    for point, off_m in fit.station:
        group = point.kind, point.setup, point.board[1] if point.board else ""
        groups.setdefault(group, []).append(1000 * float(np.linalg.norm(off_m)))
    rows = [
        [*group, f"{len(sizes)}", f"{np.sqrt(np.mean(np.square(sizes))):.2f}", f"{max(sizes):.2f}"]
        for group, sizes in groups.items()
    ]
    rows.sort(key=lambda row: (row[0], -float(row[5])))
    return Table(("kind", "set-up", "placement", "points", "rms mm", "worst mm"), rows)


def _worst_images(fit: FittedRig) -> Table:
    """The images that fit worst."""
    sizes = [(_rms(image), image) for image in fit.images if _counted(image).any()]
    sizes.sort(key=lambda pair: -np.nan_to_num(pair[0], nan=np.inf))
    rows = [
        [
            f"{rms:.3f}",
            f"{image.range_m:.2f}",
            f"{np.degrees(image.incidence_rad):.0f}",
            f"{(~_counted(image)).sum()}",
            image.purpose,
            f"{image.setup} / {image.placement}",
            image.name,
        ]
        for rms, image in sizes[:WORST_IMAGES]
    ]
    headings = ("rms px", "range m", "turned deg", "dots out", "purpose", "set-up / placement", "image")
    return Table(headings, rows)


CELLS = (16, 12)
"""Of an image in which corners are counted."""

ARROW_PART = 0.025
"""The typical residual is drawn this part of the image's width long."""

MANY_DOTS = 2500


def _coverage(fit: FittedRig, cameras: Sequence[str]) -> Any:
    """Draw where in each camera's image corners were seen, and how many."""
    figure, axes = _image_of_each(fit.rig, cameras)
    for axis, name in zip(axes, cameras, strict=True):
        edges = [(-0.5, size - 0.5) for size in fit.rig.cameras[name].model.size_px]
        places, _ = _dots(_of_camera(fit, name))
        counts, xs, ys = np.histogram2d(places[:, 0], places[:, 1], bins=CELLS, range=edges)
        shown = axis.pcolormesh(xs, ys, np.ma.masked_equal(counts.T, 0), cmap="viridis", vmin=0)
        seen = float((counts > 0).mean())
        title = f"{name}: {counts.sum():.0f} corners over {100 * seen:.0f} % of the image"
        axis.set_title(title, fontsize=10)
        axis.set_facecolor("#dddddd")
        figure.colorbar(shown, ax=axis, label="corners a cell", shrink=0.8)
    return figure


def _residuals(fit: FittedRig, cameras: Sequence[str]) -> Any:
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


def _over_images(fit: FittedRig, cameras: Sequence[str]) -> Any:
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


def _workspace(aim: ExpectedPointing, covariance: FloatArray, fit: FittedRig) -> Any:
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

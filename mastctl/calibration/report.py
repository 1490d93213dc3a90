"""What a calibration leaves to read: one self-contained HTML page that says whether to trust it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib.adjust.hypotheses import Finding
from calib.adjust.result import HELD_FIXED, BenchCalibration, Calibration, FittedRig
from calib.files import save_bytes
from calib.files.mast_file import StoredRig
from calib.geometry.rig import Rig
from calib.survey.records import Survey
from mastctl.as_json import readable
from mastctl.calibration import drawn
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


def finding_table(heading: str, findings: Sequence[Finding], most: int | None = None) -> Table | None:
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
        for one in findings[:most]
    ]
    return Table((heading, "numbers", "gain in chi-square", "chance", ""), rows)


def _drawings(survey: Survey, fit: AnyFit) -> Iterable[tuple[str, Any, str, str]]:
    """Heading, figure, what it shows for those who cannot see it, caption."""
    cameras = [name for name in fit.rig.cameras if any(i.camera == name for i in fit.images)]
    yield (
        "Where in the images the board was seen",
        drawn.coverage(fit, cameras),
        "maps of the corners over each camera's image",
        "Corners in cells of the image; gray cells have seen none, and the lens is extrapolated there.",
    )
    yield (
        "Residuals over the images",
        drawn.residuals(fit, cameras),
        "residual arrows over each camera's image",
        "Predicted less measured. They should look like noise: arrows that grow to the corners are the "
        "lens's, arrows that all point one way in an image a joint's, a tape's or a prism's.",
    )
    yield (
        "Residuals by joint angle, distance and angle of the board",
        drawn.over_images(fit, cameras),
        "mean residual of each image over pan and tilt, rms over range and angle",
        "An error of a joint moves whole images: pan in x, tilt in y. A wave is a harmonic, two levels are "
        "backlash. Triangles: images that were not fitted.",
    )
    if isinstance(fit, BenchCalibration):
        yield (
            "Errors of the joints",
            drawn.joint_curves(fit, survey),
            "true less read angle over each joint's reading",
            "The fitted curve with its 95 % band, and what each image says of it (one point an image).",
        )
    expected = expected_pointing(fit)
    if expected is not None:
        yield (
            "How sure pointing is over the workspace",
            drawn.workspace(*expected, fit),
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
    sizes = []
    for image in fit.images:
        which = image.used if image.purpose != "check" else np.ones(len(image.used), dtype=bool)
        if which.any():
            rms_px = float(np.sqrt(np.mean(image.residuals_px[which] ** 2)))
            sizes.append((rms_px if np.isfinite(rms_px) else np.inf, image))
    sizes.sort(key=lambda pair: -pair[0])
    rows = [
        [
            f"{rms:.3f}",
            f"{image.range_m:.2f}",
            f"{np.degrees(image.incidence_rad):.0f}",
            f"{int((~image.used).sum()) if image.purpose != 'check' else 0}",
            image.purpose,
            f"{image.setup} / {image.placement}",
            image.name,
        ]
        for rms, image in sizes[:WORST_IMAGES]
    ]
    headings = ("rms px", "range m", "turned deg", "dots out", "purpose", "set-up / placement", "image")
    return Table(headings, rows)

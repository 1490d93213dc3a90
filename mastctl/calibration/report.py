"""What a calibration leaves to read: one self-contained HTML page that says whether to trust it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib.adjust.result import HELD_FIXED, Calibration
from calib.files.atomic import save_bytes
from calib.files.mast_file import StoredRig
from mastctl.as_json import readable
from mastctl.calibration import drawn
from mastctl.calibration.landing import change_map, uncertainty_map
from mastctl.calibration.run import Calibrated
from mastctl.calibration.tested import component_table, finding_table
from mastctl.calibration.verdict import POINTING_RANGE_M
from mastctl.report import pages, plots
from mastctl.report.pictures import Figure
from mastctl.report.tables import Table, x_y

WORST_IMAGES = 12


def write_calibration_report(told: Calibrated, in_use: StoredRig | None, folder: Path) -> Path:
    """Write calibration.html into ``folder`` (made if need be) in one step and return it.

    It compares with the mast file ``in_use``, if there is one. A report that was there is kept as
    calibration.previous.html.

    Raises
    ------
    OSError, BadFile
        If it cannot be written; then the file is as it was.
    """
    page = readable(_page(told, in_use)).encode()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "calibration.html"
    save_bytes(path, page)
    return path


def mast_table(calibration: Calibration) -> Table:
    """Return the mast's parameters with their sigmas, one row each."""
    mast, sigma = calibration.rig.mast, calibration.sigma["mast"]
    rows = []
    for key, unit, word in (("translation_m", "m", "t"), ("rotation_rad", "rad", "θ")):
        for index, axis in enumerate("xyz"):
            value, spread = getattr(mast, key)[index], sigma[key][index]
            rows.append([f"{word}{axis}", f"{value:+.5f} {unit}", _spread(spread, unit)])
    if calibration.mast_parameters == 8:
        for key, unit in (("axis_offset_m", "m"), ("axis_twist_rad", "rad")):
            rows.append([key, f"{getattr(mast, key):+.5f} {unit}", _spread(sigma[key], unit)])
    return Table(("parameter", "value", "sigma"), rows)


def camera_table(calibration: Calibration) -> Table:
    """Return the cameras: images, dots, rms of the fit x and y, rms of check images x and y."""
    rows = []
    for name in calibration.rig.cameras:
        mine = [i for i in calibration.images if i.camera == name and i.purpose != "check" and i.used.any()]
        checks = [i for i in calibration.images if i.camera == name and i.purpose == "check"]
        fitted, check = calibration.rms_px.get(name), calibration.check_rms_px.get(name)
        rows.append(
            [
                name,
                f"{len(mine)}",
                f"{sum(int(i.used.sum()) for i in mine)}",
                x_y(fitted, 3),
                f"{len(checks)}",
                x_y(check, 3),
            ]
        )
    return Table(("camera", "images", "dots", "rms x, y px", "checks", "check rms x, y px"), rows)


def _spread(sigma: float, unit: str) -> str:
    if sigma == 0.0:
        return "not fitted"
    return f"± {1000 * sigma:.2f} m{unit}"


def _page(told: Calibrated, in_use: StoredRig | None) -> str:
    calibration, survey, verdict = told.calibration, told.survey, told.verdict
    return pages.page(
        "calibration.html",
        title="Mast calibration",
        badge=pages.Badge(verdict.words.upper(), verdict.grade),
        facts=[
            ("survey", survey.folder.resolve().name),
            ("digest", survey.digest[:12]),
            ("method", f"{calibration.method}, {calibration.mast_parameters} mast parameters"),
            ("mast file", f"{told.saved.path.name} ({told.saved.digest[:12]})"),
            ("fitted in", f"{calibration.seconds:.1f} s"),
            ("made", f"{_when(told.saved)} by {told.saved.rig.provenance.get('program')}"),
        ],
        reasons=[(pages.Badge(one.grade, one.grade), one.sentence) for one in verdict.reasons],
        mast=mast_table(calibration),
        cameras=camera_table(calibration),
        measurements=component_table(survey, calibration),
        wider=finding_table("wider model", calibration.wider),
        boards=finding_table("placement", calibration.contradictions),
        notes=calibration.notes,
        held_fixed=HELD_FIXED,
        warnings=told.warnings,
        left_out=[outlier.sentence for outlier in calibration.outliers],
        undetected=[f"{name}: {reason}" for name, reason in told.undetected],
        plots=_plots(told, in_use) if plots.installed() else None,
        station=_station_table(calibration),
        worst_images=_worst_images(calibration),
    )


def _when(saved: StoredRig) -> str:
    """The date of the mast file as a person writes it."""
    date = str(saved.rig.provenance.get("date", ""))
    return date.replace("T", " ").replace("+00:00", " UTC")


def _plots(told: Calibrated, in_use: StoredRig | None) -> dict[str, Any]:
    """Every plot, by the name that the template has for it."""
    calibration = told.calibration
    pairs = [p for p, c in calibration.rig.stereo.items() if calibration.rig.cameras[c[0]].on == "head"]
    uncertainties = []
    for name in pairs:
        made = drawn.pointing_map(uncertainty_map(calibration, name, POINTING_RANGE_M), calibration, "sigma")
        uncertainties.append(plots.plot(made, f"uncertainty of {name}", kind="map"))
    return {
        "residuals": [
            plots.plot(drawn.residuals(calibration, name), f"residuals of {name}", _mean(told, name))
            for name in calibration.rig.cameras
        ],
        "boards": plots.plot(drawn.boards(calibration, told.survey.board), "boards in plan and side view"),
        "errors": plots.plot(drawn.errors_by(calibration), "rms of images over range, angle, pan and tilt"),
        "correlations": _correlations(calibration),
        "uncertainties": uncertainties,
        "change": None if in_use is None else _change(calibration, in_use, pairs),
    }


def _correlations(calibration: Calibration) -> list[Figure]:
    """Of the mast's parameters, where it was fitted, and of all."""
    mast, names = calibration.part("mast."), calibration.parameter_names
    found = []
    if len(mast):
        mine = calibration.covariance[np.ix_(mast, mast)]
        made = drawn.correlation([names[i] for i in mast], mine, "mast")
        found.append(plots.plot(made, "correlation of mast parameters", "Mast parameters."))
    caption = "All parameters. Directions that the prisms leave open turn mast and cameras together."
    made = drawn.correlation(names, calibration.covariance, "mast and cameras")
    return [*found, plots.plot(made, "correlation of all parameters", caption)]


def _change(calibration: Calibration, in_use: StoredRig, pairs: Sequence[str]) -> dict[str, Any]:
    """By how many pixels pointing would change against the mast file in use."""
    rows, maps = [], []
    for name in pairs:
        change = change_map(calibration.rig, in_use.rig, name, POINTING_RANGE_M)
        if change is None:
            rows.append([name, "", "", "the mast file in use lacks these cameras"])
            continue
        rows.append([name, _typical(change.by_click), _typical(change.by_position), ""])
        maps.append(
            plots.plot(drawn.pointing_map(change, calibration, "change"), f"change of {name}", kind="map")
        )
    table = Table(("pair", "clicked, px", "position in the rover frame, px", ""), rows)
    return {"file": f"{in_use.path.name} ({in_use.digest[:12]})", "table": table, "maps": maps}


def change_summary(calibration: Calibration, in_use: StoredRig) -> dict[str, dict[str, float]]:
    """Return by pair the median and largest change of pointing, px, against the mast file in use."""
    summary = {}
    for pair, names in calibration.rig.stereo.items():
        if calibration.rig.cameras[names[0]].on != "head":
            continue
        change = change_map(calibration.rig, in_use.rig, pair, POINTING_RANGE_M)
        if change is not None and np.isfinite(change.by_click).any():
            summary[pair] = {
                "median_px": float(np.nanmedian(change.by_click)),
                "most_px": float(np.nanmax(change.by_click)),
                "position_median_px": float(np.nanmedian(change.by_position)),
                "position_most_px": float(np.nanmax(change.by_position)),
            }
    return summary


def _typical(values: np.ndarray) -> str:
    if not np.isfinite(values).any():
        return "none"
    return f"{np.nanmedian(values):.2f}, at most {np.nanmax(values):.2f}"


def _mean(told: Calibrated, camera: str) -> str:
    fitted = told.calibration.rms_px.get(camera)
    check = told.calibration.check_rms_px.get(camera)
    words = [f"fitted {x_y(fitted, 3)} px rms"] if fitted else []
    words += [f"check {x_y(check, 3)} px rms"] if check else []
    return f"{camera}: " + ", ".join(words)


def _station_table(calibration: Calibration) -> Table:
    """Rms of the residuals of prisms by set-up and of tapes by placement, worst first."""
    groups: dict[tuple[str, str, str], list[float]] = {}
    for point in calibration.station:
        size = 1000 * float(np.linalg.norm(point.residual_m))
        groups.setdefault((point.kind, point.setup, point.placement), []).append(size)
    rows = [
        [
            kind,
            setup,
            placement,
            f"{len(sizes)}",
            f"{np.sqrt(np.mean(np.square(sizes))):.2f}",
            f"{max(sizes):.2f}",
        ]
        for (kind, setup, placement), sizes in groups.items()
    ]
    rows.sort(key=lambda row: (row[0], -float(row[5])))
    return Table(("kind", "set-up", "placement", "points", "rms mm", "worst mm"), rows)


def _worst_images(calibration: Calibration) -> Table:
    """The images that fit worst."""
    sizes = []
    for image in calibration.images:
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
    return Table(
        ("rms px", "range m", "turned deg", "dots out", "purpose", "set-up / placement", "image"), rows
    )

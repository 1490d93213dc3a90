"""What a bench leaves to read: one self-contained HTML page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.adjust.result import BenchCalibration
from calib.files.atomic import save_bytes
from calib.files.mast_file import StoredRig
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.plan.knowledge import ExpectedPointing
from calib.survey.records import Survey
from mastctl.as_json import readable
from mastctl.bench import drawn
from mastctl.bench.differences import rig_differences
from mastctl.bench.run import Checked
from mastctl.calibration.verdict import CalibrationVerdict
from mastctl.report import pages, plots
from mastctl.report.tables import Table, x_y

PAGE = "bench.html"


@dataclass(frozen=True, eq=False)
class BenchPage:
    """All that the page is made of.

    ``aim`` and ``covariance`` are the pointing over the workspace and what is unsure of its unknowns;
    ``worth`` rows of words and numbers; ``former`` the rig to compare with.
    """

    survey: Survey
    calibration: BenchCalibration
    verdict: CalibrationVerdict
    saved: StoredRig
    checked: Checked | None
    aim: ExpectedPointing
    covariance: FloatArray
    worth: tuple[tuple[str, str], ...]
    former: Rig | None


def write_bench_report(told: BenchPage, folder: Path) -> Path:
    """Write bench.html into ``folder`` (made if need be) in one step and return it.

    Raises
    ------
    OSError, BadFile
        If it cannot be written; then the file is as it was.
    """
    page = readable(_page(told)).encode()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / PAGE
    save_bytes(path, page)
    return path


def _page(told: BenchPage) -> str:
    fit = told.calibration
    differences = [] if told.former is None else list(rig_differences(fit.rig, told.former))
    return pages.page(
        "bench.html",
        title="Bench calibration",
        badge=pages.Badge(told.verdict.words.upper(), told.verdict.grade),
        facts=[
            ("survey", told.survey.folder.resolve().name),
            ("digest", told.survey.digest[:12]),
            ("mast file", f"{told.saved.path.name} ({told.saved.digest[:12]})"),
            ("fitted in", f"{fit.seconds:.1f} s"),
            ("made by", str(told.saved.rig.provenance.get("program"))),
        ],
        reasons=[(pages.Badge(one.grade, one.grade), one.sentence) for one in told.verdict.reasons],
        worth=Table(("what", "value"), [list(row) for row in told.worth]),
        pointings=_pointings(told.checked),
        cameras=_cameras(fit, told.checked),
        terms=_terms(fit),
        gauges=fit.gauges,
        notes=fit.notes,
        left_out=[outlier.sentence for outlier in fit.outliers],
        moved=[one.sentence for one in differences],
        plots=_plots(told, differences) if plots.installed() else None,
    )


def _pointings(checked: Checked | None) -> Table | None:
    if checked is None or not checked.pointings:
        return None
    rows = [
        [
            f"{one.corner}",
            f"{one.range_m:.2f}",
            f"{one.turned_deg:.0f}",
            f"{one.residual_px[0]:+.3f}",
            f"{one.residual_px[1]:+.3f}",
            f"{one.promised_px:.3f}",
        ]
        for one in checked.pointings
    ]
    return Table(("corner", "range m", "turned deg", "residual x px", "y px", "promised sigma px"), rows)


def _cameras(fit: BenchCalibration, checked: Checked | None) -> Table:
    rows = []
    for name in fit.rig.cameras:
        mine = [i for i in fit.images if i.camera == name and i.purpose != "check"]
        checks = [i for i in fit.images if i.camera == name and i.purpose == "check"]
        promised = None if checked is None else checked.promised_px.get(name)
        rows.append(
            [
                name,
                f"{len(mine)}",
                f"{sum(int(i.used.sum()) for i in mine)}",
                x_y(fit.rms_px.get(name), 3),
                f"{len(checks)}",
                x_y(fit.check_rms_px.get(name), 3),
                "" if promised is None else f"{promised:.3f}",
            ]
        )
    headings = (
        "camera",
        "images",
        "corners",
        "rms x, y px",
        "not fitted",
        "their rms x, y px",
        "promised px",
    )
    return Table(headings, rows)


def _terms(fit: BenchCalibration) -> Table:
    rows = []
    for term in fit.terms:
        size = float(np.linalg.norm(term.values))
        spread = float(np.sqrt(np.mean(term.sigma**2))) if len(term.sigma) else 0.0
        length = any(name.endswith("_m") or ".bow_m" in name for name in term.parameters)
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


def _plots(told: BenchPage, differences: list[Any]) -> dict[str, Any]:
    """Every plot, by the name that the template has for it."""
    fit = told.calibration
    cameras = [name for name in fit.rig.cameras if any(i.camera == name for i in fit.images)]
    looked = np.array(
        sorted({(i.pan_rad, i.tilt_rad) for i in fit.images if i.pan_rad is not None}), dtype=float
    )
    shown: dict[str, Any] = {
        "coverage": plots.plot(
            drawn.coverage(fit, cameras),
            "maps of the corners over each camera's picture",
            "Corners in cells of the picture; grey cells have seen none, and the lens is extrapolated there.",
            "map",
        ),
        "residuals": plots.plot(
            drawn.residuals(fit, cameras),
            "residual arrows over each camera's picture",
            "Predicted less measured. They should look like noise: arrows that grow to the corners "
            "are the lens's, arrows that all point one way in a picture the joints'.",
        ),
        "joints": plots.plot(
            drawn.against_joints(fit, cameras),
            "mean residual of each picture over pan and tilt",
            "An error of a joint moves whole pictures: pan in x, tilt in y. A wave is a harmonic, "
            "two levels are backlash. The model has no term for the rest shown here.",
        ),
        "curves": plots.plot(
            drawn.joint_curves(fit, told.survey),
            "true less read angle over each joint's reading",
            "The fitted curve with its 95 % band, and what each picture says of it (one point a picture).",
        ),
        "lens": plots.plot(
            drawn.lens_uncertainty(fit, cameras),
            "maps of the uncertainty of projection",
            "95 % of a pixel of a target 5 m away in the head; below, what is left when the camera may move.",
            "map",
        ),
        "workspace": plots.plot(
            drawn.workspace(drawn.pointing_table(told.aim, told.covariance), looked),
            "maps of the predicted pointing error over pan and tilt",
            "One sigma an axis of a first pointing, by the calibration; dots are pictures.",
            "map",
        ),
        "difference": None,
    }
    if differences:
        shown["difference"] = plots.plot(
            drawn.differences(differences),
            "arrows between the new and the former model of each lens",
            "Where the new model sees what the former one saw at a pixel, the implied motion taken out.",
        )
    return shown

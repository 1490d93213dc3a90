"""The result of a bench: its mast file, its report, and the document that commands show."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from calib.adjust.result import BenchCalibration
from calib.files.mast_file import joint_keys
from calib.geometry.rig import Rig
from calib.survey.records import Survey
from mastctl.as_json import as_json
from mastctl.bench.check import Checked
from mastctl.bench.survey import fit_in_frame
from mastctl.calibration.landing import expected_pointing
from mastctl.calibration.run import checked_survey, conclude, fit_document, picked, with_fit
from mastctl.calibration.verdict import judge
from mastctl.report.pages import Table


def fit_again(
    survey: Survey, out: Path, report: Path | None, mast_at: Sequence[float] | None, former: Rig | None
) -> dict[str, Any]:
    """Fit a bench's folder again, and return what `saved` does; the rest is of `fit_in_frame`.

    Raises SurveyRefused if something is missing, BenchNotFitted if the images do not determine a rig; nothing
    is written then.
    """
    checked_survey(survey)
    return saved(survey, fit_in_frame(survey, mast_at, former), former, out, report)


def saved(
    survey: Survey,
    fit: BenchCalibration,
    former: Rig | None,
    out: Path,
    report: Path | None,
    checked: Checked | None = None,
) -> dict[str, Any]:
    """Judge a fit, save the mast file and the report if one is requested, and return all as JSON.

    ``checked`` was measured at the end of a run. ``calibrated_px``, ``counts_px``: what the calibration, and
    the encoders' counts alone, leave of a first pointing, rms per axis; ``pictures`` of the camera with most.
    """
    verdict = judge(survey, fit)
    if former is not None:
        fit = replace(fit, notes=(*fit.notes, *_former_notes(fit, former)))
    rig = with_fit(fit, survey, verdict)
    rig = rig if former is None else with_former(rig, former)
    pointing = expected_pointing(fit)
    cameras = Counter(image.camera for image in fit.images if image.purpose != "check")
    numbers: dict[str, Any] = {
        "calibrated_px": None if pointing is None else pointing[0].rms_px(pointing[1]),
        "counts_px": None if pointing is None else pointing[0].by_counts_px(fit.joint_rad),
        "placements": len(fit.rover_from_board),
        "pictures": max(cameras.values(), default=0),
    }
    own: dict[str, Any] = {"worth": Table(("quantity", "value"), list(_worth(numbers, checked)))}
    if checked is not None:
        own |= {"pointings": checked.table(), "promised_px": checked.promised_px}
    file, _, page = conclude(survey, fit, verdict, rig, out, report, former, **own)
    document = {
        **fit_document(survey, fit, verdict, file),
        **numbers,
        "joints": joint_keys(fit.rig.joints),
        "terms": [term.as_json() for term in fit.terms],
        "bows_m": as_json(fit.bows_m),
        "gauges": list(fit.gauges),
        "outliers": [outlier.sentence for outlier in fit.outliers],
        "survey": {"folder": str(survey.folder), "digest": survey.digest},
        "report": None if page is None else str(page),
    }
    keys = "promised_px", "pointings", "pointing_rms_px", "pointing_promised_px"
    return document if checked is None else {**document, "check": picked(checked, *keys)}


def with_former(rig: Rig, former: Rig) -> Rig:
    """Return the rig with the former one's name, and its body cameras that were not tied to the head."""
    body = {n: c for n, c in former.cameras.items() if c.on == "rover" and n not in rig.cameras}
    cameras = {**rig.cameras, **body}
    order = [*(n for n in former.cameras if n in cameras), *(n for n in cameras if n not in former.cameras)]
    stereo = {**{n: p for n, p in former.stereo.items() if set(p) <= set(cameras)}, **rig.stereo}
    return replace(rig, name=former.name, cameras={n: cameras[n] for n in order}, stereo=stereo)


def _former_notes(fit: BenchCalibration, former: Rig) -> Iterator[str]:
    """A note on each camera that the former mast file has and no image shows."""
    for name, camera in former.cameras.items():
        if name in fit.rig.cameras:
            continue
        if camera.on == "rover":
            yield f"camera {name} stays in the mast file as the former one has it"
        else:
            yield (
                f"camera {name} is not in the mast file any more: the head is another frame now, and none of "
                "its images shows the board"
            )


def _worth(numbers: Mapping[str, Any], checked: Checked | None) -> Iterator[tuple[str, str]]:
    if numbers["calibrated_px"] is not None:
        yield "first pointing, rms an axis, by the calibration", px(numbers["calibrated_px"])
        yield "the same by the encoders' counts alone", px(numbers["counts_px"])
    if checked is not None and checked.pointing_rms_px is not None:
        x, y = checked.pointing_rms_px
        measured = f"{x:.2f}, {y:.2f} px, promised {checked.pointing_promised_px:.2f}"
        yield f"pointed at {len(checked.pointings)} corners, rms x and y", measured
    yield "taken", f"{numbers['placements']} placements, {numbers['pictures']} pictures a camera"


def px(value: float | None) -> str:
    """Return pixels as a person reads them."""
    if value is None or not math.isfinite(value):
        return "? px"
    return f"{value:.2f} px" if value < 10 else f"{value:.0f} px"

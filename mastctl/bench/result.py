"""The end of a bench: the check, the mast file, the report, and what commands show of them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import Any

from calib.adjust.result import BenchCalibration
from calib.files.mast_file import StoredRig, joint_keys
from calib.geometry.rig import Rig
from calib.survey.records import Survey
from mastctl.as_json import as_json
from mastctl.bench.check import Checked
from mastctl.bench.run import BenchRun, Reporter
from mastctl.bench.survey import fit_in_frame
from mastctl.calibration.landing import expected_pointing
from mastctl.calibration.run import checked_survey, conclude, fit_document, picked, with_fit
from mastctl.calibration.verdict import CalibrationVerdict, judge
from mastctl.report.pages import Table


@dataclass(frozen=True, eq=False)
class BenchDone:
    """A bench that is over.

    ``checked``: measured at the end, None of a folder that was fitted again. ``predicted_px``,
    ``calibrated_px``, ``counts_px``: rms per axis of a first pointing, as expected when pictures sufficed, by
    the calibration's own covariance, and by counts alone. ``pictures`` of the camera with most; ``page``: the
    report.
    """

    survey: Survey
    calibration: BenchCalibration
    verdict: CalibrationVerdict
    saved: StoredRig
    checked: Checked | None
    worth: Sequence[tuple[str, str]]
    """What a pointing may expect, and what was measured: quantities and values."""
    _: KW_ONLY
    predicted_px: float | None = None
    calibrated_px: float | None = None
    counts_px: float | None = None
    placements: int = 0
    pictures: int = 0
    page: Path | None = None

    def as_json(self) -> dict[str, Any]:
        """Return it as the command prints it."""
        fit = self.calibration
        document: dict[str, Any] = {
            **fit_document(self.survey, fit, self.verdict, self.saved),
            "joints": joint_keys(fit.rig.joints),
            "terms": [term.as_json() for term in fit.terms],
            "bows_m": as_json(fit.bows_m),
            "gauges": list(fit.gauges),
            "outliers": [outlier.sentence for outlier in fit.outliers],
            "survey": {"folder": str(self.survey.folder), "digest": self.survey.digest},
            **picked(self, "placements", "pictures", "predicted_px", "calibrated_px", "counts_px"),
            "report": None if self.page is None else str(self.page),
        }
        if self.checked is not None:
            keys = "promised_px", "pointings", "pointing_rms_px", "pointing_promised_px"
            document["check"] = picked(self.checked, *keys)
        return document


def finish(bench: BenchRun, reporter: Reporter, out: Path, report: Path | None) -> BenchDone:
    """Run a bench to its end, check it, and save its mast file and report.

    Raises as `BenchRun.run`; no mast file is written then.
    """
    bench.run()
    reporter.step("check")
    checked = bench.check()
    reporter.step("fit")
    known = bench.known
    fit = known.fit()
    numbers = {
        "predicted_px": known.predicted_px(),
        "counts_px": known.counts_px,
        "placements": len(known.placements()),
        "pictures": known.pictures(),
    }
    return _save(known.kept.survey(), fit, known.head.rig, out, report, checked, **numbers)


def fit_again(
    survey: Survey,
    out: Path,
    report: Path | None,
    mast_at: Sequence[float] | None,
    former: Rig | None,
    moved: Mapping[str, float],
) -> BenchDone:
    """Fit a bench's folder again, and save its mast file and report; the rest is of `fit_in_frame`.

    Raises SurveyRefused if something is missing, BenchNotFitted if the images do not determine a rig; nothing
    is written then.
    """
    checked_survey(survey)
    fit = fit_in_frame(survey, mast_at, former, moved)
    cameras = Counter(image.camera for image in fit.images if image.purpose != "check")
    expected = expected_pointing(fit)
    numbers = {
        "predicted_px": None if expected is None else expected[0].rms_px(expected[1]),
        "counts_px": None if expected is None else expected[0].by_counts_px(fit.joint_rad),
        "placements": len(fit.rover_from_board),
        "pictures": max(cameras.values(), default=0),
    }
    return _save(survey, fit, former, out, report, None, **numbers)


def _save(
    survey: Survey,
    fit: BenchCalibration,
    former: Rig | None,
    out: Path,
    report: Path | None,
    checked: Checked | None,
    **numbers: Any,
) -> BenchDone:
    """Judge a fit, save the mast file, and write the report if one is requested."""
    verdict = judge(survey, fit)
    if former is not None:
        fit = replace(fit, notes=(*fit.notes, *_former_notes(fit, former)))
    rig = with_fit(fit, survey, verdict)
    rig = rig if former is None else with_former(rig, former)
    expected = expected_pointing(fit)
    calibrated_px = None if expected is None else expected[0].rms_px(expected[1])
    numbers["calibrated_px"] = calibrated_px
    worth = list(_worth(checked, numbers))
    own = {
        "worth": Table(("quantity", "value"), worth),
        "pointings": _pointings(checked),
        "promised_px": None if checked is None else checked.promised_px,
    }
    saved, _, page = conclude(survey, fit, verdict, rig, out, report, former, **own)
    return BenchDone(survey, fit, verdict, saved, checked, worth, page=page, **numbers)


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


def _worth(checked: Checked | None, numbers: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    if numbers["calibrated_px"] is not None:
        yield "first pointing, rms an axis, by the calibration", px(numbers["calibrated_px"])
    if numbers["counts_px"] is not None:
        yield "the same by the encoders' counts alone", px(numbers["counts_px"])
    if checked is not None and checked.pointing_rms_px is not None:
        x, y = checked.pointing_rms_px
        promised = checked.pointing_promised_px or 0.0
        yield (
            f"pointed at {len(checked.pointings)} corners, rms x and y",
            f"{x:.2f}, {y:.2f} px, promised {promised:.2f}",
        )
    yield "taken", f"{numbers['placements']} placements, {numbers['pictures']} pictures a camera"


def _pointings(checked: Checked | None) -> Table | None:
    if checked is None or not checked.pointings:
        return None
    rows = [
        [
            f"{one.corner}",
            f"{one.range_m:.2f}",
            f"{one.turned_deg:.0f}",
            *(f"{part:+.3f}" for part in one.residual_px),
            f"{one.promised_px:.3f}",
        ]
        for one in checked.pointings
    ]
    return Table(("corner", "range m", "turned deg", "residual x px", "y px", "promised sigma px"), rows)


def px(value: float | None) -> str:
    """Return pixels as a person reads them."""
    if value is None or not math.isfinite(value):
        return "? px"
    return f"{value:.2f} px" if value < 10 else f"{value:.0f} px"

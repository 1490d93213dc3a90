"""What a bench ends with: the check, the mast file, the report, and what is told of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from calib.files.mast_file import StoredRig
from calib.files.yaml_text import plain
from calib.fit.bench_calibration import BenchCalibration
from calib.mast.rig import Rig
from calib.survey import Survey
from mastctl.bench.final import Checked
from mastctl.bench.run import BenchRun
from mastctl.bench.teller import Teller, px
from mastctl.calibration.mast_file import as_lists, mast_keys, rounded_matrix
from mastctl.calibration.run import save_new


@dataclass(frozen=True, eq=False)
class BenchDone:
    """A bench that is over.

    Attributes
    ----------
    survey, calibration
        What was seen, and what was made of it.
    saved
        The mast file.
    checked
        What the end showed; None of a folder that was fitted again.
    predicted_px, floor_px
        Rms per axis of a first pointing that the calibration leaves, and what counts alone leave.
    seconds, placements, pictures
        Of the rover's time; how many; of the camera with most.
    page
        The report.
    """

    survey: Survey
    calibration: BenchCalibration
    saved: StoredRig
    checked: Checked | None = None
    predicted_px: float | None = None
    floor_px: float | None = None
    seconds: float | None = None
    placements: int = 0
    pictures: int = 0
    page: Path | None = None

    def told(self) -> dict[str, Any]:
        """Return it as JSON."""
        fit = self.calibration
        document: dict[str, Any] = {
            "rms_px": as_lists(fit.rms_px),
            "check_rms_px": as_lists(fit.check_rms_px),
            "mast": mast_keys(fit.rig),
            "sigma": {**plain(fit.sigma)["mast"], **plain(fit.sigma)},
            "seconds": fit.seconds,
            "terms": [
                {"name": term.name, "entered": term.entered, "sentence": term.sentence} for term in fit.terms
            ],
            "gauges": list(fit.gauges),
            "notes": list(fit.notes),
            "outliers": [outlier.sentence for outlier in fit.outliers],
            "mast_file": {"path": str(self.saved.path), "digest": self.saved.digest},
            "survey": {"folder": str(self.survey.folder), "digest": self.survey.digest},
            "placements": self.placements,
            "pictures": self.pictures,
            "rover_seconds": self.seconds,
            "predicted_px": self.predicted_px,
            "counts_px": self.floor_px,
            "report": None if self.page is None else str(self.page),
        }
        if self.checked is not None:
            document["check"] = {
                "promised_px": dict(self.checked.promised_px),
                "pointings": [
                    {
                        "corner": one.corner, "range_m": one.range_m, "turned_deg": one.turned_deg,
                        "residual_px": list(one.residual_px), "promised_px": one.promised_px,
                    }
                    for one in self.checked.pointings
                ],
                "pointing_rms_px": None
                if self.checked.pointing_rms_px is None
                else list(self.checked.pointing_rms_px),
                "pointing_promised_px": self.checked.pointing_promised_px,
            }  # fmt: skip
        return document

    def lines(self) -> list[str]:
        """Return it for a person."""
        return list(self._lines())

    def _lines(self) -> Iterator[str]:
        fit = self.calibration
        if self.seconds is not None:
            yield (
                f"{self.placements} placements, {self.pictures} pictures a camera, {self.seconds:.0f} s "
                "of the rover's time"
            )
        for name, (x, y) in fit.rms_px.items():
            line = f"{name}: rms {x:.3f}, {y:.3f} px"
            if name in fit.check_rms_px:
                check = fit.check_rms_px[name]
                line += f"; not fitted {check[0]:.3f}, {check[1]:.3f} px"
                promised = None if self.checked is None else self.checked.promised_px.get(name)
                line += f" (promised {promised:.3f})" if promised is not None else ""
            yield line
        for term in fit.terms:
            yield term.sentence
        if self.predicted_px is not None and self.floor_px is not None:
            yield (
                f"first pointing: {px(self.predicted_px)} rms an axis by the calibration, "
                f"{px(self.floor_px)} by the encoders' counts"
            )
        if self.checked is not None and self.checked.pointing_rms_px is not None:
            x, y = self.checked.pointing_rms_px
            yield (
                f"pointed at {len(self.checked.pointings)} corners: rms {x:.2f}, {y:.2f} px, "
                f"promised {self.checked.pointing_promised_px:.2f}"
            )
        yield from (f"held: {sentence}" for sentence in fit.gauges)
        yield from (f"note: {sentence}" for sentence in fit.notes)
        yield from (f"left out: {outlier.sentence}" for outlier in fit.outliers[:10])
        yield f"mast file: {self.saved.path} ({self.saved.digest[:12]})"
        yield f"survey: {self.survey.folder}"
        if self.page is not None:
            yield f"report: {self.page}"


def finish(bench: BenchRun, teller: Teller, out: Path, report: Path | None) -> BenchDone:
    """Run a bench to its end, check it, and save what came of it.

    Raises
    ------
    MastctlError, CalibError
        As `BenchRun.run`; no mast file is written.
    """
    bench.run()
    checked = bench.check()
    fitted = bench.fit_all()
    calibration = fitted.calibration
    assert calibration is not None
    survey = bench.survey()
    rig = replace(with_bench_fit(calibration, survey), name=bench.name)
    saved, _ = save_new(rig, out)
    return BenchDone(
        survey,
        calibration,
        saved,
        checked,
        bench.predicted_px(),
        bench.floor_px,
        bench.seconds(),
        len(bench.placements()),
        bench.pictures(),
    )


def save_bench(survey: Survey, out: Path, report: Path | None) -> BenchDone:
    """Fit a bench's folder again and save the mast file."""
    from calib.fit.bench import fit_bench

    calibration = fit_bench(survey)
    saved, _ = save_new(with_bench_fit(calibration, survey), out)
    return BenchDone(survey, calibration, saved)


def with_bench_fit(calibration: BenchCalibration, survey: Survey) -> Rig:
    """Return the calibrated rig with ``fit`` and ``provenance`` filled in."""
    fit = {
        "method": "bench",
        "rms_px": as_lists(calibration.rms_px),
        "check_rms_px": as_lists(calibration.check_rms_px),
        "sigma": plain(calibration.sigma),
        "chi2": _finite(calibration.chi2),
        "degrees_of_freedom": _finite(calibration.degrees_of_freedom),
        "terms": [term.sentence for term in calibration.terms],
        "gauges": list(calibration.gauges),
        "outliers": [outlier.name for outlier in calibration.outliers],
        "parameters": list(calibration.parameter_names),
        "covariance": rounded_matrix(calibration.covariance).tolist(),
    }
    provenance = {
        "survey": survey.folder.resolve().name,
        "survey_digest": survey.digest,
        "program": f"mastctl {version('mastctl')}",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    return replace(calibration.rig, fit=fit, provenance=provenance)


def _finite(number: float) -> float | None:
    return float(number) if np.isfinite(number) else None

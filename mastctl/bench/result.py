"""What a bench ends with: the check, the mast file, the report, and what is told of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import Any

from calib.adjust.result import BenchCalibration
from calib.calibrate.bench.problem import BenchOptions
from calib.errors import BadFile
from calib.files.mast_file import StoredRig, joint_keys
from calib.files.yaml_text import plain
from calib.geometry.covariance import RigCovariance
from calib.geometry.rig import Rig
from calib.plan.knowledge import Knowledge, Workspace, pointing
from calib.survey.records import Survey
from mastctl.bench.drawn import cells_seen
from mastctl.bench.frame import RoverFrame, fit_in_frame
from mastctl.bench.known import first_cameras
from mastctl.bench.report import BenchPage, write_bench_report
from mastctl.bench.reporter import Reporter, px
from mastctl.bench.run import BenchRun, Checked
from mastctl.calibration.bench_verdict import judge_bench, predicted_pointing_px
from mastctl.calibration.mast_file import as_lists, mast_keys, with_fit
from mastctl.calibration.run import checked_survey, save_new
from mastctl.calibration.tested import components_told, finite
from mastctl.calibration.verdict import CalibrationVerdict
from mastctl.errors import MastctlError

HALF = 0.5


class NotReported(MastctlError):
    """The mast file is saved, its report is not."""

    code = "report_not_written"


@dataclass(frozen=True, eq=False)
class BenchDone:
    """A bench that is over.

    Attributes
    ----------
    survey, calibration
        What was seen, and what was made of it.
    verdict
        Whether to trust it, and why.
    saved
        The mast file.
    checked
        What the end showed; None of a folder that was fitted again.
    predicted_px, calibrated_px, counts_px
        Rms per axis of a first pointing: what was expected when pictures sufficed, what the calibration's own
        covariance tells, and what counts alone leave.
    seconds, placements, pictures
        Of the rover's time; how many; of the camera with most.
    page
        The report.
    """

    survey: Survey
    calibration: BenchCalibration
    verdict: CalibrationVerdict
    saved: StoredRig
    checked: Checked | None = None
    _: KW_ONLY
    predicted_px: float | None = None
    calibrated_px: float | None = None
    counts_px: float | None = None
    seconds: float | None = None
    placements: int = 0
    pictures: int = 0
    page: Path | None = None

    @property
    def coverage(self) -> dict[str, float]:
        """Part of each camera's picture in which corners were fitted, 0 to 1."""
        cameras = sorted({image.camera for image in self.calibration.images})
        return {name: float((cells_seen(self.calibration, name)[0] > 0).mean()) for name in cameras}

    def as_json(self) -> dict[str, Any]:
        """Return it as the command prints it."""
        fit = self.calibration
        document: dict[str, Any] = {
            "rms_px": as_lists(fit.rms_px),
            "check_rms_px": as_lists(fit.check_rms_px),
            "mast": mast_keys(fit.rig),
            "sigma": {**plain(fit.sigma)["mast"], **plain(fit.sigma)},
            "seconds": fit.seconds,
            "joints": joint_keys(fit.rig.joints),
            "chi2": finite(fit.chi2),
            "degrees_of_freedom": finite(fit.degrees_of_freedom),
            "sigmas_found": components_told(self.survey, fit),
            "terms": [term.as_json() for term in fit.terms],
            "bows_m": {board: bow.tolist() for board, bow in fit.bows_m.items()},
            "degenerate": [
                {"parameters": list(d.parameters), "sentence": d.sentence} for d in fit.degenerate
            ],
            "verdict": self.verdict.told(),
            "coverage": self.coverage,
            "gauges": list(fit.gauges),
            "notes": list(fit.notes),
            "outliers": [outlier.sentence for outlier in fit.outliers],
            "mast_file": {"path": str(self.saved.path), "digest": self.saved.digest},
            "survey": {"folder": str(self.survey.folder), "digest": self.survey.digest},
            "placements": self.placements,
            "pictures": self.pictures,
            "rover_seconds": self.seconds,
            "predicted_px": self.predicted_px,
            "calibrated_px": self.calibrated_px,
            "counts_px": self.counts_px,
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

    def worth(self) -> Iterator[tuple[str, str]]:
        """Yield what a pointing may expect, and what was measured: words and figures."""
        if self.calibrated_px is not None:
            yield "first pointing, rms an axis, by the calibration", px(self.calibrated_px)
        if self.counts_px is not None:
            yield "the same by the encoders' counts alone", px(self.counts_px)
        if self.checked is not None and self.checked.pointing_rms_px is not None:
            x, y = self.checked.pointing_rms_px
            promised = self.checked.pointing_promised_px or 0.0
            yield (
                f"pointed at {len(self.checked.pointings)} corners, rms x and y",
                f"{x:.2f}, {y:.2f} px, promised {promised:.2f}",
            )
        if self.seconds is not None:
            yield (
                "taken",
                f"{self.placements} placements, {self.pictures} pictures a camera, "
                f"{self.seconds:.0f} s of the rover's time",
            )

    def lines(self) -> list[str]:
        """Return all but the verdict for a person."""
        return list(self._lines())

    def verdict_line(self) -> str:
        """Return the verdict, with the cameras of whose picture less than `HALF` was seen."""
        few = [f"{name} {100 * part:.0f} %" for name, part in self.coverage.items() if part < HALF]
        if not few:
            return f"verdict: {self.verdict.words}"
        return (
            f"verdict: {self.verdict.words}, but corners were seen over less than half of the picture of "
            f"{', '.join(few)}; where none were, the lens is extrapolated"
        )

    def _lines(self) -> Iterator[str]:
        fit = self.calibration
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
        yield from (f"{what}: {value}" for what, value in self.worth())
        yield from (f"held: {sentence}" for sentence in fit.gauges)
        yield from (f"note: {sentence}" for sentence in fit.notes)
        yield from (f"left out: {outlier.sentence}" for outlier in fit.outliers[:10])
        yield f"mast file: {self.saved.path} ({self.saved.digest[:12]})"
        yield f"survey: {self.survey.folder}"
        if self.page is not None:
            yield f"report: {self.page}"
        yield from (f"{reason.grade}: {reason.sentence}" for reason in self.verdict.reasons)


def finish(bench: BenchRun, reporter: Reporter, out: Path, report: Path | None) -> BenchDone:
    """Run a bench to its end, check it, and save what came of it.

    Raises
    ------
    MastctlError, CalibError
        As `BenchRun.run`; no mast file is written.
    """
    bench.run()
    reporter.step("check")
    checked = bench.check()
    reporter.step("fit")
    known = bench.known
    calibration = known.fit().calibration
    assert calibration is not None
    survey = known.kept.survey()
    verdict = judge_bench(survey, calibration)
    calibration = told_of_former(calibration, known.head.rig)
    rig = with_former(with_bench_fit(calibration, survey, verdict), known.head.rig)
    saved, _ = save_new(rig, out)
    done = BenchDone(
        survey,
        calibration,
        verdict,
        saved,
        checked,
        predicted_px=known.predicted_px(),
        counts_px=known.counts_px,
        seconds=known.kept.seconds(),
        placements=len(known.placements()),
        pictures=known.pictures(),
    )
    return _reported(done, report, known.head.rig, known.workspace)


def save_bench(
    survey: Survey,
    out: Path,
    report: Path | None,
    options: BenchOptions,
    frame: RoverFrame,
    former: Rig | None,
    moved: Mapping[str, float],
) -> BenchDone:
    """Fit a bench's folder again and save the mast file; the rest is of `fit_in_frame`.

    Raises
    ------
    SurveyRefused
        If something is missing.
    BenchNotFitted
        If the pictures do not determine a rig; nothing is written.
    """
    checked_survey(survey)
    calibration = fit_in_frame(survey, frame, former, options, moved)
    verdict = judge_bench(survey, calibration)
    if former is not None:
        calibration = told_of_former(calibration, former)
    rig = with_bench_fit(calibration, survey, verdict)
    saved, _ = save_new(rig if former is None else with_former(rig, former), out)
    predicted = predicted_pointing_px(calibration)
    fitted = [image for image in calibration.images if image.purpose != "check"]
    done = BenchDone(
        survey,
        calibration,
        verdict,
        saved,
        predicted_px=None if predicted is None else predicted[0],
        counts_px=None if predicted is None else predicted[1],
        placements=len(calibration.rover_from_board),
        pictures=max(Counter(image.camera for image in fitted).values(), default=0),
    )
    shown = [image for image in survey.images if image.pan_rad is not None and image.tilt_rad is not None]
    pans, tilts = ([float(getattr(i, f"{joint}_rad")) for i in shown] for joint in ("pan", "tilt"))
    where = Workspace(first_cameras(calibration.rig), (min(pans), max(pans)), (min(tilts), max(tilts)))
    return _reported(done, report, former, where)


def told_of_former(calibration: BenchCalibration, former: Rig) -> BenchCalibration:
    """Return the calibration with a note on cameras that the former mast file has and no picture shows."""
    notes = []
    for name, camera in former.cameras.items():
        if name in calibration.rig.cameras:
            continue
        if camera.on == "rover":
            notes.append(f"camera {name} stays in the mast file as the former one has it")
        else:
            notes.append(
                f"camera {name} is not in the mast file any more: the head is another frame now, and none of "
                "its pictures shows the board"
            )
    return replace(calibration, notes=(*calibration.notes, *notes))


def with_former(rig: Rig, former: Rig) -> Rig:
    """Return the rig with the former one's name, and its body cameras that were not tied to the head."""
    body = {n: c for n, c in former.cameras.items() if c.on == "rover" and n not in rig.cameras}
    cameras = {**rig.cameras, **body}
    order = [*(n for n in former.cameras if n in cameras), *(n for n in cameras if n not in former.cameras)]
    stereo = {**{n: p for n, p in former.stereo.items() if set(p) <= set(cameras)}, **rig.stereo}
    return replace(rig, name=former.name, cameras={n: cameras[n] for n in order}, stereo=stereo)


def _reported(done: BenchDone, folder: Path | None, former: Rig | None, where: Workspace) -> BenchDone:
    """Write the report, if it is asked for."""
    fit = done.calibration
    known = Knowledge(fit.rig, {})
    aim = pointing(known, where)
    covariance = RigCovariance(fit.parameter_names, fit.covariance).among(known.names)
    done = replace(done, calibrated_px=aim.rms_px(covariance))
    if folder is None:
        return done
    told = BenchPage(
        done.survey, fit, done.verdict, done.saved, done.checked, aim, covariance, tuple(done.worth()), former
    )
    try:
        return replace(done, page=write_bench_report(told, folder))
    except (OSError, BadFile) as error:
        raise NotReported(
            f"the mast file {done.saved.path} is saved, but its report is not: {error}"
        ) from None


def with_bench_fit(calibration: BenchCalibration, survey: Survey, verdict: CalibrationVerdict) -> Rig:
    """Return `with_fit` of a bench's calibration."""
    own = {
        "terms": [term.as_json() for term in calibration.terms],
        "bows_m": {board: bow.tolist() for board, bow in calibration.bows_m.items()},
        "degenerate": [direction.sentence for direction in calibration.degenerate],
        "verdict": verdict.told(),
        "gauges": list(calibration.gauges),
        "outliers": [outlier.name for outlier in calibration.outliers],
    }
    return with_fit(calibration, survey, {"method": "bench"}, own, {})

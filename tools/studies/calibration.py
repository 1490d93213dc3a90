"""How good a survey must be: the paper's Tables IV and V, and what pointing by other surveys is worth.

    .venv/bin/python -m tools.studies.calibration --cases 10 --seed 1 --out study

Simulated surveys, larger and smaller, better and worse, each fitted and judged by pointings and hand-offs
with what comes out. One thing is varied at a time from the paper's survey.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib.files.mast_file import load_rig
from calib.geometry.rig import Rig
from mastctl.cli.output import WrongUse, at_least, check_folder, print_table
from mastctl.cli.tasks import tell_report
from mastctl.packaged import config_folder
from mastctl.report import pages, plots
from mastctl.report.pages import write_csv, write_json
from mastctl.report.pictures import Figure
from mastctl.report.tables import Table, number, x_y
from tools.command import end, options, run_cases
from tools.studies.calibration_survey import (
    DISTANCES_M,
    HANDOFFS,
    NAVCAM_TO_HAZCAM,
    PANCAM_TO_NAVCAM,
    PAPER_STATION_M,
    PAPER_TABLE_V,
    CalibrationExperiment,
    Handoff,
    SurveyOutcome,
    VariantSummary,
    one_survey,
    survey_tasks,
    variants,
)

SIX = ("txm, m", "tym, m", "tzm, m", "θxm, rad", "θym, rad", "θzm, rad")
STUDIES = {
    "placements": "placements of the board for the mast",
    "boards": "boards of each ring (two rings a camera pair)",
    "station": "sigma of the station, mm an axis",
    "prisms": "prisms on the rover",
    "mast parameters": "mast parameters (4: the mast taken as upright)",
}
CSV_COLUMNS = ("study", "variant", "quantity", "distance_m", "rms_x_px", "rms_y_px", "failure")


def study_as_json(experiment: CalibrationExperiment) -> dict[str, Any]:
    """Return the whole study as JSON; x and y side by side, pixels."""
    return {
        "seed": experiment.seed,
        "surveys": experiment.surveys,
        "seconds": experiment.seconds,
        "variants": [_variant_told(summary) for summary in experiment.summaries],
        "table_iv": _table_told(table_iv(experiment)),
        "table_v": _table_told(table_v(experiment)),
    }


def pointing_rows(summaries: Sequence[VariantSummary]) -> Table:
    """Return headings and rows on pointing and on the fits: one row a variant."""
    headings = ["study", "", "failed", *(f"{d:g} m" for d in DISTANCES_M)]
    headings += [*(f"exact clicks, {d:g} m" for d in DISTANCES_M), "fit, s"]
    rows = []
    for summary in summaries:
        cells = [summary.variant.study, summary.variant.label, str(summary.failed)]
        for by_distance in (summary.pointing_rms_px, summary.exact_rms_px):
            cells += [x_y(by_distance.get(distance)) for distance in DISTANCES_M]
        rows.append([*cells, f"{summary.seconds:.1f}"])
    return Table(headings, rows)


def handoff_rows(summaries: Sequence[VariantSummary]) -> Table:
    """Return headings and rows on hand-off, rms and worst: one row a variant."""
    headings = ["study", "", *(f"{name}, {d:g} m" for name, d in HANDOFFS)]
    rows = []
    for summary in summaries:
        cells = [summary.variant.study, summary.variant.label]
        for key in HANDOFFS:
            worst = number(summary.handoff_worst_px.get(key))
            cells.append(f"{x_y(summary.handoff_rms_px.get(key))}; {worst}" if worst else "")
        rows.append(cells)
    return Table(headings, rows)


def short_rows(summaries: Sequence[VariantSummary]) -> Table:
    """Return the study for a terminal: x and y of all distances together."""
    headings = ["", "", "pointing", "exact", "Pancam to Navcam", "worst", "Navcam to Hazcam", "worst"]
    rows = []
    for summary in summaries:
        cells = [summary.variant.study, summary.variant.label, number(summary.pointing_px)]
        cells.append(number(summary.exact_px))
        for name in (PANCAM_TO_NAVCAM, NAVCAM_TO_HAZCAM):
            cells += [number(summary.handoff_px(name)), number(summary.handoff_most_px(name))]
        if summary.failed:
            cells[1] += f" ({summary.failed} of {summary.surveys} failed)"
        rows.append(cells)
    return Table(headings, rows)


def table_iv(experiment: CalibrationExperiment) -> Table:
    """Return the paper's Table IV: the mast's six parameters, true and as the surveys found them."""
    headings = ["", *SIX]
    rows = [["true", *_numbers(_six(experiment.rig))]]
    for parameters in (6, 4):
        good = _with_parameters(experiment, parameters)
        if good:
            found = np.array([outcome.mast[:6] for outcome in good])
            rows.append([f"{parameters}: first survey", *_numbers(found[0])])
            error = np.sqrt(np.mean((found - _six(experiment.rig)) ** 2, axis=0))
            rows.append([f"{parameters}: rms error of {len(good)}", *_numbers(error, sign=False)])
            sigma = np.sqrt(np.mean([outcome.sigma[:6] ** 2 for outcome in good], axis=0))
            rows.append([f"{parameters}: stated sigma", *_numbers(sigma, sign=False)])
    return Table(headings, rows)


def table_v(experiment: CalibrationExperiment) -> Table:
    """Return the paper's Table V: rms residuals of the mast's images, beside the paper's."""
    headings = ["", "Pancam x, y", "Navcam x, y", "paper: Pancam x, y", "paper: Navcam x, y"]
    rows = []
    for parameters in (6, 4):
        good = _with_parameters(experiment, parameters)
        if not good:
            continue
        cells = [f"{parameters} parameters"]
        for name in ("pancam", "navcam"):
            values = [outcome.mast_rms_px[name] for outcome in good if name in outcome.mast_rms_px]
            mean = np.sqrt(np.mean(np.square(values), axis=0)) if values else None
            cells.append("" if mean is None else f"{mean[0]:.3f}, {mean[1]:.3f}")
        paper = PAPER_TABLE_V[parameters]
        rows.append([*cells, *(f"{paper[p][0]:.3f}, {paper[p][1]:.3f}" for p in ("pancam", "navcam"))])
    return Table(headings, rows)


def write_study_report(experiment: CalibrationExperiment, folder: Path) -> Path:
    """Write report.html, surveys.csv and record.json into ``folder`` (made if need be); return the page.

    Raises
    ------
    OSError
        If the folder or a file in it cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows = [row for outcome in experiment.outcomes for row in _csv_rows(outcome)]
    write_csv(folder / "surveys.csv", CSV_COLUMNS, rows)
    write_json(folder / "record.json", study_as_json(experiment))
    page = folder / "report.html"
    page.write_text(_page(experiment), encoding="utf-8")
    return page


def _page(experiment: CalibrationExperiment) -> str:
    failures = [[o.variant.study, o.variant.label, o.failure] for o in experiment.outcomes if o.failure]
    return pages.page(
        Path(__file__).with_suffix(".html"),
        title="Calibration experiment",
        badge=pages.Badge("SIMULATED", "simulated"),
        facts=[
            ("rig", experiment.rig.name),
            ("surveys of each kind", str(experiment.surveys)),
            ("seed", str(experiment.seed)),
            ("took", f"{experiment.seconds:.0f} s"),
        ],
        station=f"{1000 * PAPER_STATION_M:g} mm",
        table_iv=table_iv(experiment),
        table_v=table_v(experiment),
        plots=list(_plots(experiment.summaries)) if plots.installed() else None,
        pointing=pointing_rows(experiment.summaries),
        handoff=handoff_rows(experiment.summaries),
        failures=Table(("study", "variant", "reason"), failures),
    )


def _plots(summaries: Sequence[VariantSummary]) -> Iterator[tuple[str, Figure]]:
    """Pointing and hand-off against each thing that was varied."""
    for study, label in STUDIES.items():
        mine = [s for s in summaries if s.variant.study.startswith(study)]
        if mine:
            caption = "Shaded: the 5 to 8 positions that the paper found adequate." * (study == "placements")
            yield label, plots.plot(_errors_against(label, mine), f"errors against {label}", caption)


def _errors_against(label: str, summaries: Sequence[VariantSummary]) -> Any:
    """One study's three plots."""
    figure = plots.new(11.5, 3.8)
    axes = figure.subplots(1, 3)
    names = list(dict.fromkeys(s.variant.study for s in summaries))
    for colour, name in zip(plots.COLOURS, names, strict=False):
        mine = [s for s in summaries if s.variant.study == name and s.failed < s.surveys]
        if not mine:
            continue
        x = [s.variant.value for s in mine]
        word = name.rpartition(", ")[2] if len(names) > 1 else f"method {mine[0].variant.method}"
        axes[0].plot(x, [s.pointing_px for s in mine], "o-", color=colour, label=f"{word}, clicks 0.2 px")
        axes[0].plot(x, [s.exact_px for s in mine], "o--", color=colour, label=f"{word}, exact clicks")
        for axis, key in ((axes[1], PANCAM_TO_NAVCAM), (axes[2], NAVCAM_TO_HAZCAM)):
            axis.plot(x, [s.handoff_px(key) for s in mine], "o-", color=colour, label=f"{word}, rms an axis")
            axis.plot(x, [s.handoff_most_px(key) for s in mine], "^:", color=colour, label=f"{word}, worst")
    titles = (
        "pointing at 10, 6 and 2 m, rms px an axis",
        "hand-off Pancam to Navcam, 10, 6 and 2 m, px",
        "hand-off Navcam to Hazcam, 2 m, px",
    )
    values = sorted({s.variant.value for s in summaries})
    for axis, title in zip(axes, titles, strict=True):
        axis.set(xlabel=label)
        axis.set_title(title, fontsize=10)
        axis.set_xticks(values, [f"{value:g}" for value in values])
        plots.errors_upwards(axis)
        axis.margins(y=0.25)
        if axis.get_legend_handles_labels()[0]:
            axis.legend(fontsize=7, ncols=2, loc="upper center")
        if label == STUDIES["placements"]:
            axis.axvspan(5, 8, color=plots.RUST, alpha=0.08)
    return figure


def _variant_told(summary: VariantSummary) -> dict[str, Any]:
    variant = summary.variant
    return {
        "study": variant.study,
        "label": variant.label,
        "value": variant.value,
        "method": variant.method,
        "mast_parameters": variant.mast_parameters,
        "surveys": summary.surveys,
        "failed": summary.failed,
        "pointing_rms_px": {f"{d:g}": list(xy) for d, xy in summary.pointing_rms_px.items()},
        "exact_click_rms_px": {f"{d:g}": list(xy) for d, xy in summary.exact_rms_px.items()},
        "handoff_rms_px": {_named(key): list(xy) for key, xy in summary.handoff_rms_px.items()},
        "handoff_worst_px": {_named(key): worst for key, worst in summary.handoff_worst_px.items()},
        "fit_seconds": summary.seconds,
    }


def _named(key: Handoff) -> str:
    name, distance_m = key
    return f"{name}, {distance_m:g} m"


def _table_told(table: Table) -> dict[str, Any]:
    return {"columns": table[0], "rows": table[1]}


def _csv_rows(outcome: SurveyOutcome) -> Iterator[list[Any]]:
    start = [outcome.variant.study, outcome.variant.label]
    if outcome.failure:
        yield [*start, "", "", "", "", outcome.failure]
    for name, by_distance in (("pointing", outcome.pointing_px), ("exact clicks", outcome.exact_px)):
        for distance, errors in by_distance.items():
            yield [*start, name, distance, *np.sqrt(np.nanmean(errors**2, axis=0)).tolist(), ""]
    for (name, distance), errors in outcome.handoff_px.items():
        yield [*start, name, distance, *np.sqrt(np.nanmean(errors**2, axis=0)).tolist(), ""]


def _with_parameters(experiment: CalibrationExperiment, parameters: int) -> list[SurveyOutcome]:
    return [
        outcome
        for outcome in experiment.of("mast parameters")
        if outcome.variant.mast_parameters == parameters and not outcome.failure
    ]


def _six(rig: Rig) -> np.ndarray:
    return np.array([*rig.mast.translation_m, *rig.mast.rotation_rad])


def _numbers(values: np.ndarray, sign: bool = True) -> list[str]:
    return [f"{value:+.4f}" if sign else f"{value:.4f}" for value in values]


def main(words: Sequence[str] | None = None) -> int:
    """Run the study; 1 if no survey at all could be fitted."""
    parser = options(__doc__, 10, "surveys of each kind, some 6 minutes on two processors", as_json=True)
    parser.add_argument(
        "--rig", type=Path, metavar="MAST.yaml", help="the true rig (default: the packaged simulated rover's)"
    )
    parser.add_argument(
        "--targets", type=at_least(1), default=20, metavar="N",
        help="targets of each survey at each distance (default 20)",
    )  # fmt: skip
    parser.add_argument(
        "--study", action="append", metavar="NAME",
        choices=("placements", "boards", "station", "prisms", "hazcam", "mast"),
        help="placements, boards, station, prisms, hazcam or mast; may be given several times (default: all)",
    )  # fmt: skip
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for report.html, surveys.csv and record.json"
    )
    args = parser.parse_args(words)
    rig = load_rig(args.rig or config_folder() / "sim" / "rocky8.yaml").rig
    if "navcam" not in rig.stereo:
        raise WrongUse("the rig has no stereo pair navcam, which the study clicks in")
    check_folder(args.out, "--out")
    chosen = [v for v in variants() if args.study is None or v.study.startswith(tuple(args.study))]
    begun_s = time.monotonic()
    outcomes = run_cases(
        args,
        "surveys",
        one_survey,
        survey_tasks(rig, surveys=args.cases, targets=args.targets, seed=args.seed, chosen=chosen),
        lambda task: f"{task.variant.study} {task.variant.label}, survey {task.seed[1]}",
        failure=lambda outcome: outcome.failure,
    )
    seconds = time.monotonic() - begun_s
    study = CalibrationExperiment(rig, args.seed, args.cases, tuple(outcomes), seconds)

    def tables(notes: list[str]) -> None:
        mast = table_iv(study)
        if len(mast.rows) > 1:
            print_table("Table IV, mast parameters", *mast.turned())
            print_table("Table V, rms residuals of the mast's images, px", *table_v(study))
        print_table("Errors, px: rms an axis, and worst", *short_rows(study.summaries), notes)

    tell_report(args, partial(write_study_report, study), lambda: study_as_json(study), tables)
    return 0 if any(not outcome.failure for outcome in study.outcomes) else 1


if __name__ == "__main__":
    end(main)

"""The study of calibration as tables, as JSON, as CSV and as one self-contained HTML page."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib.mast.rig import Rig
from mastctl.experiment.calibration import (
    DISTANCES_M,
    HANDOFFS,
    NAVCAM_TO_HAZCAM,
    PANCAM_TO_NAVCAM,
    PAPER_STATION_M,
    PAPER_TABLE_V,
    CalibrationExperiment,
    Handoff,
    Outcome,
    Summary,
)
from mastctl.report import html

SIX = ("txm, m", "tym, m", "tzm, m", "θxm, rad", "θym, rad", "θzm, rad")
STUDIES = {
    "placements": "placements of the board for the mast",
    "boards": "boards of each ring (two rings a camera pair)",
    "station": "sigma of the station, mm an axis",
    "prisms": "prisms on the rover",
    "mast parameters": "mast parameters (4: the mast taken as upright)",
}
COLOURS = ("#1f6f8b", "#c1440e", "#2d7d46", "#7a4b9d")

Table = tuple[list[str], list[list[str]]]


def as_json(experiment: CalibrationExperiment) -> dict[str, Any]:
    """Return the whole study as JSON; x and y side by side, pixels."""
    return {
        "seed": experiment.seed,
        "surveys": experiment.surveys,
        "seconds": experiment.seconds,
        "variants": [_variant_told(summary) for summary in experiment.summaries],
        "table_iv": _table_told(table_iv(experiment)),
        "table_v": _table_told(table_v(experiment)),
    }


def pointing_rows(summaries: Sequence[Summary]) -> Table:
    """Return headings and rows on pointing and on the fits: one row a variant."""
    headings = ["study", "", "failed", *(f"{d:g} m" for d in DISTANCES_M)]
    headings += [*(f"exact clicks, {d:g} m" for d in DISTANCES_M), "fit, s"]
    rows = []
    for summary in summaries:
        cells = [summary.variant.study, summary.variant.label, str(summary.failed)]
        for by_distance in (summary.pointing_rms_px, summary.exact_rms_px):
            cells += [_two(by_distance.get(distance)) for distance in DISTANCES_M]
        rows.append([*cells, f"{summary.seconds:.1f}"])
    return headings, rows


def handoff_rows(summaries: Sequence[Summary]) -> Table:
    """Return headings and rows on hand-off, rms and worst: one row a variant."""
    headings = ["study", "", *(f"{name}, {d:g} m" for name, d in HANDOFFS)]
    rows = []
    for summary in summaries:
        cells = [summary.variant.study, summary.variant.label]
        for key in HANDOFFS:
            worst = _one(summary.handoff_worst_px.get(key))
            cells.append(f"{_two(summary.handoff_rms_px.get(key))}; {worst}" if worst else "")
        rows.append(cells)
    return headings, rows


def short_rows(summaries: Sequence[Summary]) -> Table:
    """Return the study for a terminal: x and y of all distances together."""
    headings = ["", "", "pointing", "exact", "Pancam to Navcam", "worst", "Navcam to Hazcam", "worst"]
    rows = []
    for summary in summaries:
        cells = [summary.variant.study, summary.variant.label, _one(summary.pointing_px)]
        cells.append(_one(summary.exact_px))
        for name in (PANCAM_TO_NAVCAM, NAVCAM_TO_HAZCAM):
            cells += [_one(summary.handoff_px(name)), _one(summary.handoff_most_px(name))]
        if summary.failed:
            cells[1] += f" ({summary.failed} of {summary.surveys} failed)"
        rows.append(cells)
    return headings, rows


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
    return headings, rows


def table_v(experiment: CalibrationExperiment) -> Table:
    """Return the paper's Table V: rms residuals of the mast's images, beside the paper's."""
    headings = ["", "Pancam x, y", "Navcam x, y", "paper: Pancam x, y", "paper: Navcam x, y"]
    rows = []
    for parameters in (6, 4):
        good = _with_parameters(experiment, parameters)
        if not good:
            continue
        cells = [f"{parameters} parameters"]
        for pair in ("pancam", "navcam"):
            values = [outcome.mast_rms_px[pair] for outcome in good if pair in outcome.mast_rms_px]
            mean = np.sqrt(np.mean(np.square(values), axis=0)) if values else None
            cells.append("" if mean is None else f"{mean[0]:.3f}, {mean[1]:.3f}")
        paper = PAPER_TABLE_V[parameters]
        rows.append([*cells, *(f"{paper[p][0]:.3f}, {paper[p][1]:.3f}" for p in ("pancam", "navcam"))])
    return headings, rows


def write_report(experiment: CalibrationExperiment, folder: Path) -> Path:
    """Write report.html, surveys.csv and record.json into ``folder`` (made if need be); return the page.

    Raises
    ------
    OSError
        If the folder or a file in it cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "surveys.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("study", "variant", "quantity", "distance_m", "rms_x_px", "rms_y_px", "failure"))
        for outcome in experiment.outcomes:
            writer.writerows(_csv_rows(outcome))
    record = json.dumps(as_json(experiment), indent=1)
    (folder / "record.json").write_text(record + "\n", encoding="utf-8")
    page = folder / "report.html"
    page.write_text(html.page("Calibration experiment", _parts(experiment)), encoding="utf-8")
    return page


def _parts(experiment: CalibrationExperiment) -> Iterator[str]:
    yield f"<h1>Calibration experiment {html.badge('SIMULATED', 'simulated')}</h1>"
    facts = [
        ("rig", experiment.rig.name),
        ("surveys of each kind", str(experiment.surveys)),
        ("seed", str(experiment.seed)),
        ("took", f"{experiment.seconds:.0f} s"),
    ]
    yield "<p>" + " · ".join(f"{k} <b>{html.escape(v)}</b>" for k, v in facts) + "</p>"
    station = f"{1000 * PAPER_STATION_M:g} mm"
    yield f"<h2>Table IV: mast parameters (paper's method, station {station}, dots 0.1 px)</h2>"
    yield html.table(*table_iv(experiment))
    yield "<h2>Table V: rms residuals of the mast's images, px</h2>"
    yield html.table(*table_v(experiment))
    yield (
        "<p>The paper's figures are from hardware: one survey, one mast. With four parameters the residual "
        "depends on where the boards stood; what counts is that it is far above that of six.</p>"
    )
    try:
        yield from _plots(experiment)
    except ImportError:
        yield "<p>No pictures: matplotlib is not installed (pip install 'mastctl[report]').</p>"
    yield "<h2>Every variant: pointing, rms x, y px</h2>"
    yield html.table(*pointing_rows(experiment.summaries))
    yield (
        "<p>Clicks of 0.2 px noise in the Navcam pair, at 10, 6 and 2 m; exact clicks leave the "
        "calibration's part.</p>"
    )
    yield "<h2>Every variant: hand-off, rms x, y and worst, px</h2>"
    yield html.table(*handoff_rows(experiment.summaries))
    yield (
        "<p>Clicks of 0.2 px noise in the giving pair, against exact projection in both eyes of the taking "
        "pair; behind the semicolon the longest error. Navcam to Hazcam hangs on prisms that were measured "
        "in two set-ups, as in the paper.</p>"
    )
    failures = [(o.variant, o.failure) for o in experiment.outcomes if o.failure]
    if failures:
        yield f"<h2>Surveys that could not be fitted ({len(failures)})</h2>"
        rows = [[variant.study, variant.label, words] for variant, words in failures]
        yield html.table(["study", "variant", "reason"], rows)


def _plots(experiment: CalibrationExperiment) -> Iterator[str]:
    """Pointing and hand-off against each thing that was varied."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    summaries = experiment.summaries
    for study, label in STUDIES.items():
        names = [n for n in dict.fromkeys(s.variant.study for s in summaries) if n.startswith(study)]
        if not names:
            continue
        yield f"<h2>Against {html.escape(label)}</h2>"
        figure = Figure(figsize=(11.5, 3.8), layout="constrained")
        axes = figure.subplots(1, 3)
        for colour, name in zip(COLOURS, names, strict=False):
            mine = [s for s in summaries if s.variant.study == name and s.failed < s.surveys]
            if not mine:
                continue
            x = [s.variant.value for s in mine]
            word = name.rpartition(", ")[2] if len(names) > 1 else f"method {mine[0].variant.method}"
            axes[0].plot(x, [s.pointing_px for s in mine], "o-", color=colour, label=f"{word}, clicks 0.2 px")
            axes[0].plot(x, [s.exact_px for s in mine], "o--", color=colour, label=f"{word}, exact clicks")
            for axis, key in ((axes[1], PANCAM_TO_NAVCAM), (axes[2], NAVCAM_TO_HAZCAM)):
                rms = [s.handoff_px(key) for s in mine]
                axis.plot(x, rms, "o-", color=colour, label=f"{word}, rms an axis")
                worst = [s.handoff_most_px(key) for s in mine]
                axis.plot(x, worst, "^:", color=colour, label=f"{word}, worst")
        titles = (
            "pointing at 10, 6 and 2 m, rms px an axis",
            "hand-off Pancam to Navcam, 10, 6 and 2 m, px",
            "hand-off Navcam to Hazcam, 2 m, px",
        )
        for axis, title in zip(axes, titles, strict=True):
            axis.set(xlabel=label)
            axis.set_title(title, fontsize=10)
            values = sorted({s.variant.value for s in summaries if s.variant.study in names})
            axis.set_xticks(values, [f"{value:g}" for value in values])
            axis.set_yscale("log")
            axis.margins(y=0.25)
            axis.yaxis.set_minor_locator(LogLocator(subs=(2, 3, 5)))
            for side in (axis.yaxis.set_major_formatter, axis.yaxis.set_minor_formatter):
                side("{x:g}")
            axis.tick_params(which="both", labelsize=8)
            axis.grid(alpha=0.25, which="both")
            if axis.get_legend_handles_labels()[0]:
                axis.legend(fontsize=7, ncols=2, loc="upper center")
            if study == "placements":
                axis.axvspan(5, 8, color="#c1440e", alpha=0.08)
        yield html.plot_tag(figure, f"errors against {label}")
        if study == "placements":
            yield "<p>Shaded: the 5 to 8 positions that the paper found adequate.</p>"


def _variant_told(summary: Summary) -> dict[str, Any]:
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


def _csv_rows(outcome: Outcome) -> Iterator[list[Any]]:
    start = [outcome.variant.study, outcome.variant.label]
    if outcome.failure:
        yield [*start, "", "", "", "", outcome.failure]
    for name, by_distance in (("pointing", outcome.pointing_px), ("exact clicks", outcome.exact_px)):
        for distance, errors in by_distance.items():
            yield [*start, name, distance, *np.sqrt(np.nanmean(errors**2, axis=0)).tolist(), ""]
    for (name, distance), errors in outcome.handoff_px.items():
        yield [*start, name, distance, *np.sqrt(np.nanmean(errors**2, axis=0)).tolist(), ""]


def _with_parameters(experiment: CalibrationExperiment, parameters: int) -> list[Outcome]:
    return [
        outcome
        for outcome in experiment.of("mast parameters")
        if outcome.variant.mast_parameters == parameters and not outcome.failure
    ]


def _six(rig: Rig) -> np.ndarray:
    return np.array([*rig.mast.translation_m, *rig.mast.rotation_rad])


def _numbers(values: np.ndarray, sign: bool = True) -> list[str]:
    return [f"{value:+.4f}" if sign else f"{value:.4f}" for value in values]


def _one(value: float | None) -> str:
    return "" if value is None or not np.isfinite(value) else f"{value:.2f}"


def _two(value: tuple[float, float] | None) -> str:
    return "" if value is None else f"{value[0]:.2f}, {value[1]:.2f}"

"""What a hand-off experiment leaves: targets.csv, handoffs.jsonl, record.json and one HTML page."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mastctl.experiment.handoff_record import (
    PAPER_WORST_PX,
    Handed,
    HandoffExperiment,
    HandoffRecord,
    HandoffSummary,
)
from mastctl.experiment.report import FIRST_COLOUR, SECOND_COLOUR, bgr, jpeg_tag
from mastctl.handoff.log import HandoffLog
from mastctl.report import html

CSV_COLUMNS = (
    "handoff", "target", "kind", "range_m", "frame_id", "clicked_x_px", "clicked_y_px", "camera",
    "geometric_x_px", "geometric_y_px", "search_sigma_major_px", "search_sigma_minor_px",
    "verdict", "refined_x_px", "refined_y_px", "refined_sigma_x_px", "refined_sigma_y_px", "correlation",
    "true_x_px", "true_y_px", "reason",
)  # fmt: skip
CROP_PX, SCALE = 30, 6
VIEW_SIDE_PX = 480
TRUTH_BGR = (80, 200, 80)
LEGEND = (
    "<p>Ellipse: where the geometric hand-off says to search (3 sigma). Red cross: geometric. Blue cross: "
    "refined. Green circle: the truth, where it is known.</p>"
)


def write_report(experiment: HandoffExperiment, folder: Path) -> Path:
    """Write report.html, the tables and the record into ``folder`` (made if need be); return the page.

    ``handoffs.jsonl`` is what `mastctl calibrate --refine` reads (`mastctl.handoff.log`).

    Raises
    ------
    OSError, BadFile
        If the folder or a file in it cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "targets.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(CSV_COLUMNS)
        for record in experiment.records:
            writer.writerows(_csv_rows(record))
    log = HandoffLog(folder / "handoffs.jsonl")
    log.path.unlink(missing_ok=True)
    for record in experiment.records:
        if record.matched is not None:
            log.append(record.matched)
    document = json.dumps(experiment.as_json() | {"status": dict(experiment.status)}, indent=1)
    (folder / "record.json").write_text(document + "\n", encoding="utf-8")
    page = folder / "report.html"
    page.write_text(html.page("Hand-off experiment", _parts(experiment)), encoding="utf-8")
    return page


def bias_sentences(experiment: HandoffExperiment) -> list[str]:
    """Return the constant offsets of three sigma and more in words, and what they are good for."""
    told = [one.sentence for one in experiment.bias if one.significant]
    return [*told, "mastctl calibrate --refine corrects body cameras by handoffs.jsonl"] if told else []


def table_rows(summaries: Sequence[HandoffSummary]) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows of the table beside the paper's figures."""
    headings = [
        "hand-off", "target", "camera", "targets", "failed", "geometric rms x, y", "bias x, y", "worst",
        "refined", "rms", "worst refined", "paper worst",
    ]  # fmt: skip
    rows = []
    for row in summaries:
        paper = PAPER_WORST_PX.get(row.step)
        rows.append(
            [
                row.step,
                row.kind,
                row.camera,
                str(row.targets),
                str(row.failed),
                _two(row.geometric_rms_px),
                _two(row.geometric_bias_px),
                _one(row.geometric_worst_px),
                f"{row.accepted} of {sum(row.verdicts.values())}",
                _one(row.refined_rms_px),
                _one(row.refined_worst_px),
                "" if paper is None else f"{paper:g}",
            ]
        )
    return headings, rows


def target_rows(records: Sequence[HandoffRecord]) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows of the table of single targets, both eyes of the destination in a row."""
    headings = ["hand-off", "target", "kind", "range m"]
    headings += [f"{side} {what}" for side in ("left", "right") for what in ("geometric", "refined")]
    rows = []
    for record in records:
        row = [record.step, str(record.index), record.kind, _one(record.range_m)]
        for one in record.handed:
            refined = one.refined_error_px
            row += [_two(one.geometric_error_px), one.refined.verdict if refined is None else _two(refined)]
        rows.append(row + [""] * (len(headings) - len(row)))
    return headings, rows


def _one(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _two(value: tuple[float, float] | None) -> str:
    return "" if value is None else f"{value[0]:.2f}, {value[1]:.2f}"


def _csv_rows(record: HandoffRecord) -> list[list[str]]:
    start: list[Any] = [
        record.step,
        record.index,
        record.kind,
        record.range_m,
        record.frame_id,
        *record.clicked_px,
    ]
    if not record.handed:
        return [_cells([*start, *[""] * 13, record.error])]
    rows = []
    for one in record.handed:
        axes = np.sqrt(np.maximum(np.linalg.eigvalsh(one.geometric.search_px2)[::-1], 0.0))
        refined = one.refined
        rows.append(
            _cells(
                [
                    *start, one.camera, *one.geometric.pixel_px, *axes, refined.verdict, *refined.pixel_px,
                    *np.sqrt(np.diag(refined.covariance_px2)), refined.correlation,
                    *(one.true_px or ("", "")), refined.reason,
                ]
            )
        )  # fmt: skip
    return rows


def _cells(values: Sequence[Any]) -> list[str]:
    """Cells of a row: shortest numbers, empty for what does not exist."""
    numbers = [float(v) if isinstance(v, (float, np.floating)) else v for v in values]
    return ["" if isinstance(v, float) and np.isnan(v) else str(v) for v in numbers]


def _parts(experiment: HandoffExperiment) -> list[str]:
    kind = str(experiment.status.get("hardware", "unknown"))
    mast = experiment.status.get("mast") or {}
    facts = [
        ("hardware", kind),
        ("mast file", f"{mast.get('file', '')} ({str(mast.get('digest', ''))[:12]})"),
        ("noise of clicks", f"{experiment.click_px:g} px"),
        ("seed", str(experiment.seed)),
        ("started", experiment.started),
        ("took", f"{experiment.seconds:.0f} s"),
    ]
    reference = "the truth" if kind == "simulated" else "the refined pixel"
    parts = [
        f"<h1>Hand-off experiment {html.badge(kind.upper(), kind)}</h1>",
        "<p>" + " · ".join(f"{k} <b>{html.escape(v)}</b>" for k, v in facts) + "</p>",
        "<h2>Errors in pixels of the destination camera</h2>",
        html.table(*table_rows(experiment.summaries)),
        f"<p>Geometric: rays of the clicks, nearest point, projected, against {reference}. Refined: found by "
        "correlation in the destination's picture, rms of the length. Only accepted matches count.</p>",
    ]
    if told := bias_sentences(experiment):
        parts.append("<h2>Constant offsets</h2>")
        parts += [f"<p>{html.escape(sentence)}.</p>" for sentence in told]
    failures = [r for r in experiment.records if r.error]
    if failures:
        parts.append(f"<h2>Failed targets ({len(failures)})</h2>")
        parts.append(
            html.table(["hand-off", "target", "reason"], [[r.step, str(r.index), r.error] for r in failures])
        )
    doubts = [(r, h) for r in experiment.records for h in r.handed if h.refined.verdict != "accepted"]
    if doubts:
        parts.append(f"<h2>Not accepted by image ({len(doubts)})</h2>")
        rows = [[r.step, str(r.index), h.camera, h.refined.verdict, h.refined.reason] for r, h in doubts]
        parts.append(html.table(["hand-off", "target", "camera", "verdict", "reason"], rows))
    parts += ["<h2>Each target</h2>", _plot(experiment), html.table(*target_rows(experiment.records))]
    pictured = [r for r in experiment.records if r.source_image is not None and r.handed]
    if known := [r for r in pictured if r.kind != "ground"]:
        parts.append(f"<h2>Known points</h2>{LEGEND}")
        parts += _views(known)
    if shown := [r for r in pictured if r.kind == "ground"]:
        parts.append(f"<h2>Targets</h2>{LEGEND}")
        parts += [_pictures(record) for record in shown]
    return parts


def _plot(experiment: HandoffExperiment) -> str:
    """Each target's errors in both eyes beside the paper's worst, as its figures 6 and 8."""
    try:
        figure = error_figure(experiment.records)
    except ImportError:
        return "<p>No plot: matplotlib is not installed (pip install 'mastctl[report]').</p>"
    return (
        "<p>Nothing was handed over.</p>"
        if figure is None
        else html.plot_tag(figure, "errors of each target")
    )


def error_figure(records: Sequence[HandoffRecord]) -> Any:
    """Return a matplotlib figure of the errors' lengths by target; None if nothing was handed over."""
    from matplotlib.figure import Figure

    steps = list(dict.fromkeys(r.step for r in records if r.handed))
    if not steps:
        return None
    figure = Figure(figsize=(5.6 * len(steps), 3.6), layout="constrained")
    for axis, step in zip(figure.subplots(1, len(steps), squeeze=False)[0], steps, strict=True):
        mine = [r for r in records if r.step == step and r.handed]
        cameras = list(dict.fromkeys(one.camera for r in mine for one in r.handed))
        for camera, marker in zip(cameras, "ox", strict=False):
            for refined, colour in ((False, FIRST_COLOUR), (True, SECOND_COLOUR)):
                seen = [(r.index, one) for r in mine for one in r.handed if one.camera == camera]
                errors = [
                    (index, float(np.hypot(*error)))
                    for index, one in seen
                    if (error := one.refined_error_px if refined else one.geometric_error_px) is not None
                ]
                label = f"{camera}, {'refined' if refined else 'geometric'}"
                if errors:
                    axis.plot(*zip(*errors, strict=True), marker, color=colour, ms=5, mfc="none", label=label)
        if (paper := PAPER_WORST_PX.get(step)) is not None:
            axis.axhline(paper, color="0.4", lw=1, ls="--", label="the paper's worst, geometric")
        axis.set(title=step, xlabel="target", ylabel="error, px", ylim=(0, None))
        axis.legend(fontsize=7)
    return figure


def _pictures(record: HandoffRecord) -> str:
    """The source's view of the target, and what each destination camera saw."""
    assert record.source_image is not None
    source = _crop(record.source_image, record.clicked_px)
    middle = (CROP_PX * SCALE, CROP_PX * SCALE)
    cv2.drawMarker(source, middle, (0, 140, 255), cv2.MARKER_CROSS, 60, 2, cv2.LINE_AA)
    caption = f"{record.step}, target {record.index}: clicked in {record.frame_id}, {record.range_m:.2f} m"
    tags = [html.figure(jpeg_tag(source, "the target in the source camera"), caption)]
    for one in record.handed:
        if one.image is not None:
            tags.append(html.figure(jpeg_tag(_marked(one), one.camera), _caption(one)))
    return '<div class="row pairs">' + "".join(tags) + "</div>"


def _caption(one: Handed) -> str:
    error = one.geometric_error_px
    told = f"{one.camera}: {one.refined.verdict}"
    return told if error is None else f"{told}; geometric off by {error[0]:+.2f}, {error[1]:+.2f} px"


def _views(records: Sequence[HandoffRecord]) -> list[str]:
    """One row of pictures for each view: all its targets in each destination camera."""
    views: dict[tuple[str, str], list[HandoffRecord]] = {}
    for record in records:
        views.setdefault((record.step, record.frame_id), []).append(record)
    rows = []
    for (step, frame_id), seen in views.items():
        tags = []
        for camera in dict.fromkeys(one.camera for record in seen for one in record.handed):
            mine = [(r.index, one) for r in seen for one in r.handed if one.camera == camera]
            caption = f"{step} from {frame_id}: {camera}, targets {mine[0][0]} to {mine[-1][0]}"
            tags.append(html.figure(jpeg_tag(view_picture(mine), camera), caption))
        rows.append('<div class="row pairs">' + "".join(tags) + "</div>")
    return rows


def view_picture(targets: Sequence[tuple[int, Handed]]) -> np.ndarray:
    """Return the part of one picture that shows these targets (number, target), marked; BGR."""
    places = np.array([one.geometric.pixel_px for _, one in targets])
    image = targets[0][1].image
    assert image is not None
    half = int(np.ceil(np.ptp(places, axis=0).max() / 2)) + CROP_PX
    scale = max(1, round(VIEW_SIDE_PX / (2 * half)))
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    center = (float(middle[0]), float(middle[1]))
    piece = _crop(image, center, half, scale)
    for index, one in targets:
        place = _marks(piece, one, center, half, scale)
        cv2.putText(
            piece, str(index), (place[0] + 8, place[1] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1
        )
    return piece


def _marked(one: Handed) -> np.ndarray:
    """A destination's picture around the geometric pixel, with ellipse and crosses."""
    assert one.image is not None
    center = (float(one.geometric.pixel_px[0]), float(one.geometric.pixel_px[1]))
    piece = _crop(one.image, center)
    _marks(piece, one, center, CROP_PX, SCALE)
    return piece


def _marks(
    piece: np.ndarray, one: Handed, center_px: tuple[float, float], half: int, scale: int
) -> tuple[int, int]:
    """Draw ellipse, crosses and the truth into a piece of picture; return where the geometric pixel is."""

    def at(pixel_px: np.ndarray) -> tuple[int, int]:
        x, y = scale * (np.asarray(pixel_px) - center_px + half)
        return round(float(x)), round(float(y))

    colours = [tuple(int(c[i : i + 2], 16) for i in (5, 3, 1)) for c in (FIRST_COLOUR, SECOND_COLOUR)]
    values, vectors = np.linalg.eigh(one.geometric.search_px2)
    axes = [max(1, round(3 * scale * float(np.sqrt(max(v, 0.0))))) for v in values[::-1]]
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    place = at(one.geometric.pixel_px)
    cv2.ellipse(piece, place, (axes[0], axes[1]), angle, 0, 360, colours[0], 1, cv2.LINE_AA)
    cv2.drawMarker(piece, place, colours[0], cv2.MARKER_CROSS, 6 * scale, 1, cv2.LINE_AA)
    if one.true_px is not None:
        cv2.circle(piece, at(np.array(one.true_px)), 2 * scale, TRUTH_BGR, 1, cv2.LINE_AA)
    if one.refined.verdict == "accepted":
        cv2.drawMarker(
            piece, at(one.refined.pixel_px), colours[1], cv2.MARKER_CROSS, 6 * scale, 2, cv2.LINE_AA
        )
    return place


def _crop(
    image: np.ndarray, center_px: tuple[float, float], half: int = CROP_PX, scale: int = SCALE
) -> np.ndarray:
    """The surroundings of a pixel, enlarged; beyond the image's edge black."""
    matrix = np.array(
        [[scale, 0.0, scale * (half - center_px[0])], [0.0, scale, scale * (half - center_px[1])]]
    )
    side = 2 * half * scale + 1
    return np.asarray(cv2.warpAffine(bgr(image), matrix, (side, side), flags=cv2.INTER_LINEAR), np.uint8)

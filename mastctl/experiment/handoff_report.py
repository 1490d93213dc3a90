"""What a hand-off experiment leaves: targets.csv, handoffs.jsonl, record.json and one HTML page."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mastctl import html
from mastctl.experiment.handoff import (
    PAPER_WORST_PX,
    Handed,
    HandoffExperiment,
    HandoffRecord,
    HandoffSummary,
)
from mastctl.experiment.report import FIRST_COLOUR, SECOND_COLOUR, bgr, jpeg_tag
from mastctl.handoff_log import HandoffLog

CSV_COLUMNS = (
    "handoff", "target", "range_m", "frame_id", "clicked_x_px", "clicked_y_px", "camera",
    "geometric_x_px", "geometric_y_px", "search_sigma_major_px", "search_sigma_minor_px",
    "verdict", "refined_x_px", "refined_y_px", "refined_sigma_x_px", "refined_sigma_y_px", "correlation",
    "true_x_px", "true_y_px", "reason",
)  # fmt: skip
CROP_PX, SCALE = 30, 6


def write_report(experiment: HandoffExperiment, folder: Path) -> Path:
    """Write report.html, the tables and the record into ``folder`` (made if need be); return the page.

    ``handoffs.jsonl`` is what `mastctl calibrate --refine` reads (`mastctl.handoff_log`).

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
        "hand-off", "camera", "targets", "failed", "geometric rms x, y", "bias x, y", "worst",
        "refined", "rms", "worst refined", "paper worst",
    ]  # fmt: skip
    rows = []
    for row in summaries:
        paper = PAPER_WORST_PX.get(row.step)
        rows.append(
            [
                row.step,
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


def _one(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _two(value: tuple[float, float] | None) -> str:
    return "" if value is None else f"{value[0]:.2f}, {value[1]:.2f}"


def _csv_rows(record: HandoffRecord) -> list[list[str]]:
    start: list[Any] = [record.step, record.index, record.range_m, record.frame_id, *record.clicked_px]
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
    shown = [r for r in experiment.records if r.source_image is not None and r.handed]
    if shown:
        parts.append("<h2>Targets</h2><p>Ellipse: where the geometric hand-off says to search (3 sigma). "
                     "Red cross: geometric. Blue cross: refined.</p>")  # fmt: skip
        parts += [_pictures(record) for record in shown]
    return parts


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


def _marked(one: Handed) -> np.ndarray:
    """A destination's picture around the geometric pixel, with ellipse and crosses."""
    assert one.image is not None
    center = (float(one.geometric.pixel_px[0]), float(one.geometric.pixel_px[1]))
    piece = _crop(one.image, center)
    middle = CROP_PX * SCALE
    values, vectors = np.linalg.eigh(one.geometric.search_px2)
    axes = [max(1, round(3 * SCALE * float(np.sqrt(max(v, 0.0))))) for v in values[::-1]]
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    colours = [tuple(int(c[i : i + 2], 16) for i in (5, 3, 1)) for c in (FIRST_COLOUR, SECOND_COLOUR)]
    cv2.ellipse(piece, (middle, middle), (axes[0], axes[1]), angle, 0, 360, colours[0], 1, cv2.LINE_AA)
    cv2.drawMarker(piece, (middle, middle), colours[0], cv2.MARKER_CROSS, 40, 1, cv2.LINE_AA)
    if one.refined.verdict == "accepted":
        off = one.refined.pixel_px - one.geometric.pixel_px
        place = (round(middle + SCALE * float(off[0])), round(middle + SCALE * float(off[1])))
        cv2.drawMarker(piece, place, colours[1], cv2.MARKER_CROSS, 40, 2, cv2.LINE_AA)
    return piece


def _crop(image: np.ndarray, center_px: tuple[float, float]) -> np.ndarray:
    """The surroundings of a pixel, enlarged; beyond the image's edge black."""
    matrix = np.array(
        [[SCALE, 0.0, SCALE * (CROP_PX - center_px[0])], [0.0, SCALE, SCALE * (CROP_PX - center_px[1])]]
    )
    side = 2 * CROP_PX * SCALE + 1
    return np.asarray(cv2.warpAffine(bgr(image), matrix, (side, side), flags=cv2.INTER_LINEAR), np.uint8)

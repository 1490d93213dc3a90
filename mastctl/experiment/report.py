"""What a pointing experiment leaves: the raw record as CSV and JSON, and one self-contained HTML page."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from drivers.interfaces import Image
from mastctl.experiment.pointing import PAPER_TABLE_VI, DistanceSummary, PointingExperiment, TargetRecord
from mastctl.report import html

PICTURES_PER_DISTANCE = 4
CROP_PX = 60  # half the side of the piece of image shown around the aim
CROP_SCALE = 4
FIRST_COLOUR, SECOND_COLOUR = "#c1440e", "#1f6f8b"

CSV_COLUMNS = (
    "distance_m", "target", "camera", "frame_id", "clicked_x_px", "clicked_y_px", "range_m",
    "pan_before_rad", "tilt_before_rad",
    "first_x_px", "first_y_px", "first_sigma_x_px", "first_sigma_y_px",
    "first_true_x_px", "first_true_y_px", "first_frame_id",
    "second_x_px", "second_y_px", "second_sigma_x_px", "second_sigma_y_px",
    "second_true_x_px", "second_true_y_px", "second_frame_id",
    "seconds", "error",
)  # fmt: skip


def write_report(experiment: PointingExperiment, folder: Path) -> Path:
    """Write report.html, targets.csv and record.json into ``folder`` (made if need be); return the page.

    Raises
    ------
    OSError
        If the folder or a file in it cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "targets.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(CSV_COLUMNS)
        writer.writerows(_csv_row(record) for record in experiment.records)
    record = experiment.as_json() | {
        "status": dict(experiment.status),
        "targets": [
            {"distance_m": r.distance_m, "target": r.index, "error": r.error, "operation": dict(r.operation)}
            for r in experiment.records
        ],
    }
    (folder / "record.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    page = folder / "report.html"
    page.write_text(_page(experiment), encoding="utf-8")
    return page


def table_rows(summaries: Sequence[DistanceSummary]) -> tuple[list[str], list[list[str]]]:
    """Return the headings and rows of the table beside the paper's Table VI; true residuals where known."""
    with_truth = any(row.true_first_rms_px is not None for row in summaries)
    headings = ["distance", "targets", "failed", "first x, y", "second x, y"]
    if with_truth:
        headings += ["true first x, y", "true second x, y"]
    headings += ["paper first x, y", "paper second x, y", "s per target"]
    rows = []
    for row in summaries:
        cells = [f"{row.distance_m:g} m", str(row.targets), str(row.failed)]
        cells += [_pair(row.first_rms_px), _pair(row.second_rms_px)]
        if with_truth:
            cells += [_pair(row.true_first_rms_px), _pair(row.true_second_rms_px)]
        paper = PAPER_TABLE_VI.get(row.distance_m)
        cells += [_pair(paper[0]), _pair(paper[1])] if paper else ["", ""]
        cells.append(f"{row.seconds / row.targets:.1f}" if row.targets else "")
        rows.append(cells)
    return headings, rows


def _pair(value: tuple[float, float] | None) -> str:
    """Two rms values for people."""
    return "" if value is None else f"{value[0]:.3f}, {value[1]:.3f}"


def _csv_row(record: TargetRecord) -> list[str]:
    """One target as a row of targets.csv; empty cells for what does not exist."""
    cells: list[Any] = [
        record.distance_m, record.index, record.camera, record.frame_id, *record.clicked_px, record.range_m,
        record.pan_before_rad, record.tilt_before_rad,
    ]  # fmt: skip
    for which in range(2):
        if which < len(record.landings):
            landing = record.landings[which]
            true = landing.true_px or ("", "")
            cells += [*landing.residual_px, *landing.sigma_px, *true, landing.frame_id]
        else:
            cells += [""] * 7
    cells += [round(record.seconds, 3), record.error]
    return ["" if isinstance(cell, float) and math.isnan(cell) else str(cell) for cell in cells]


def _page(experiment: PointingExperiment) -> str:
    """The whole page."""
    status = experiment.status
    kind = str(status.get("hardware", "unknown"))
    mast = status.get("mast") or {}
    facts = [
        ("hardware", kind),
        ("camera", experiment.camera),
        ("mast file", f"{mast.get('file', '')} ({str(mast.get('digest', ''))[:12]})"),
        ("seed", str(experiment.seed)),
        ("started", experiment.started),
        ("took", f"{experiment.seconds:.0f} s"),
    ]
    headings, rows = table_rows(experiment.summaries)
    badge = html.badge(kind.upper(), kind)
    parts = [
        f"<h1>Pointing experiment {badge}</h1>",
        "<p>" + " · ".join(f"{k} <b>{html.escape(v)}</b>" for k, v in facts) + "</p>",
        "<h2>Rms residual in pixels, beside the paper's Table VI</h2>",
        html.table(headings, rows),
        "<p>First and second: residuals that the daemon measured in new images, about the aim pixel "
        f"({experiment.aim_px[0]:g}, {experiment.aim_px[1]:g}), the middle of the image. True: where the "
        "clicked point really was, which only a simulation knows. The paper's figures are from hardware.</p>",
    ]
    parts += [f"<p>{html.escape(note)}</p>" for note in experiment.notes]
    failures = [record for record in experiment.records if record.error]
    if failures:
        parts.append(f"<h2>Failed targets ({len(failures)})</h2>")
        parts.append(
            html.table(
                ["distance", "target", "reason"],
                [[f"{r.distance_m:g} m", str(r.index), r.error] for r in failures],
            )
        )
    parts.append("<h2>Where the targets landed</h2>")
    parts.append(_scatter(experiment))
    for summary in experiment.summaries:
        shown = [
            record
            for record in experiment.records
            if record.distance_m == summary.distance_m
            and record.clicked_image is not None
            and record.landed_images
        ]
        if shown:
            parts.append(f"<h2>Targets at {summary.distance_m:g} m</h2>")
            parts.append(
                '<div class="pictures">' + "".join(_pictures(experiment, r) for r in shown) + "</div>"
            )
    parts.append("<h2>Every target</h2>")
    parts.append(
        html.table(
            [
                "distance",
                "target",
                "range m",
                "clicked x, y",
                "first x, y ± sigma",
                "second x, y ± sigma",
                "s",
                "",
            ],
            [_target_row(record) for record in experiment.records],
        )
    )
    return html.page("Pointing experiment", parts)


def _target_row(record: TargetRecord) -> list[str]:
    """One target for people."""
    landings = [
        f"{x.residual_px[0]:+.2f}, {x.residual_px[1]:+.2f} ± {max(x.sigma_px):.2f}" for x in record.landings
    ] + ["", ""]
    known = record.frame_id != ""
    return [
        f"{record.distance_m:g} m",
        str(record.index),
        f"{record.range_m:.2f}" if known else "",
        f"{record.clicked_px[0]:.0f}, {record.clicked_px[1]:.0f}" if known else "",
        *landings[:2],
        f"{record.seconds:.1f}",
        record.error,
    ]


def _scatter(experiment: PointingExperiment) -> str:
    """Residuals over x and y, one plot a distance, on one scale; a sentence where matplotlib is missing."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return "<p>No plot: matplotlib is not installed (pip install 'mastctl[report]').</p>"
    landings = [landing for record in experiment.records for landing in record.landings]
    if not landings:
        return "<p>Nothing landed.</p>"
    reach = max(1.0, 1.1 * max(max(abs(v) for v in landing.residual_px) for landing in landings))
    count = len(experiment.summaries)
    figure = Figure(figsize=(4.2 * count, 4.4), layout="constrained")
    for axis, summary in zip(figure.subplots(1, count, squeeze=False)[0], experiment.summaries, strict=True):
        rows = [record for record in experiment.records if record.distance_m == summary.distance_m]
        for which, (label, colour, marker) in enumerate(
            (("first pointing", FIRST_COLOUR, "o"), ("second pointing", SECOND_COLOUR, "^"))
        ):
            points = np.array([r.landings[which].residual_px for r in rows if which < len(r.landings)])
            if len(points):
                axis.scatter(
                    points[:, 0], points[:, 1], s=22, c=colour, marker=marker, alpha=0.75, label=label
                )
        axis.axhline(0, color="0.6", lw=0.8)
        axis.axvline(0, color="0.6", lw=0.8)
        axis.set(
            xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal", title=f"{summary.distance_m:g} m"
        )
        axis.set_xlabel("x residual, px (right)")
        axis.set_ylabel("y residual, px (down)")
        axis.grid(alpha=0.25)
    handles, labels = next(
        axis.get_legend_handles_labels() for axis in figure.axes if axis.get_legend_handles_labels()[0]
    )
    figure.axes[0].legend(handles, labels, loc="upper left", fontsize=8)
    return html.plot_tag(figure, "scatter of the residuals")


def _pictures(experiment: PointingExperiment, record: TargetRecord) -> str:
    """The view with the click, and what the cross-hair then saw after each pointing."""
    assert record.clicked_image is not None
    view = bgr(record.clicked_image)
    clicked = tuple(round(v) for v in record.clicked_px)
    cv2.circle(view, clicked, 22, (0, 140, 255), 3, cv2.LINE_AA)
    cv2.circle(view, clicked, 3, (0, 140, 255), -1, cv2.LINE_AA)
    small = np.asarray(cv2.resize(view, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    tags = [
        html.figure(
            jpeg_tag(small, "the target chosen"), f"target {record.index}: clicked in {record.frame_id}"
        )
    ]
    chosen = _crop(bgr(record.clicked_image), record.clicked_px)
    tags.append(html.figure(jpeg_tag(chosen, "the target, enlarged"), "the target, enlarged"))
    for name, landing, image in zip(("first", "second"), record.landings, record.landed_images, strict=False):
        piece = _crop(bgr(image), experiment.aim_px)
        middle = CROP_PX * CROP_SCALE
        cv2.drawMarker(piece, (middle, middle), (255, 255, 255), cv2.MARKER_CROSS, 90, 1, cv2.LINE_AA)
        found = tuple(round(middle + v * CROP_SCALE) for v in landing.residual_px)
        cv2.circle(piece, found, 12, (0, 140, 255), 2, cv2.LINE_AA)
        x, y = landing.residual_px
        tags.append(
            html.figure(
                jpeg_tag(piece, f"{name} pointing"), f"{name}: {x:+.2f}, {y:+.2f} px from the cross-hair"
            )
        )
    return '<div class="row">' + "".join(tags) + "</div>"


def _crop(image: Image, center_px: tuple[float, float]) -> Image:
    """The surroundings of a pixel, enlarged; beyond the image's edge black."""
    matrix = np.array(
        [
            [CROP_SCALE, 0.0, CROP_SCALE * (CROP_PX - center_px[0])],
            [0.0, CROP_SCALE, CROP_SCALE * (CROP_PX - center_px[1])],
        ]
    )
    side = 2 * CROP_PX * CROP_SCALE + 1
    return np.asarray(cv2.warpAffine(image, matrix, (side, side), flags=cv2.INTER_LINEAR), dtype=np.uint8)


def bgr(image: Image) -> Image:
    """A copy in colour to draw on."""
    return np.asarray(
        cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy(), dtype=np.uint8
    )


def jpeg_tag(image: Image, alt: str) -> str:
    """An inlined JPEG."""
    return html.image_tag(
        cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes(), "jpeg", alt
    )

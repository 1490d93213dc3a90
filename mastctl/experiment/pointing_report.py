"""What a pointing experiment leaves: the raw record as CSV and JSON, and one self-contained HTML page."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mastctl.experiment.pointing import PAPER_TABLE_VI, DistanceSummary, PointingExperiment, TargetRecord
from mastctl.report import pages, pictures
from mastctl.report.pages import Table, number, x_y
from mastctl.report.pictures import Figure

PICTURES_PER_DISTANCE = 4
LEAST_REACH_PX = 0.1  # of the scatter's axes
CROP_PX, CROP_SCALE = 60, 4  # half the side of the piece of image shown around the aim, and how much larger

COLUMNS = (
    "distance_m", "target", "camera", "frame_id", "clicked_x_px", "clicked_y_px", "range_m",
    "pan_before_rad", "tilt_before_rad",
    *(
        f"{which}_{part}"
        for which in ("first", "second")
        for part in ("x_px", "y_px", "sigma_x_px", "sigma_y_px", "true_x_px", "true_y_px", "frame_id")
    ),
    "seconds", "error",
)  # fmt: skip


def write_pointing_report(experiment: PointingExperiment, folder: Path) -> Path:
    """Write report.html, targets.csv and record.json into ``folder`` (made if need be); return the page.

    Raises OSError if the folder or a file in it cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "targets.csv").open("w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(map(_csv_row, experiment.records))
    targets = [
        {"distance_m": r.distance_m, "target": r.index, "error": r.error, "operation": r.operation}
        for r in experiment.records
    ]
    record = experiment.as_json() | {"status": experiment.status, "targets": targets}
    (folder / "record.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    page = folder / "report.html"
    page.write_text(_page(experiment), encoding="utf-8", errors="backslashreplace")
    return page


def pointing_table(summaries: Sequence[DistanceSummary]) -> Table:
    """Return the table beside the paper's Table VI; true residuals where they are known."""
    with_truth = any(row.true_first_rms_px is not None for row in summaries)
    measured = "simulated " if with_truth else ""
    headings = ["distance", "targets", "failed", f"{measured}first x, y", f"{measured}second x, y"]
    if with_truth:
        headings += ["simulated truth first x, y", "simulated truth second x, y"]
    headings += ["paper's rover first x, y", "paper's rover second x, y", "s per target"]
    rows = []
    for row in summaries:
        values = [row.first_rms_px, row.second_rms_px]
        if with_truth:
            values += [row.true_first_rms_px, row.true_second_rms_px]
        values += PAPER_TABLE_VI.get(row.distance_m, (None, None))
        cells = [f"{row.distance_m:g} m", str(row.targets), str(row.failed)]
        cells += [x_y(value, 3) for value in values]
        rows.append([*cells, number(row.seconds / row.targets if row.targets else None, 1)])
    return Table(headings, rows)


def _csv_row(record: TargetRecord) -> Mapping[str, Any]:
    """One target as a row of targets.csv, without what does not exist."""
    row: dict[str, Any] = {
        "distance_m": record.distance_m, "target": record.index, "camera": record.camera,
        "frame_id": record.frame_id, "clicked_x_px": record.clicked_px[0],
        "clicked_y_px": record.clicked_px[1], "range_m": record.range_m,
        "pan_before_rad": record.pan_before_rad, "tilt_before_rad": record.tilt_before_rad,
        "seconds": round(record.seconds, 3), "error": record.error,
    }  # fmt: skip
    for which, landing in zip(("first", "second"), record.landings, strict=False):
        row[f"{which}_frame_id"] = landing.frame_id
        pairs = ("", landing.residual_px), ("sigma_", landing.sigma_px), ("true_", landing.true_px)
        for kind, pair in pairs:
            row |= {f"{which}_{kind}{axis}_px": one for axis, one in zip("xy", pair or (), strict=False)}
    return {key: one for key, one in row.items() if not (isinstance(one, float) and math.isnan(one))}


def _page(experiment: PointingExperiment) -> str:
    status = experiment.status
    kind = str(status.get("hardware", "unknown"))
    mast = status.get("mast") or {}
    landed = any(record.landings for record in experiment.records)
    return pages.page(
        "pointing.html",
        title="Pointing experiment",
        badge=pages.Badge(kind.upper(), kind),
        facts=[
            ("hardware", kind),
            ("mast file", f"{mast.get('file', '')} ({str(mast.get('digest', ''))[:12]})"),
            ("camera", experiment.camera),
            ("seed", str(experiment.seed)),
            ("started", experiment.started),
            ("took", f"{experiment.seconds:.0f} s"),
        ],
        residuals=pointing_table(experiment.summaries),
        aim=f"{experiment.aim_px[0]:g}, {experiment.aim_px[1]:g}",
        notes=experiment.notes,
        landed=landed,
        scatter=_scatter(experiment) if landed and pictures.can_plot() else None,
        views=_views(experiment),
        targets=_targets(experiment.records),
    )


def _targets(records: Sequence[TargetRecord]) -> Table:
    """Every target for people."""
    headings = (
        "distance", "target", "range m", "clicked x, y", "first x, y ± sigma", "second x, y ± sigma", "s",
        "failed",
    )  # fmt: skip
    rows = []
    for record in records:
        landings = [
            f"{one.residual_px[0]:+.2f}, {one.residual_px[1]:+.2f} ± {max(one.sigma_px):.2f}"
            for one in record.landings
        ]
        clicked = "" if math.isnan(record.clicked_px[0]) else x_y(record.clicked_px, 0)
        start = [f"{record.distance_m:g} m", str(record.index), number(record.range_m), clicked]
        rows.append([*start, *[*landings, "", ""][:2], f"{record.seconds:.1f}", record.error])
    return Table(headings, rows)


def _scatter(experiment: PointingExperiment) -> Figure:
    """Residuals over x and y, one plot a distance, on one scale."""
    landings = [landing for record in experiment.records for landing in record.landings]
    reach = max(LEAST_REACH_PX, 1.1 * max(max(abs(v) for v in landing.residual_px) for landing in landings))
    count = len(experiment.summaries)
    figure = pictures.new_plot(4.2 * count, 4.4)
    for axis, summary in zip(figure.subplots(1, count, squeeze=False)[0], experiment.summaries, strict=True):
        rows = [record for record in experiment.records if record.distance_m == summary.distance_m]
        for which, (label, colour, marker) in enumerate(
            (("first pointing", pictures.RUST, "o"), ("second pointing", pictures.BLUE, "^"))
        ):
            points = np.array([r.landings[which].residual_px for r in rows if which < len(r.landings)])
            if len(points):
                axis.scatter(*points.T, s=22, c=colour, marker=marker, alpha=0.75, label=label)
        axis.axhline(0, color="0.6", lw=0.8)
        axis.axvline(0, color="0.6", lw=0.8)
        axis.set(
            xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal", title=f"{summary.distance_m:g} m",
            xlabel="x residual, px (right)", ylabel="y residual, px (down)",
        )  # fmt: skip
        axis.grid(alpha=0.25)
    handles, labels = next(
        axis.get_legend_handles_labels() for axis in figure.axes if axis.get_legend_handles_labels()[0]
    )
    figure.axes[0].legend(handles, labels, loc="upper left", fontsize=8)
    return pictures.plot(figure, "scatter of the residuals")


def _views(experiment: PointingExperiment) -> list[tuple[str, list[list[Figure]]]]:
    """By distance the pictures of those targets that kept theirs."""
    found: dict[str, list[list[Figure]]] = {}
    for record in experiment.records:
        if record.clicked_image is not None and record.landed_images:
            title = f"Targets at {record.distance_m:g} m"
            found.setdefault(title, []).append(_pictures(experiment, record))
    return list(found.items())


def _pictures(experiment: PointingExperiment, record: TargetRecord) -> list[Figure]:
    """The view with the click, and what the cross-hair then saw after each pointing."""
    assert record.clicked_image is not None
    view = pictures.in_colour(record.clicked_image)
    clicked = tuple(round(v) for v in record.clicked_px)
    cv2.circle(view, clicked, 22, pictures.ORANGE_BGR, 3, cv2.LINE_AA)
    cv2.circle(view, clicked, 3, pictures.ORANGE_BGR, -1, cv2.LINE_AA)
    small = cv2.resize(view, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    caption = f"target {record.index}: {record.range_m:.1f} m away, clicked in {record.camera}"
    chosen = pictures.enlarged(record.clicked_image, record.clicked_px, CROP_PX, CROP_SCALE)
    shown = [
        pictures.photo(small, "the target chosen", caption),
        pictures.photo(chosen, "the target, enlarged", "the target, enlarged"),
    ]
    middle = CROP_PX * CROP_SCALE
    for name, landing, image in zip(("first", "second"), record.landings, record.landed_images, strict=False):
        piece = pictures.enlarged(image, experiment.aim_px, CROP_PX, CROP_SCALE)
        cv2.drawMarker(piece, (middle, middle), (255, 255, 255), cv2.MARKER_CROSS, 90, 1, cv2.LINE_AA)
        found = tuple(round(middle + v * CROP_SCALE) for v in landing.residual_px)
        cv2.circle(piece, found, 12, pictures.ORANGE_BGR, 2, cv2.LINE_AA)
        x, y = landing.residual_px
        caption = f"{name}: {x:+.2f}, {y:+.2f} px from the cross-hair"
        shown.append(pictures.photo(piece, f"{name} pointing", caption))
    return shown

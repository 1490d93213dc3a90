"""What a hand-off experiment leaves: targets.csv, handoffs.jsonl, record.json and one HTML page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mastctl.report import pages, pictures, plots
from mastctl.report.pages import write_csv, write_json
from mastctl.report.pictures import Figure
from mastctl.report.tables import Table, number, x_y
from mastctl.watch.handoffs import HandoffLog
from tools.studies.handoff_record import (
    PAPER_WORST_PX,
    Handed,
    HandoffExperiment,
    HandoffRecord,
    HandoffSummary,
)

CSV_COLUMNS = (
    "handoff", "target", "kind", "range_m", "frame_id", "clicked_x_px", "clicked_y_px", "camera",
    "geometric_x_px", "geometric_y_px", "search_sigma_major_px", "search_sigma_minor_px",
    "verdict", "refined_x_px", "refined_y_px", "refined_sigma_x_px", "refined_sigma_y_px", "correlation",
    "true_x_px", "true_y_px", "reason",
)  # fmt: skip
CROP_PX, SCALE = 30, 6
VIEW_SIDE_PX = 480
TRUTH_BGR = (80, 200, 80)


def write_handoff_report(experiment: HandoffExperiment, folder: Path) -> Path:
    """Write report.html, the tables and the record into ``folder`` (made if need be); return the page.

    ``handoffs.jsonl`` is what `mastctl calibrate --refine` reads (`mastctl.watch.handoffs`).

    Raises
    ------
    OSError, BadFile
        If the folder or a file in it cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows = [row for record in experiment.records for row in _csv_rows(record)]
    write_csv(folder / "targets.csv", CSV_COLUMNS, rows)
    log = HandoffLog(folder / "handoffs.jsonl")
    log.path.unlink(missing_ok=True)
    for record in experiment.records:
        if record.matched is not None:
            log.append(record.matched)
    write_json(folder / "record.json", experiment.as_json() | {"status": dict(experiment.status)})
    page = folder / "report.html"
    page.write_text(_page(experiment), encoding="utf-8")
    return page


def bias_sentences(experiment: HandoffExperiment) -> list[str]:
    """Return the constant offsets of three sigma and more in words, and what they are good for."""
    told = [one.sentence for one in experiment.bias if one.significant]
    return [*told, "mastctl calibrate --refine corrects body cameras by handoffs.jsonl"] if told else []


def handoff_table(summaries: Sequence[HandoffSummary]) -> Table:
    """Return the table beside the paper's figures."""
    headings = (
        "hand-off", "target", "camera", "targets", "failed", "geometric rms x, y", "bias x, y", "worst",
        "refined", "rms", "worst refined", "paper worst",
    )  # fmt: skip
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
                x_y(row.geometric_rms_px),
                x_y(row.geometric_bias_px),
                number(row.geometric_worst_px),
                f"{row.accepted} of {sum(row.verdicts.values())}",
                number(row.refined_rms_px),
                number(row.refined_worst_px),
                "" if paper is None else f"{paper:g}",
            ]
        )
    return Table(headings, rows)


def handoff_targets(records: Sequence[HandoffRecord]) -> Table:
    """Return the table of single targets, both eyes of the destination in a row."""
    headings = ["hand-off", "target", "kind", "range m"]
    headings += [f"{side} {what}" for side in ("left", "right") for what in ("geometric", "refined")]
    rows = []
    for record in records:
        row = [record.step, str(record.index), record.kind, number(record.range_m)]
        for one in record.handed:
            refined = one.refined_error_px
            row += [x_y(one.geometric_error_px), x_y(refined) or one.refined.verdict]
        rows.append(row + [""] * (len(headings) - len(row)))
    return Table(headings, rows)


def _csv_rows(record: HandoffRecord) -> list[list[Any]]:
    start = [record.step, record.index, record.kind, record.range_m, record.frame_id, *record.clicked_px]
    if not record.handed:
        return [[*start, *[""] * 13, record.error]]
    rows = []
    for one in record.handed:
        axes = np.sqrt(np.maximum(np.linalg.eigvalsh(one.geometric.search_px2)[::-1], 0.0))
        refined = one.refined
        rows.append(
            [
                *start, one.camera, *one.geometric.pixel_px, *axes, refined.verdict, *refined.pixel_px,
                *np.sqrt(np.diag(refined.covariance_px2)), refined.correlation,
                *(one.true_px or ("", "")), refined.reason,
            ]
        )  # fmt: skip
    return rows


def _page(experiment: HandoffExperiment) -> str:
    records = experiment.records
    badge, facts = pages.of_daemon(experiment.status)
    facts += [
        ("noise of clicks", f"{experiment.click_px:g} px"),
        ("seed", str(experiment.seed)),
        ("started", experiment.started),
        ("took", f"{experiment.seconds:.0f} s"),
    ]
    failures = [[r.step, str(r.index), r.error] for r in records if r.error]
    doubts = [
        [r.step, str(r.index), one.camera, one.refined.verdict, one.refined.reason]
        for r in records
        for one in r.handed
        if one.refined.verdict != "accepted"
    ]
    pictured = [r for r in records if r.source_image is not None and r.handed]
    handed = any(record.handed for record in records)
    return pages.page(
        Path(__file__).with_name("handoff.html"),
        title="Hand-off experiment",
        badge=badge,
        facts=facts,
        errors=handoff_table(experiment.summaries),
        reference="the truth" if badge.kind == "simulated" else "the refined pixel",
        bias=bias_sentences(experiment),
        failures=Table(("hand-off", "target", "reason"), failures),
        doubts=Table(("hand-off", "target", "camera", "verdict", "reason"), doubts),
        handed=handed,
        plot=_plot(records) if handed and plots.installed() else None,
        targets=handoff_targets(records),
        known_points=_views([r for r in pictured if r.kind != "ground"]),
        pictured=[_pictures(r) for r in pictured if r.kind == "ground"],
    )


def _plot(records: Sequence[HandoffRecord]) -> Figure:
    """Each target's errors in both eyes beside the paper's worst, as its figures 6 and 8."""
    steps = list(dict.fromkeys(r.step for r in records if r.handed))
    figure = plots.new(5.6 * len(steps), 3.6)
    for axis, step in zip(figure.subplots(1, len(steps), squeeze=False)[0], steps, strict=True):
        mine = [r for r in records if r.step == step and r.handed]
        cameras = list(dict.fromkeys(one.camera for r in mine for one in r.handed))
        for camera, marker in zip(cameras, "ox", strict=False):
            for refined, colour in ((False, plots.RUST), (True, plots.BLUE)):
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
    return plots.plot(figure, "errors of each target")


def _pictures(record: HandoffRecord) -> list[Figure]:
    """The source's view of the target, and what each destination camera saw."""
    assert record.source_image is not None
    source = pictures.enlarged(record.source_image, record.clicked_px, CROP_PX, SCALE)
    middle = (CROP_PX * SCALE, CROP_PX * SCALE)
    cv2.drawMarker(source, middle, pictures.ORANGE_BGR, cv2.MARKER_CROSS, 60, 2, cv2.LINE_AA)
    caption = f"{record.step}, target {record.index}: clicked in {record.frame_id}, {record.range_m:.2f} m"
    shown = [pictures.photo(source, "the target in the source camera", caption)]
    shown += [
        pictures.photo(_marked(one), one.camera, _caption(one))
        for one in record.handed
        if one.image is not None
    ]
    return shown


def _caption(one: Handed) -> str:
    error = one.geometric_error_px
    told = f"{one.camera}: {one.refined.verdict}"
    return told if error is None else f"{told}; geometric off by {error[0]:+.2f}, {error[1]:+.2f} px"


def _views(records: Sequence[HandoffRecord]) -> list[list[Figure]]:
    """One row of pictures for each view: all its targets in each destination camera."""
    views: dict[tuple[str, str], list[HandoffRecord]] = {}
    for record in records:
        views.setdefault((record.step, record.frame_id), []).append(record)
    rows = []
    for (step, frame_id), seen in views.items():
        shown = []
        for camera in dict.fromkeys(one.camera for record in seen for one in record.handed):
            mine = [(r.index, one) for r in seen for one in r.handed if one.camera == camera]
            caption = f"{step} from {frame_id}: {camera}, targets {mine[0][0]} to {mine[-1][0]}"
            shown.append(pictures.photo(view_picture(mine), camera, caption))
        rows.append(shown)
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
    piece = pictures.enlarged(image, center, half, scale)
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
    piece = pictures.enlarged(one.image, center, CROP_PX, SCALE)
    _marks(piece, one, center, CROP_PX, SCALE)
    return piece


def _marks(
    piece: np.ndarray, one: Handed, center_px: tuple[float, float], half: int, scale: int
) -> tuple[int, int]:
    """Draw ellipse, crosses and the truth into a piece of picture; return where the geometric pixel is."""

    def at(pixel_px: np.ndarray) -> tuple[int, int]:
        x, y = scale * (np.asarray(pixel_px) - center_px + half)
        return round(float(x)), round(float(y))

    rust, blue = plots.bgr(plots.RUST), plots.bgr(plots.BLUE)
    values, vectors = np.linalg.eigh(one.geometric.search_px2)
    axes = [max(1, round(3 * scale * float(np.sqrt(max(v, 0.0))))) for v in values[::-1]]
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    place = at(one.geometric.pixel_px)
    cv2.ellipse(piece, place, (axes[0], axes[1]), angle, 0, 360, rust, 1, cv2.LINE_AA)
    cv2.drawMarker(piece, place, rust, cv2.MARKER_CROSS, 6 * scale, 1, cv2.LINE_AA)
    if one.true_px is not None:
        cv2.circle(piece, at(np.array(one.true_px)), 2 * scale, TRUTH_BGR, 1, cv2.LINE_AA)
    if one.refined.verdict == "accepted":
        cv2.drawMarker(piece, at(one.refined.pixel_px), blue, cv2.MARKER_CROSS, 6 * scale, 2, cv2.LINE_AA)
    return place

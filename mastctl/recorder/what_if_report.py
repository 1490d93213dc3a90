"""A what-if as tables for a terminal, as JSON, and as a page with the residual vectors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.files.mast_file import StoredRig
from calib.geometry.rigid import FloatArray
from mastctl.as_json import as_json
from mastctl.recorder.recorded import Recording
from mastctl.recorder.what_if import HandedAgain, WouldBe, rms
from mastctl.report import pages, plots
from mastctl.report.pictures import Figure
from mastctl.report.tables import Table, x_y


@dataclass(frozen=True, eq=False)
class WhatIf:
    """A recording, the other mast file, and what came out."""

    recording: Recording
    mast: StoredRig
    pointings: Sequence[WouldBe]
    handoffs: Sequence[HandedAgain]
    others: Mapping[str, str]

    @property
    def answered(self) -> list[WouldBe]:
        """The pointings that the other mast file has an answer for."""
        return [one for one in self.pointings if one.residual_px is not None]

    def as_json(self) -> dict[str, Any]:
        """Return everything for programs."""
        name, stored = self.recording.first_mast
        return {
            "recording": str(self.recording.path),
            "recorded_mast": {"name": name.name, "digest": stored.digest},
            "mast": {"name": self.mast.path.name, "digest": self.mast.digest},
            "rms_px": {
                key: {"recorded": rms(was), "would_be": rms(would)} for key, was, would in self.columns()
            },
            "pointings": [_pointing_record(one) for one in self.pointings],
            "handoffs": as_json(self.handoffs),
            "not_worked_out": dict(self.others),
        }

    def columns(self) -> list[tuple[str, list[FloatArray], list[FloatArray]]]:
        """Return, for first and later pointings and for each camera handed to: its name, residuals as they
        were recorded, and as they would have been.
        """
        found: dict[str, tuple[list[FloatArray], list[FloatArray]]] = {}
        for one in self.answered:
            key = "first pointing" if one.seen.pointing == 1 else "second pointing"
            was, would = found.setdefault(key, ([], []))
            was.append(one.seen.residual_px)
            would.append(np.asarray(one.residual_px))
        for handed in self.handoffs:
            if handed.would_be_px is not None:
                was, would = found.setdefault(f"hand-off to {handed.camera}", ([], []))
                was.append(handed.recorded_px)
                would.append(handed.would_be_px)
        return [(key, *both) for key, both in sorted(found.items())]


def summary_table(what_if: WhatIf) -> Table:
    """Return the rms before and after, a row a kind."""
    headings = ("what", "number", "recorded rms x, y (px)", "would be rms x, y (px)")
    rows = [
        [key, str(len(was)), x_y(rms(was), 3), x_y(rms(would), 3)] for key, was, would in what_if.columns()
    ]
    return Table(headings, rows)


def pointing_table(what_if: WhatIf) -> Table:
    """Return each pointing."""
    rows = []
    for one in what_if.pointings:
        would_be = x_y(one.residual_px, 3) or one.error
        start = one.seen.operation, str(one.seen.pointing), x_y(one.seen.residual_px, 3)
        rows.append([*start, would_be, x_y(one.sigma_px, 3)])
    return Table(("operation", "pointing", "recorded (px)", "would be (px)", "sigma (px)"), rows)


def handoff_table(what_if: WhatIf) -> Table:
    """Return each hand-off."""
    headings = ("hand-off", "to", "recorded x, y (px)", "would be x, y (px)", "sigma x, y (px)")
    rows = [
        [one.time, one.camera, x_y(one.recorded_px), x_y(one.would_be_px) or one.error, x_y(one.sigma_px)]
        for one in what_if.handoffs
    ]
    return Table(headings, rows)


def other_lines(what_if: WhatIf) -> list[str]:
    """Return why some operations were not worked out."""
    return [f"operation {name} is not worked out: {why}" for name, why in what_if.others.items()]


def write_what_if(what_if: WhatIf, folder: Path) -> Path:
    """Write the page ``what_if.html`` into a folder, which is made if need be; return it. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    name, stored = what_if.recording.first_mast
    summary = what_if.recording.summary()
    hardware = what_if.recording.facts.get("hardware", "unknown")
    facts = [
        (
            "recording",
            f"{what_if.recording.path.name}, {summary['seconds']:.0f} s, {summary['frames']} images",
        ),
        ("recorded with", f"{name.name} ({stored.digest[:12]})"),
        ("what if", f"{what_if.mast.path.name} ({what_if.mast.digest[:12]})"),
    ]
    html = pages.page(
        "what_if.html",
        title=f"What if: {what_if.mast.path.name}",
        badge=pages.Badge(hardware.upper(), hardware),
        facts=facts,
        summary=summary_table(what_if),
        pointings=pointing_table(what_if),
        handoffs=handoff_table(what_if),
        plot=_plot(what_if) if what_if.columns() and plots.installed() else None,
        answered=bool(what_if.columns()),
        others=other_lines(what_if),
    )
    page = folder / "what_if.html"
    page.write_text(html, encoding="utf-8", errors="backslashreplace")
    return page


def _plot(what_if: WhatIf) -> Figure:
    """Residuals as recorded and as they would have been, an arrow from the one to the other."""
    columns = what_if.columns()
    figure = plots.new(min(4.2 * len(columns), 13.0), 4.0)
    axes = figure.subplots(1, len(columns), squeeze=False)[0]
    for axis, (key, was, would) in zip(axes, columns, strict=True):
        before, after = np.array(was), np.array(would)
        for one, other in zip(before, after, strict=True):
            axis.annotate("", other, one, arrowprops={"arrowstyle": "-", "color": "0.7", "lw": 0.8})
        axis.plot(*before.T, "x", color=plots.RUST, ms=6, label="recorded")
        axis.plot(*after.T, "o", color=plots.BLUE, ms=5, mfc="none", label="would be")
        most = 1.15 * max(0.1, float(np.abs(np.concatenate([before, after])).max()))
        axis.axhline(0.0, color="0.6", lw=0.6)
        axis.axvline(0.0, color="0.6", lw=0.6)
        axis.set(title=key, xlabel="x, px", ylabel="y, px (down)", xlim=(-most, most), ylim=(most, -most))
        axis.set_aspect("equal")
        axis.legend(fontsize=8, loc="upper right")
    return plots.plot(figure, "residuals as recorded and as they would have been")


def _pointing_record(one: WouldBe) -> dict[str, Any]:
    return {
        "operation": one.seen.operation,
        "pointing": one.seen.pointing,
        "frame_id": one.seen.frame_id,
        "range_m": one.range_m,
        "recorded_px": as_json(one.seen.residual_px),
        "would_be_px": as_json(one.residual_px),
        "sigma_px": as_json(one.sigma_px),
        "commanded_rad": as_json(one.commanded_rad),
        "recorded_commanded_rad": as_json(one.seen.commanded_rad),
        "error": one.error,
    }

"""What a pointing experiment records: targets, where they landed, and the table's rows."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drivers.interfaces import Image

# Rms pixel errors (x, y) of the paper's Table VI: first and second pointing at each distance in metres.
PAPER_TABLE_VI: Mapping[float, tuple[tuple[float, float], tuple[float, float]]] = {
    10.0: ((0.591, 1.219), (0.527, 0.778)),
    6.0: ((0.743, 1.243), (0.596, 0.844)),
    2.0: ((1.260, 0.925), (0.672, 0.921)),
}


@dataclass(frozen=True)
class Landing:
    """One pointing of a target: the measured residual, its sigma, the true one where it is known."""

    residual_px: tuple[float, float]
    sigma_px: tuple[float, float]
    frame_id: str
    true_px: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class TargetRecord:
    """One target: what was clicked, where it landed, or why it failed; pictures where they were kept."""

    distance_m: float
    index: int
    camera: str
    frame_id: str
    clicked_px: tuple[float, float]
    range_m: float
    pan_before_rad: float
    tilt_before_rad: float
    landings: tuple[Landing, ...]
    error: str = ""
    seconds: float = 0.0
    operation: Mapping[str, Any] = field(default_factory=dict)
    clicked_image: Image | None = None
    landed_images: tuple[Image, ...] = ()


@dataclass(frozen=True)
class DistanceSummary:
    """One row of the table. ``*_rms_px`` is None where no target landed."""

    distance_m: float
    targets: int
    failed: int
    first_rms_px: tuple[float, float] | None
    second_rms_px: tuple[float, float] | None
    true_first_rms_px: tuple[float, float] | None
    true_second_rms_px: tuple[float, float] | None
    worst_first_px: float | None
    seconds: float


@dataclass(frozen=True, eq=False)
class PointingExperiment:
    """What was run and what came out."""

    url: str
    status: Mapping[str, Any]
    seed: int
    camera: str
    aim_px: tuple[float, float]
    records: tuple[TargetRecord, ...]
    summaries: tuple[DistanceSummary, ...]
    started: str
    seconds: float
    notes: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return the document of contract section 3, with what else is known of each distance."""
        return {
            "url": self.url,
            "hardware": self.status.get("hardware"),
            "camera": self.camera,
            "seed": self.seed,
            "seconds": round(self.seconds, 2),
            "distances": [_row_as_json(row) for row in self.summaries],
            "notes": list(self.notes),
            "failures": [
                {"distance_m": r.distance_m, "target": r.index, "error": r.error}
                for r in self.records
                if r.error
            ],
        }


def _row_as_json(row: DistanceSummary) -> dict[str, Any]:
    """One distance for programs; the keys of the contract first."""
    document: dict[str, Any] = {
        "distance_m": row.distance_m,
        "targets": row.targets,
        "first_rms_px": row.first_rms_px,
        "second_rms_px": row.second_rms_px,
        "seconds": round(row.seconds, 2),
        "failed": row.failed,
        "worst_first_px": row.worst_first_px,
    }
    if row.true_first_rms_px is not None:
        document["true_first_rms_px"] = row.true_first_rms_px
        document["true_second_rms_px"] = row.true_second_rms_px
    paper = PAPER_TABLE_VI.get(row.distance_m)
    if paper is not None:
        document["paper_first_rms_px"], document["paper_second_rms_px"] = paper
    return document


def summarise_distance(distance_m: float, rows: Sequence[TargetRecord], seconds: float) -> DistanceSummary:
    """Return the table's row for the records of one distance; failed targets are counted, not averaged."""
    firsts = [row.landings[0] for row in rows if len(row.landings) > 0]
    seconds_ = [row.landings[1] for row in rows if len(row.landings) > 1]
    return DistanceSummary(
        distance_m=distance_m,
        targets=len(rows),
        failed=sum(bool(row.error) for row in rows),
        first_rms_px=rms([landing.residual_px for landing in firsts]),
        second_rms_px=rms([landing.residual_px for landing in seconds_]),
        true_first_rms_px=rms([landing.true_px for landing in firsts if landing.true_px is not None]),
        true_second_rms_px=rms([landing.true_px for landing in seconds_ if landing.true_px is not None]),
        worst_first_px=max((math.hypot(*landing.residual_px) for landing in firsts), default=None),
        seconds=seconds,
    )


def rms(pairs: Sequence[tuple[float, float]]) -> tuple[float, float] | None:
    """Return the root mean square of each column about zero, or None of nothing."""
    if not pairs:
        return None
    x, y = np.sqrt(np.mean(np.square(np.array(pairs, dtype=float)), axis=0))
    return float(x), float(y)

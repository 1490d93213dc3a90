"""What a hand-off experiment records: targets, cameras, errors, and the table's rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.geometry.handoff import PredictedPixel
from calib.matching.handed_over import HandoffBias, MatchedHandoff, handoff_bias
from calib.matching.handoff import RefinedPixel
from drivers.interfaces import Image
from mastctl.watch.handoffs import bias_told

PAPER_WORST_PX: Mapping[str, float] = {"pancam to navcam": 2.5, "navcam to hazcam": 4.0}
"""The paper's worst geometric hand-off, Pancam to Navcam at 6 m and Navcam to Hazcam at 2 m."""


@dataclass(frozen=True, eq=False)
class Handed:
    """One target in one destination camera.

    ``geometric`` and ``refined`` are what the hand-off says; ``true_px`` where the target really is, None
    where nobody knows.
    """

    camera: str
    geometric: PredictedPixel
    refined: RefinedPixel
    true_px: tuple[float, float] | None
    image: Image | None = None

    @property
    def geometric_error_px(self) -> tuple[float, float] | None:
        """Geometric less true; less refined where the truth is not known; None where neither is."""
        return self._error(self.geometric.pixel_px)

    @property
    def refined_error_px(self) -> tuple[float, float] | None:
        """Refined less true; None where the refinement was not accepted or the truth is not known."""
        return None if self.true_px is None else self._error(self.refined.pixel_px)

    def _error(self, pixel_px: np.ndarray) -> tuple[float, float] | None:
        reference = self.refined.pixel_px if self.true_px is None else np.array(self.true_px)
        off = pixel_px - reference
        return (float(off[0]), float(off[1])) if np.isfinite(off).all() else None


@dataclass(frozen=True, eq=False)
class HandoffRecord:
    """One target of one step: what each destination camera saw, or why it failed.

    ``kind`` is what the target is: ``ground`` chosen by its texture, a brick's ``corner`` or ``face``.
    """

    step: str
    index: int
    distance_m: float
    range_m: float
    frame_id: str
    clicked_px: tuple[float, float]
    handed: tuple[Handed, ...]
    error: str = ""
    seconds: float = 0.0
    source_image: Image | None = None
    kind: str = "ground"
    matched: MatchedHandoff | None = None


@dataclass(frozen=True)
class HandoffSummary:
    """One row of the table: one step, kind of target and camera; None where there is nothing to average."""

    step: str
    kind: str
    camera: str
    targets: int
    failed: int
    geometric_rms_px: tuple[float, float] | None
    geometric_bias_px: tuple[float, float] | None
    geometric_worst_px: float | None
    accepted: int
    refined_rms_px: float | None
    refined_worst_px: float | None
    verdicts: Mapping[str, int]


@dataclass(frozen=True, eq=False)
class HandoffExperiment:
    """What was run and what came out."""

    status: Mapping[str, Any]
    seed: int
    click_px: float
    records: tuple[HandoffRecord, ...]
    summaries: tuple[HandoffSummary, ...]
    started: str
    seconds: float

    @property
    def bias(self) -> tuple[HandoffBias, ...]:
        """The mean offset of what was found from what was predicted, by camera."""
        return handoff_bias([r.matched for r in self.records if r.matched is not None])

    def as_json(self) -> dict[str, Any]:
        """Return the whole record for programs."""
        return {
            "hardware": self.status.get("hardware"),
            "seed": self.seed,
            "click_px": self.click_px,
            "seconds": round(self.seconds, 2),
            "handoffs": [
                {
                    "handoff": row.step,
                    "kind": row.kind,
                    "camera": row.camera,
                    "targets": row.targets,
                    "failed": row.failed,
                    "geometric_rms_px": row.geometric_rms_px,
                    "geometric_bias_px": row.geometric_bias_px,
                    "geometric_worst_px": row.geometric_worst_px,
                    "accepted": row.accepted,
                    "refined_rms_px": row.refined_rms_px,
                    "refined_worst_px": row.refined_worst_px,
                    "verdicts": dict(row.verdicts),
                    "paper_worst_px": PAPER_WORST_PX.get(row.step),
                }
                for row in self.summaries
            ],
            "bias": [bias_told(one) for one in self.bias],
            "failures": [
                {"handoff": r.step, "target": r.index, "error": r.error} for r in self.records if r.error
            ],
        }


def summarise_handoffs(step: str, kind: str, camera: str, records: Sequence[HandoffRecord]) -> HandoffSummary:
    """Return the table's row of one kind of target in one camera of one step."""
    mine = [r for r in records if r.step == step and r.kind == kind]
    seen = [h for r in mine for h in r.handed if h.camera == camera]
    geometric = np.array([e for h in seen if (e := h.geometric_error_px) is not None]).reshape(-1, 2)
    refined = np.array([e for h in seen if (e := h.refined_error_px) is not None]).reshape(-1, 2)
    verdicts: dict[str, int] = {}
    for one in seen:
        verdicts[one.refined.verdict] = verdicts.get(one.refined.verdict, 0) + 1
    return HandoffSummary(
        step,
        kind,
        camera,
        len(mine),
        sum(bool(r.error) for r in mine),
        _pair(np.sqrt(np.mean(geometric**2, axis=0))) if len(geometric) else None,
        _pair(geometric.mean(axis=0)) if len(geometric) else None,
        float(np.linalg.norm(geometric, axis=1).max()) if len(geometric) else None,
        verdicts.get("accepted", 0),
        float(np.sqrt(np.mean(np.sum(refined**2, axis=1)))) if len(refined) else None,
        float(np.linalg.norm(refined, axis=1).max()) if len(refined) else None,
        verdicts,
    )


def _pair(values: np.ndarray) -> tuple[float, float]:
    return float(values[0]), float(values[1])

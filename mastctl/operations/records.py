"""The record of an operation; frozen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from mastctl.as_json import as_json
from mastctl.state.standing import Residual

OperationState = Literal["queued", "running", "done", "failed", "stopped"]


@dataclass(frozen=True, eq=False)
class Operation:
    """One operation's record so far; replaced as it goes on, never edited. Times of CLOCK_MONOTONIC."""

    id: str
    state: OperationState
    request: Mapping[str, Any]
    created_s: float
    started_s: float | None = None
    ended_s: float | None = None
    steps: tuple[Any, ...] = ()
    result: Any = None
    error: Mapping[str, Any] | None = None

    def told(self, *, steps: bool = True) -> dict[str, Any]:
        """Return the record as JSON; in front the last pointing's residual too, or why a jog ended."""
        told: dict[str, Any] = as_json(self if steps else replace(self, steps=()))
        made = told.pop("result")
        result = made if isinstance(made, dict) else {}
        pointings = result.get("pointings") or []
        last = pointings[-1] if pointings else {}
        if not steps:
            del told["steps"]
        ended = {"ended_because": result["ended_because"]} if "ended_because" in result else {}
        return (
            told
            | ended
            | {
                "residual_px": last.get("residual_px"),
                "residual_sigma_px": last.get("residual_sigma_px"),
                "position_m": result.get("position_m"),
                "range_m": result.get("range_m"),
                "range_from": result.get("range_from", ""),
                "range_interval_m": result.get("range_interval_m"),
                "pointings": pointings,
            }
        )


def last_residual(result: Any, name: str) -> Residual | None:
    """Return the residual that a result ends with, if it measured one."""
    pointings = getattr(result, "pointings", None) or ()
    if not pointings:
        return None
    told = as_json(pointings[-1])
    residual, sigma = told.get("residual_px"), told.get("residual_sigma_px")
    if not (residual and sigma and None not in residual and None not in sigma):
        return None
    return Residual((residual[0], residual[1]), (sigma[0], sigma[1]), name)


def last_frame(result: Any) -> str | None:
    """Return the id of the picture that a result ends with, None where it took none."""
    pointings = getattr(result, "pointings", None) or ()
    frame_id = getattr(pointings[-1], "frame_id", None) if pointings else None
    return frame_id if isinstance(frame_id, str) and frame_id else None

"""The record of an operation; frozen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mastctl.answers import OperationListed, OperationState, OperationTold
from mastctl.as_json import as_json
from mastctl.control.standing import Residual


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

    def listed(self) -> OperationListed:
        """Return the record as JSON without its steps; in front the last pointing's residual."""
        made = as_json(self.result)
        result = made if isinstance(made, dict) else {}
        pointings = result.get("pointings") or []
        last = pointings[-1] if pointings else {}
        record: OperationListed = {
            "id": self.id,
            "state": self.state,
            "request": as_json(self.request),
            "created_s": self.created_s,
            "started_s": self.started_s,
            "ended_s": self.ended_s,
            "error": as_json(self.error),
            "residual_px": last.get("residual_px"),
            "residual_sigma_px": last.get("residual_sigma_px"),
            "position_m": result.get("position_m"),
            "range_m": result.get("range_m"),
            "range_from": result.get("range_from", ""),
            "range_interval_m": result.get("range_interval_m"),
            "pointings": pointings,
        }
        if "ended_because" in result:
            record["ended_because"] = result["ended_because"]
        return record

    def as_json(self) -> OperationTold:
        """Return the record as JSON with its steps."""
        return {**self.listed(), "steps": as_json(self.steps)}


def last_residual(result: Any, name: str) -> Residual | None:
    """Return the residual that a result ends with, if it measured one."""
    last = as_json(_last_pointing(result))
    residual, sigma = last.get("residual_px"), last.get("residual_sigma_px")
    if not (residual and sigma and None not in residual and None not in sigma):
        return None
    return Residual((residual[0], residual[1]), (sigma[0], sigma[1]), name)


def last_frame(result: Any) -> str | None:
    """Return the id of the image that a result ends with, None where it took none."""
    return _last_pointing(result).get("frame_id") or None


def _last_pointing(result: Any) -> Mapping[str, Any]:
    """The last pointing of a result that has some, an empty one of any other."""
    pointings = result.get("pointings") if isinstance(result, Mapping) else None
    return pointings[-1] if pointings else {}

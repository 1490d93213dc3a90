"""Evidence of motion: whether the pictures moved as the joints say that the head did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calib.mast.rig import Rig
from calib.pictures.same_patches import Posed
from calib.pictures.shown_view import ShownView, ViewLimits, overlap, shown_view
from calib.rigid import FloatArray
from drivers.errors import BadFrame
from mastctl.pointing.looking import View

LEAST_OVERLAP = 0.15
"""Less of a picture in common is not worth a picture before the move."""


class MotionSeen:
    """The last pictures of each head camera during one request, and the new ones against them.

    Only pictures of one request are compared: between two requests the rover may have been driven. The
    first picture of a camera has nothing before it, and is believed.
    """

    def __init__(self, rig: Rig, limits: ViewLimits) -> None:
        self._rig = rig
        self._limits = limits
        self._before: dict[str, tuple[Posed, tuple[str, Posed] | None]] = {}

    def remember(self, views: Mapping[str, View]) -> None:
        """Keep pictures of one moment for the next comparison."""
        posed = {name: _posed(view) for name, view in views.items() if self._on_head(name)}
        for name, one in posed.items():
            other = next((eye for eye in self._pair(name) if eye != name and eye in posed), None)
            self._before[name] = one, None if other is None else (other, posed[other])

    def lacking(
        self, cameras: Sequence[str], here_rad: tuple[float, float], goal_rad: tuple[float, float]
    ) -> list[str]:
        """Return the head cameras without a picture, of which one before a move will tell something.

        None of a move that is smaller than what need not show, or that leaves too little in common.
        """
        way_rad = max(abs(goal - here) for goal, here in zip(goal_rad, here_rad, strict=True))
        if way_rad <= self._limits.floor_rad:
            return []
        wanted = [name for name in cameras if self._on_head(name) and name not in self._before]
        return [name for name in wanted if overlap(self._rig, name, here_rad, goal_rad) >= LEAST_OVERLAP]

    def check(self, views: Mapping[str, View], detail: dict[str, Any]) -> None:
        """Compare new pictures with the last ones of the same cameras, and keep them instead.

        Parameters
        ----------
        views
            New pictures of one moment by camera.
        detail
            Of the step: gets ``motion_evidence``, what was seen by camera.

        Raises
        ------
        BadFrame
            If a picture shows another view than the joints say.
        """
        told: dict[str, dict[str, Any]] = {}
        detail["motion_evidence"] = told
        refused: BadFrame | None = None
        for name, view in views.items():
            if not self._on_head(name):
                told[name] = {"verdict": "on_body"}
                continue
            if name not in self._before:
                told[name] = {"verdict": "no_picture_before"}
                continue
            before, beside = self._before[name]
            after = _posed(view)
            shown = shown_view(self._rig, name, before, after, beside, self._limits)
            told[name] = as_told(shown)
            if shown.verdict in ("contradicted", "unlike"):
                refused = refused or BadFrame(_words(shown, before, after), device=name, detail=told[name])
        if refused is not None:
            raise refused
        self.remember(views)

    def _on_head(self, name: str) -> bool:
        return self._rig.cameras[name].on == "head"

    def _pair(self, name: str) -> tuple[str, ...]:
        return next((pair for pair in self._rig.stereo.values() if name in pair), ())


def as_told(shown: ShownView) -> dict[str, Any]:
    """Return what was seen as it stands in the record; numbers only where a view was found."""
    told: dict[str, Any] = {"verdict": shown.verdict}
    if np.isfinite(shown.pan_rad):
        told.update(
            pan_rad=round(shown.pan_rad, 6),
            tilt_rad=round(shown.tilt_rad, 6),
            off_rad=_rounded(shown.off_rad),
            sigma_rad=_rounded(shown.sigma_rad),
            allowed_rad=_rounded(shown.allowed_rad),
            off_px=round(shown.off_px, 2),
        )
    return told | {"patches": [shown.agreeing, shown.expected]}


def _posed(view: View) -> Posed:
    return Posed(view.image, *view.frame.true_rad)


def _rounded(values: Sequence[float] | FloatArray) -> list[float]:
    return [round(float(value), 6) for value in values]


def _words(shown: ShownView, before: Posed, after: Posed) -> str:
    """Say what a picture shows instead of what it should."""
    told = f"pan {after.pan_rad:.3f}, tilt {after.tilt_rad:.3f} rad"
    if shown.verdict == "unlike":
        return (
            f"the picture shows nothing of what {shown.expected} places of the picture before should show at "
            f"{told}: joints and pictures contradict each other"
        )
    start, goal = np.array(before.angles_rad), np.array(after.angles_rad)
    seen, way = np.array([shown.pan_rad, shown.tilt_rad]), goal - start
    allowed = np.array(shown.allowed_rad)
    why = ""
    if (np.abs(seen - start) <= allowed).all():
        why = ", that of before the move"
    elif way.any():
        share = float(np.clip((seen - start) @ way / (way @ way), 0.0, 1.0))
        if (np.abs(start + share * way - seen) <= allowed).all():
            why = f", one on the way there ({100 * share:.0f} %)"
    return (
        f"the picture shows the view of pan {shown.pan_rad:.3f}, tilt {shown.tilt_rad:.3f} rad{why}, not of "
        f"{told} ({shown.off_px:.0f} px off): joints and pictures contradict each other"
    )

"""What images say about motion: did they move as the joints did, are two of one moment, is it repeated?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.shown_view import Posed, ShownView, ViewLimits, overlap, shown_view
from calib.matching.verdict import PatchMatch
from drivers.errors import BadFrame
from mastctl.devices.joint_history import HeadReading
from mastctl.devices.keep_out import Pair
from mastctl.motion.results import PointingError, rounded
from mastctl.motion.views import CameraView, Clicked, RigCameras

LEAST_OVERLAP = 0.15
"""Less of an image in common is not worth an image before the move."""


class MotionSeen:
    """The last images of each head camera during one request, and the new ones against them.

    Only images of one request are compared: between two requests the rover may have been driven. The first
    image of a camera has nothing before it, and is accepted.
    """

    def __init__(self, rig: Rig, limits: ViewLimits) -> None:
        self._rig = rig
        self._limits = limits
        self._before: dict[str, tuple[Posed, tuple[str, Posed] | None]] = {}

    def remember(self, views: Mapping[str, CameraView]) -> None:
        """Keep images of one moment for the next comparison."""
        posed = {name: _posed(view) for name, view in views.items() if self._on_head(name)}
        for name, image in posed.items():
            other = next((one for one in self._pair(name) if one != name and one in posed), None)
            self._before[name] = image, None if other is None else (other, posed[other])

    def lacking(self, cameras: Sequence[str], start_rad: Pair, goal_rad: Pair) -> list[str]:
        """Return the head cameras without an image, of which one before a move will show something.

        None of a move that is smaller than what need not show, or that leaves too little in common.
        """
        way_rad = max(abs(goal - start) for goal, start in zip(goal_rad, start_rad, strict=True))
        if way_rad <= self._limits.floor_rad:
            return []
        wanted = [name for name in cameras if self._on_head(name) and name not in self._before]
        return [name for name in wanted if overlap(self._rig, name, start_rad, goal_rad) >= LEAST_OVERLAP]

    def check(self, views: Mapping[str, CameraView], detail: dict[str, Any]) -> None:
        """Compare new images of one moment with the last ones of the same cameras, and keep them instead.

        ``detail`` of the step gets ``motion_evidence``, what was seen by camera. Raises BadFrame if an image
        shows another view than the joints say.
        """
        evidence: dict[str, dict[str, Any]] = {}
        detail["motion_evidence"] = evidence
        refused: BadFrame | None = None
        for name, view in views.items():
            if not self._on_head(name):
                evidence[name] = {"verdict": "on_body"}
                continue
            if name not in self._before:
                evidence[name] = {"verdict": "no_picture_before"}
                continue
            before, beside = self._before[name]
            after = _posed(view)
            shown = shown_view(self._rig, name, before, after, beside, self._limits)
            evidence[name] = _facts(shown)
            if shown.verdict in ("contradicted", "unlike"):
                refused = refused or BadFrame(
                    _contradiction(shown, before, after), device=name, detail=evidence[name]
                )
        if refused is not None:
            raise refused
        self.remember(views)

    def _on_head(self, name: str) -> bool:
        return self._rig.cameras[name].on == "head"

    def _pair(self, name: str) -> tuple[str, ...]:
        return next((pair for pair in self._rig.stereo.values() if name in pair), ())


def _facts(shown: ShownView) -> dict[str, Any]:
    """What was seen, for the record; numbers only where a view was found."""
    facts: dict[str, Any] = {"verdict": shown.verdict}
    if np.isfinite(shown.pan_rad):
        facts.update(
            pan_rad=round(shown.pan_rad, 6),
            tilt_rad=round(shown.tilt_rad, 6),
            off_rad=_rounded(shown.off_rad),
            sigma_rad=_rounded(shown.sigma_rad),
            allowed_rad=_rounded(shown.allowed_rad),
            off_px=round(shown.off_px, 2),
        )
    return facts | {"patches": [shown.agreeing, shown.expected]}


def _posed(view: CameraView) -> Posed:
    return Posed(view.image, *view.frame.true_rad)


def _rounded(values: Sequence[float] | FloatArray) -> list[float]:
    return [round(float(value), 6) for value in values]


def _contradiction(shown: ShownView, before: Posed, after: Posed) -> str:
    """Say what an image shows instead of what it should."""
    expected = f"pan {after.pan_rad:.3f}, tilt {after.tilt_rad:.3f} rad"
    if shown.verdict == "unlike":
        return (
            f"the picture shows nothing of what {shown.expected} places of the picture before should show at "
            f"{expected}: joints and pictures contradict each other"
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
        f"{expected} ({shown.off_px:.0f} px off): joints and pictures contradict each other"
    )


def check_one_moment(
    cameras: RigCameras,
    view: CameraView,
    pixel_px: FloatArray,
    others: Sequence[CameraView],
    resting: HeadReading,
) -> dict[str, Any]:
    """Check that the thing at a pixel moves by less than half a pixel between exposures of several cameras.

    Where these were not at one moment, its speed is measured in a further image of the first camera, in the
    image itself: the mast and the target count alike. That the head reports no motion is checked before
    (`RigCameras.new`).

    Returns
    -------
    detail
        For the record: ``dt_s`` by other camera, and ``image_speed_px_per_s``, ``moved_px`` where measured.

    Raises PointingError ``target_moving`` if it moves too far, or is not found where it was; DriverError if
    the further image does not come.
    """
    settings = cameras.settings
    detail = apart(view, others)
    moments_s = (0.0, *detail["dt_s"].values())
    spread_s = max(moments_s) - min(moments_s)
    if spread_s <= settings.same_moment_s:
        return detail
    camera = view.frame.camera
    later = cameras.new((camera,), view.frame.exposure_began_s, resting)[camera]
    between_s = later.frame.exposure_began_s - view.frame.exposure_began_s
    try:
        seen = cameras.again(view, pixel_px, later)
    except PointingError as error:
        raise PointingError(
            "target_moving",
            f"the cameras were exposed {1e3 * spread_s:.1f} ms apart, and {1e3 * between_s:.1f} ms later "
            f"{camera} does not see the target where it was: {error}",
        ) from None
    speed = float(np.linalg.norm(seen.pixel_px - pixel_px)) / between_s
    moved_px = speed * spread_s
    detail.update(image_speed_px_per_s=round(speed, 3), moved_px=round(moved_px, 4))
    if moved_px >= settings.between_cameras_px:
        raise PointingError(
            "target_moving",
            f"the target moves at {speed:.1f} px/s in {camera}, {moved_px:.2f} px between exposures "
            f"{1e3 * spread_s:.1f} ms apart; less than {settings.between_cameras_px:g} px serves a "
            "measurement",
        )
    return detail


def apart(view: CameraView, others: Sequence[CameraView]) -> dict[str, Any]:
    """Return ``dt_s`` for the record: how much later than the first camera each other began to expose."""
    begun_s = view.frame.exposure_began_s
    return {"dt_s": {o.frame.camera: round(o.frame.exposure_began_s - begun_s, 6) for o in others}}


SIGMAS = 3.0


def repeated(
    cameras: RigCameras,
    clicked: Clicked,
    first: CameraView,
    seen: PatchMatch,
    settled: HeadReading,
) -> tuple[CameraView, PatchMatch, dict[str, Any]]:
    """Find the clicked thing in a later image of the same camera, where the first one showed it.

    ``first`` and ``seen`` are the first image after the move, and where that shows it; ``settled`` is the
    head when it had come to rest.

    Returns
    -------
    later, again, proven
        The later image, where that shows it, and for the record ``repeated_after_s``, ``apart_px`` (x, y)
        and ``fresh_to_s``: images older than their stamps by up to that, seconds, would not have passed. 0
        where both are the same to the last bit, as of a camera that froze or of a replay.

    Raises PointingError ``not_repeated`` if it is elsewhere by more than three sigma and what the joints read
    between the two (a head at rest may dither by some counts), or not found; DriverError if the image does
    not come.
    """
    settings = cameras.settings
    camera, begun_s = first.frame.camera, first.frame.exposure_began_s
    later = cameras.new((camera,), begun_s + settings.repeat_after_s, settled)[camera]
    after_s = later.frame.exposure_began_s - begun_s
    try:
        again = cameras.look_for(clicked, later)
    except PointingError as error:
        message = f"{after_s:.2f} s later {camera} does not see the target any more: {error}"
        raise PointingError("not_repeated", message) from None
    apart_px = again.pixel_px - seen.pixel_px
    before_px, after_px = (view.camera.project(clicked.plane.point_m)[0] for view in (first, later))
    allowed_px = SIGMAS * np.hypot(seen.sigma_px, again.sigma_px) + np.abs(after_px - before_px)
    if (np.abs(apart_px) > allowed_px).any():
        raise PointingError(
            "not_repeated",
            f"{after_s:.2f} s later {camera} shows the target {apart_px[0]:+.2f}, {apart_px[1]:+.2f} px "
            f"elsewhere, at most {allowed_px[0]:.2f}, {allowed_px[1]:.2f} px (3 sigma) is expected of a head "
            "at rest. The pictures are older than their stamps ('mastctl camera sync' measures by how much), "
            "the mast still rings, or the target or the rover moves",
        )
    another = not np.array_equal(first.image, later.image)
    proven = {
        "repeated_after_s": round(after_s, 3),
        "apart_px": rounded(apart_px),
        "fresh_to_s": round(later.frame.exposure_began_s - settled.time_s, 3) if another else 0.0,
    }
    return later, again, proven

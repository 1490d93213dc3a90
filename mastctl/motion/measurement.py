"""New images and what they show: the clicked thing found again, the motion of the head, one moment.

All geometry is by the mast file and the true joint angles measured.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from calib.errors import CalibError
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.partner import UP, StereoMatch, find_partner
from calib.matching.patch import MatchSettings, PatchMatch, match_patch
from calib.matching.shown_view import FLOOR_RAD, Posed, ShownView, overlap, shown_view
from calib.matching.warp import Plane, PosedImage, Relief, carry, facing_plane, grey
from drivers.errors import BadFrame, DriverError
from mastctl.devices.devices import Devices
from mastctl.devices.frames import StampedFrame
from mastctl.devices.joint_history import DITHER_RAD, HeadReading
from mastctl.devices.keep_out import Pair
from mastctl.motion.requests import PointingError

BESIDE = "; try a pixel beside it"
"""To a person who clicked: at a rim or on bare ground a neighbour may match."""
LEAST_OVERLAP = 0.15
"""Less of an image in common is not worth an image before the move."""
FRAME_TIMEOUT_S = 8.0  # for a new image: some frames of a slow camera, on a busy machine
SAME_POSE_RAD = 3e-5  # joint angles nearer than this are one pose: a tenth of a Pancam pixel
SAME_MOMENT_S = 1e-4
"""Exposures less apart than this are one: half a pixel would take 5000 px/s, which blurs any image."""
BETWEEN_CAMERAS_PX = 0.5  # how far the target may move between exposures that serve a measurement
NEAREST_M = 0.4  # nothing nearer is searched
SEARCH_PX = 48.0
"""Half window around the predicted place: what arrival tolerance and mast file explain in a Navcam (6 mrad
are 8 px) with room."""
WIDE_SEARCH_PX = 200.0
"""The next: what a slipped encoder may do (2 degrees are 45 px in a Navcam, 120 in a Pancam)."""
ACROSS_PX = 2.0
"""Largest offset across the epipolar line that is still put down to calibration: the paper's mast fit leaves
1.1 px rms."""
RANGE_PX = 4.0  # the same along it after the move
MATCH = MatchSettings(roughness=0.02, relief=0.01, least_lead=0.03)
"""``roughness`` and ``relief`` decide sigmas only, and only where no second camera saw the surface. A second
place may fit a little better than elsewhere, as along a rock's smooth edge: the prediction and the other
camera must confirm the best."""
SIZES = MATCH, replace(MATCH, half_px=12)
"""The usual patch, and the one that is tried after a move where that fits nowhere."""


@dataclass(frozen=True, eq=False)
class CameraView(PosedImage):
    """A frame as the geometry needs it: grey values, and the camera in the rover frame at its moment."""

    frame: StampedFrame


@dataclass(frozen=True, eq=False)
class Clicked:
    """The thing that was clicked: where in which view, and the surface around it in the rover frame.

    ``relief``: what stands off that plane, if two cameras saw it. ``others``: where else the surface may be,
    if its range is not known.
    """

    view: CameraView
    pixel_px: FloatArray
    plane: Plane
    others: tuple[Plane, ...] = ()
    relief: Relief | None = None


class RigCameras:
    """The cameras during one request, with the last image of each head camera.

    ``check`` is called while images are waited for, and ends the wait by raising. Images of two requests are
    not compared: in between the rover may have been driven.
    """

    def __init__(self, devices: Devices, rig: Rig, check: Callable[[], None] = lambda: None) -> None:
        self._devices = devices
        self._rig = rig
        self._check = check
        self._before: dict[str, tuple[Posed, tuple[str, Posed] | None]] = {}

    def partner(self, camera: str) -> str | None:
        """Return the other camera of a camera's stereo pair, None if it has none."""
        for left, right in self._rig.stereo.values():
            if camera in (left, right):
                return right if camera == left else left
        return None

    def companions(
        self, aiming: str, clicked: str, position_m: FloatArray, resting: HeadReading
    ) -> tuple[str, ...]:
        """Return the cameras that can confirm what the aiming one will see: its partner where that sees it.

        A near target in the middle of one camera may be out of the other's image (a Pancam at 2 m); then
        both cameras of another pair on the head serve, the clicked pair first. Empty if none sees it.
        """
        partner = self.partner(aiming)
        pairs = sorted(self._rig.stereo.values(), key=lambda pair: clicked not in pair)
        for names in ((partner,) if partner else (), *(pair for pair in pairs if aiming not in pair)):
            if names and all(self._sees(name, position_m, resting) for name in names):
                return names
        return ()

    def new(
        self, names: Sequence[str], after_s: float, resting: HeadReading, timeout_s: float | None = None
    ) -> dict[str, CameraView]:
        """Return frames exposed after a moment, by a head that rests where it was read.

        Raises PointingError ``head_moving`` if it moved; DriverError if a frame does not come.
        """
        views = {}
        timeout_s = FRAME_TIMEOUT_S if timeout_s is None else timeout_s
        for name, frame in self._devices.frames(names, after_s, timeout_s, self._check).items():
            apart = max(abs(frame.pan_rad - resting.pan_rad), abs(frame.tilt_rad - resting.tilt_rad))
            if frame.moving or not apart <= DITHER_RAD:
                where = f"an image of {name} was exposed ({apart:.4f} rad off its rest)"
                raise PointingError("head_moving", f"the head moved while {where}")
            views[name] = self.view(frame)
        return views

    def view(self, frame: StampedFrame) -> CameraView:
        """Return a frame with its camera."""
        camera = self._rig.camera_in_rover(frame.camera, *frame.true_rad)
        return CameraView(grey(frame.image), camera, frame)

    # Did the images move as the joints did?

    def remember(self, views: Mapping[str, CameraView]) -> None:
        """Keep images of one moment for the next comparison."""
        posed = {name: _posed(view) for name, view in views.items() if self._on_head(name)}
        for name, image in posed.items():
            other = self.partner(name)
            self._before[name] = image, None if other not in posed else (other, posed[other])

    def lacking(self, cameras: Sequence[str], start_rad: Pair, goal_rad: Pair) -> list[str]:
        """Return the head cameras without an image, of which one before a move will show something.

        None of a move that is smaller than what need not show, or that leaves too little in common.
        """
        if max(abs(goal - start) for goal, start in zip(goal_rad, start_rad, strict=True)) <= FLOOR_RAD:
            return []
        known = self._devices.newest_frames()
        wanted = [one for one in cameras if one in known and self._on_head(one) and one not in self._before]
        return [one for one in wanted if overlap(self._rig, one, start_rad, goal_rad) >= LEAST_OVERLAP]

    def check_motion(self, views: Mapping[str, CameraView], detail: dict[str, Any]) -> None:
        """Compare new images of one moment with the last ones of the same cameras, and keep them instead.

        ``detail`` gets ``motion_evidence``, what was seen by camera. The first image of a camera has nothing
        before it, and is accepted. Raises BadFrame if an image shows another view than the joints say.
        """
        evidence = detail["motion_evidence"] = dict[str, dict[str, Any]]()
        refused: BadFrame | None = None
        for name, view in views.items():
            if name not in self._before:
                evidence[name] = {"verdict": "no_picture_before" if self._on_head(name) else "on_body"}
                continue
            before, beside = self._before[name]
            after = _posed(view)
            shown = shown_view(self._rig, name, before, after, beside)
            evidence[name] = _facts(shown)
            if shown.verdict in ("contradicted", "unlike"):
                refused = refused or BadFrame(
                    _contradiction(shown, before, after), device=name, detail=evidence[name]
                )
        if refused is not None:
            raise refused
        self.remember(views)

    def check_one_moment(
        self, view: CameraView, pixel_px: FloatArray, others: Sequence[CameraView], resting: HeadReading
    ) -> dict[str, Any]:
        """Check that what a pixel shows moves by less than half a pixel between exposures of several cameras.

        Where these were not at one moment, its speed is measured in a further image of the first camera.
        Returns for the record ``dt_s`` by other camera, and ``image_speed_px_per_s``, ``moved_px`` where
        measured. Raises PointingError ``target_moving``; DriverError if the further image does not come.
        """
        detail = apart(view, others)
        moments_s = (0.0, *detail["dt_s"].values())
        spread_s = max(moments_s) - min(moments_s)
        if spread_s <= SAME_MOMENT_S:
            return detail
        camera = view.frame.camera
        later = self.new((camera,), view.frame.exposure_began_s, resting)[camera]
        between_s = later.frame.exposure_began_s - view.frame.exposure_began_s
        try:
            seen = self.again(view, pixel_px, later)
        except PointingError as error:
            raise PointingError(
                "target_moving",
                f"the cameras were exposed {1e3 * spread_s:.1f} ms apart, and {1e3 * between_s:.1f} ms later "
                f"{camera} does not see the target where it was: {error}",
            ) from None
        speed = float(np.linalg.norm(seen.pixel_px - pixel_px)) / between_s
        moved_px = speed * spread_s
        detail.update(image_speed_px_per_s=round(speed, 3), moved_px=round(moved_px, 4))
        if moved_px >= BETWEEN_CAMERAS_PX:
            raise PointingError(
                "target_moving",
                f"the target moves at {speed:.1f} px/s in {camera}, {moved_px:.2f} px between exposures "
                f"{1e3 * spread_s:.1f} ms apart; less than {BETWEEN_CAMERAS_PX:g} px serves a "
                "measurement",
            )
        return detail

    # Where is the clicked thing?

    def again(self, view: CameraView, pixel_px: FloatArray, now: CameraView) -> PatchMatch:
        """Find a clicked pixel in a new frame of the same camera, before its range is known.

        Raises PointingError ``not_in_view`` if the head has turned away since, ``target_...``.
        """
        turned = max(
            abs(view.frame.pan_rad - now.frame.pan_rad), abs(view.frame.tilt_rad - now.frame.tilt_rad)
        )
        try:
            planes = [facing_plane(view.camera, pixel_px, range_m) for range_m in (1.0, 2.0, 1e3)]
        except CalibError as error:  # a pixel without a ray
            raise PointingError("outside_image", str(error)) from None
        if turned <= SAME_POSE_RAD:
            return _good(match_patch(view, pixel_px, planes[1], now, 12.0, MATCH), now)
        places = np.array([carry(pixel_px, view.camera, plane, now.camera)[0] for plane in planes])
        size = np.array(now.camera.size_px)
        if not np.isfinite(places).all() or (places[1] < 0).any() or (places[1] > size - 1).any():
            raise PointingError(
                "not_in_view",
                f"the head has turned by {turned:.3f} rad since the clicked image of {view.frame.camera}: "
                "the pixel is out of view, click in a new image",
            )
        spread = float(np.ptp(places, axis=0).max())
        search = min(WIDE_SEARCH_PX, SEARCH_PX / 2 + spread)
        matches = [
            match_patch(view, pixel_px, plane, now, search, MATCH)
            for plane in (planes[1], Plane(planes[1].point_m, UP))
        ]
        return _good(_best(matches), now)

    def stereo(self, view: CameraView, pixel_px: FloatArray, other: CameraView) -> StereoMatch:
        """Find the other camera's pixel along the epipolar line.

        Raises PointingError ``target_...``, ``eyes_disagree`` if it lies off the line.
        """
        found = find_partner(view, pixel_px, other, NEAREST_M, MATCH)
        _good(found.match, other, "" if found.match.verdict == "border" else BESIDE)
        if abs(found.across_px) > ACROSS_PX + 5.0 * found.across_sigma_px:
            raise PointingError(
                "eyes_disagree",
                f"{other.frame.camera} sees the target {found.across_px:+.2f} px off the line on which "
                f"{view.frame.camera} puts it, at most {ACROSS_PX:g} px is expected{BESIDE}",
            )
        return found

    def find(self, clicked: Clicked, now: CameraView) -> PatchMatch:
        """Find the clicked thing in a new view: near where it should be, then further around.

        Raises PointingError ``target_...``.
        """
        planes = [clicked.plane, *clicked.others]
        ray = clicked.view.camera.ray(clicked.pixel_px)
        if abs(float(ray.directions @ clicked.plane.normal)) < 0.97:
            planes.append(Plane(clicked.plane.point_m, -ray.directions))  # if the slope was misjudged
        found: list[PatchMatch] = []
        for search in (SEARCH_PX, WIDE_SEARCH_PX):
            for plane, size in product(planes, SIZES):
                relief = clicked.relief if plane is clicked.plane else None
                found.append(match_patch(clicked.view, clicked.pixel_px, plane, now, search, size, relief))
                if found[-1].verdict == "good":
                    return found[-1]
            if found[0].verdict in ("flat", "ambiguous"):
                break
        return _good(_best(found), now)

    def agree(
        self, clicked: Clicked, now: CameraView, seen: PatchMatch, other: CameraView, same_pair: bool
    ) -> tuple[PatchMatch, dict[str, Any]]:
        """Find the clicked thing in the other camera too; return the match there, and facts for the record.

        One camera alone would accept a shifted image. Compared is the place in the other one with where the
        first one's ray leads there; a wrong joint angle turns both alike and does not show. Raises
        PointingError ``eyes_disagree``.
        """
        try:
            confirmed = self.find(clicked, other)
        except PointingError as error:
            raise PointingError(
                "eyes_disagree",
                f"{now.frame.camera} finds the target, {other.frame.camera} does not confirm it: {error}",
            ) from None
        # The place as the first camera sees it, at the range that is assumed, and two per cent farther.
        ray = now.camera.ray(seen.pixel_px)
        range_m = float(np.linalg.norm(clicked.plane.point_m - ray.origins_m))
        assumed, farther = other.camera.project(
            ray.origins_m + range_m * np.array([[1.0], [1.02]]) * ray.directions
        )[0]
        between, along = confirmed.pixel_px - assumed, farther - assumed
        along /= max(float(np.linalg.norm(along)), 1e-12)
        along_px, across_px = float(between @ along), float(along[0] * between[1] - along[1] * between[0])
        detail = {
            "frame_id": other.frame.frame_id,
            "pixel_px": rounded(confirmed.pixel_px),
            "across_px": round(across_px, 3),
            "along_px": round(along_px, 3),
        }
        if abs(across_px) > ACROSS_PX or (same_pair and abs(along_px) > RANGE_PX):
            raise PointingError(
                "eyes_disagree",
                f"{now.frame.camera} and {other.frame.camera} put the target {across_px:+.2f} px across and "
                f"{along_px:+.2f} px along the epipolar line apart, at most {ACROSS_PX:g} px across "
                f"and {RANGE_PX:g} px along is expected",
            )
        return confirmed, detail

    def _on_head(self, name: str) -> bool:
        return self._rig.cameras[name].on == "head"

    def _sees(self, name: str, position_m: FloatArray, resting: HeadReading) -> bool:
        """Whether a configured camera has a position well inside its image."""
        if name not in self._devices.newest_frames():
            return False
        camera = self._rig.camera_in_rover(name, *resting.true_rad)
        place, valid = camera.project(position_m)
        return bool(valid) and camera.holds(place, 2.0 * MATCH.half_px)


def apart(view: CameraView, others: Sequence[CameraView]) -> dict[str, Any]:
    """Return ``dt_s`` for the record: how much later than the first camera each other began to expose."""
    begun_s = view.frame.exposure_began_s
    return {"dt_s": {o.frame.camera: round(o.frame.exposure_began_s - begun_s, 6) for o in others}}


def match_facts(found: PatchMatch) -> Mapping[str, Any]:
    """Return a match's numbers for a step's detail."""
    return {
        "pixel_px": rounded(found.pixel_px),
        "sigma_px": rounded(found.sigma_px),
        "correlation": round(found.correlation, 3),
        "second": round(found.second, 3),
    }


def rounded(values: FloatArray | Sequence[float], digits: int = 4) -> list[float]:
    """Return numbers for a step's detail."""
    return [round(float(value), digits) for value in np.asarray(values).ravel()]


def available(
    names: Sequence[str],
    take: Callable[[list[str]], dict[str, CameraView]],
    needed: Sequence[str] = (),
) -> tuple[dict[str, CameraView], dict[str, str]]:
    """Take images of those cameras that give one; return them, and why another gives none.

    Raises what ``take`` does of a camera that is ``needed``, and of the head.
    """
    missing: dict[str, str] = {}
    while left := [name for name in names if name not in missing]:
        try:
            return take(left), missing
        except DriverError as error:
            if error.device not in left or error.device in needed:
                raise
            missing[error.device] = " ".join(str(error).split())
    return {}, missing


def _posed(view: CameraView) -> Posed:
    return Posed(view.image, *view.frame.true_rad)


def _facts(shown: ShownView) -> dict[str, Any]:
    """What was seen of a motion, for the record; numbers only where a view was found."""
    facts: dict[str, Any] = {"verdict": shown.verdict}
    if np.isfinite(shown.pan_rad):
        facts.update(
            pan_rad=round(shown.pan_rad, 6),
            tilt_rad=round(shown.tilt_rad, 6),
            off_rad=rounded(shown.off_rad, 6),
            sigma_rad=rounded(shown.sigma_rad, 6),
            allowed_rad=rounded(shown.allowed_rad, 6),
            off_px=round(shown.off_px, 2),
        )
    return facts | {"patches": [shown.agreeing, shown.expected]}


def _contradiction(shown: ShownView, before: Posed, after: Posed) -> str:
    """Say what an image shows instead of what it should."""
    expected = f"pan {after.pan_rad:.3f}, tilt {after.tilt_rad:.3f} rad"
    if shown.verdict == "unlike":
        return (
            f"the picture shows nothing of what {shown.expected} places of the picture before should show at "
            f"{expected}: joints and pictures contradict each other"
        )
    off_rad = np.array([shown.pan_rad, shown.tilt_rad]) - np.array(before.angles_rad)
    why = ", that of before the move" if (np.abs(off_rad) <= np.array(shown.allowed_rad)).all() else ""
    return (
        f"the picture shows the view of pan {shown.pan_rad:.3f}, tilt {shown.tilt_rad:.3f} rad{why}, not of "
        f"{expected} ({shown.off_px:.0f} px off): joints and pictures contradict each other"
    )


def _best(found: Sequence[PatchMatch]) -> PatchMatch:
    """The good match of several, else the one that came nearest to one."""
    ranks = {"good": 0, "ambiguous": 1, "flat": 2, "weak": 3, "border": 4}
    return min(found, key=lambda one: (ranks[one.verdict], -one.correlation))


def _good(found: PatchMatch, view: CameraView, advice: str = "") -> PatchMatch:
    """Pass a good match. Raises PointingError with the verdict in its code."""
    if found.verdict == "good":
        return found
    code = "target_not_found" if found.verdict == "weak" else f"target_{found.verdict}"
    message = f"the target is not found in the image of {view.frame.camera}: {found.reason}{advice}"
    raise PointingError(code, message)

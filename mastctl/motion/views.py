"""New images and what they show: frames of a resting head, the clicked thing found again in them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.partner import StereoMatch, find_partner
from calib.matching.patch import match_patch
from calib.matching.sweep import UP
from calib.matching.verdict import MatchSettings, PatchMatch
from calib.matching.warp import Plane, PosedImage, Relief, carry, facing_plane, grey
from drivers.errors import DriverError
from mastctl.devices.frames import StampedFrame
from mastctl.devices.joint_history import HeadReading
from mastctl.motion.head import DevicesLike
from mastctl.motion.results import PointingError, rounded
from mastctl.motion.settings import PointingSettings

BESIDE = "; try a pixel beside it"
"""To a person who clicked: at a rim or on bare ground a neighbour may match."""


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
    """The cameras during one request; all geometry by the mast file and the true joint angles measured.

    ``check`` is called while images are waited for, and ends the wait by raising.
    """

    def __init__(
        self,
        devices: DevicesLike,
        rig: Rig,
        settings: PointingSettings,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        self.settings = settings
        self._devices = devices
        self._rig = rig
        self._check = check

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
        if partner is not None and self._sees(partner, position_m, resting):
            return (partner,)
        pairs = sorted(self._rig.stereo.values(), key=lambda pair: clicked not in pair)
        for pair in pairs:
            if aiming not in pair and all(self._sees(name, position_m, resting) for name in pair):
                return pair
        return ()

    def new(
        self, names: Sequence[str], after_s: float, resting: HeadReading, timeout_s: float | None = None
    ) -> dict[str, CameraView]:
        """Return frames exposed after a moment, by a head that rests where it was read.

        ``timeout_s`` is that of the settings by default.

        Raises PointingError ``head_moving`` if the head moved in an exposure or is not where it rested;
        DriverError if a frame does not come, or cannot be used.
        """
        views = {}
        timeout_s = self.settings.frame_timeout_s if timeout_s is None else timeout_s
        for name, frame in self._devices.frames(names, after_s, timeout_s, self._check).items():
            if frame.exposure_began_s < after_s:
                early_s = after_s - frame.exposure_began_s
                raise PointingError(
                    "no_fresh_frame", f"an image of {name} was exposed {early_s:.3f} s too early"
                )
            apart = max(abs(frame.pan_rad - resting.pan_rad), abs(frame.tilt_rad - resting.tilt_rad))
            if frame.moving or not apart <= self.settings.rest_tolerance_rad:
                where = f"an image of {name} was exposed ({apart:.4f} rad off its rest)"
                raise PointingError("head_moving", f"the head moved while {where}")
            views[name] = self.view(frame)
        return views

    def some(
        self,
        names: Sequence[str],
        after_s: float,
        resting: HeadReading,
        needed: Sequence[str] = (),
        timeout_s: float | None = None,
    ) -> tuple[dict[str, CameraView], dict[str, str]]:
        """Return frames as `new` of those cameras that give one, and why another gives none.

        Raises what `new` does of a camera that is ``needed``, and of the head.
        """
        missing: dict[str, str] = {}
        while left := [name for name in names if name not in missing]:
            try:
                return self.new(left, after_s, resting, timeout_s), missing
            except DriverError as error:
                if error.device not in left or error.device in needed:
                    raise
                missing[error.device] = " ".join(str(error).split())
        return {}, missing

    def again(self, view: CameraView, pixel_px: FloatArray, now: CameraView) -> PatchMatch:
        """Find a clicked pixel in a new frame of the same camera, before its range is known.

        Raises PointingError ``not_in_view`` if the head has turned away since, ``target_...`` if the match is
        not good.
        """
        settings = self.settings
        turned = max(
            abs(view.frame.pan_rad - now.frame.pan_rad), abs(view.frame.tilt_rad - now.frame.tilt_rad)
        )
        planes = [_plane_at(view.camera, pixel_px, range_m) for range_m in (1.0, 2.0, 1e3)]
        if turned <= settings.same_pose_rad:
            return _good(match_patch(view, pixel_px, planes[1], now, 12.0, settings.match), now)
        places = np.array([carry(pixel_px, view.camera, plane, now.camera)[0] for plane in planes])
        size = np.array(now.camera.size_px)
        if not np.isfinite(places).all() or (places[1] < 0).any() or (places[1] > size - 1).any():
            raise PointingError(
                "not_in_view",
                f"the head has turned by {turned:.3f} rad since the clicked image of {view.frame.camera}: "
                "the pixel is out of view, click in a new image",
            )
        spread = float(np.ptp(places, axis=0).max())
        search = min(settings.wide_search_px, settings.search_px / 2 + spread)
        matches = [
            match_patch(view, pixel_px, plane, now, search, settings.match)
            for plane in (planes[1], Plane(planes[1].point_m, UP))
        ]
        return _good(_best(matches), now)

    def stereo(self, view: CameraView, pixel_px: FloatArray, other: CameraView) -> StereoMatch:
        """Find the other camera's pixel along the epipolar line.

        Raises PointingError ``target_...`` if the match is not good, ``eyes_disagree`` if it lies off the
        line.
        """
        settings = self.settings
        found = find_partner(view, pixel_px, other, settings.nearest_m, settings.match)
        if found.match.verdict in ("weak", "ambiguous", "flat"):
            raise _refusal(found.match, other, BESIDE)
        _good(found.match, other)
        if abs(found.across_px) > settings.across_px + 5.0 * found.across_sigma_px:
            raise PointingError(
                "eyes_disagree",
                f"{other.frame.camera} sees the target {found.across_px:+.2f} px off the line on which "
                f"{view.frame.camera} puts it, at most {settings.across_px:g} px is expected{BESIDE}",
            )
        return found

    def look_for(self, clicked: Clicked, now: CameraView) -> PatchMatch:
        """Find the clicked thing in a new view: near where it should be, then further around.

        Raises PointingError ``target_...`` if no match is good.
        """
        settings = self.settings
        planes = [clicked.plane, *clicked.others]
        ray = clicked.view.camera.ray(clicked.pixel_px)
        if abs(float(ray.directions @ clicked.plane.normal)) < 0.97:
            planes.append(Plane(clicked.plane.point_m, -ray.directions))  # if the slope was misjudged
        found: list[PatchMatch] = []
        for search in (settings.search_px, settings.wide_search_px):
            for plane, sizes in product(planes, self._sizes()):
                relief = clicked.relief if plane is clicked.plane else None
                found.append(match_patch(clicked.view, clicked.pixel_px, plane, now, search, sizes, relief))
                if found[-1].verdict == "good":
                    return found[-1]
            if found[0].verdict in ("flat", "ambiguous"):
                break
        return _good(_best(found), now)

    def agree(
        self, clicked: Clicked, now: CameraView, seen: PatchMatch, other: CameraView, same_pair: bool
    ) -> tuple[PatchMatch, dict[str, Any]]:
        """Find the clicked thing in the other camera too and check that both mean the same place.

        One camera alone would accept a shifted image. Compared is the place in the other one with where the
        first one's ray leads there; a wrong joint angle turns both alike and does not show.

        Returns
        -------
        match, detail
            In the other camera, and the difference across and along the epipolar line.

        Raises PointingError ``eyes_disagree`` if the other camera does not confirm the place.
        """
        settings = self.settings
        try:
            confirmed = self.look_for(clicked, other)
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
        if abs(across_px) > settings.across_px or (same_pair and abs(along_px) > settings.range_px):
            raise PointingError(
                "eyes_disagree",
                f"{now.frame.camera} and {other.frame.camera} put the target {across_px:+.2f} px across and "
                f"{along_px:+.2f} px along the epipolar line apart, at most {settings.across_px:g} px across "
                f"and {settings.range_px:g} px along is expected",
            )
        return confirmed, detail

    def _sees(self, name: str, position_m: FloatArray, resting: HeadReading) -> bool:
        """Tell whether a configured camera has a position well inside its image."""
        if name not in self._devices.newest_frames():
            return False
        camera = self._rig.camera_in_rover(name, *resting.true_rad)
        place, valid = camera.project(position_m)
        return bool(valid) and camera.holds(place, 2.0 * self.settings.match.half_px)

    def _sizes(self) -> tuple[MatchSettings, MatchSettings]:
        """Return the matching with the usual patch, and with one that may fit beside an edge."""
        usual = self.settings.match
        return usual, replace(usual, half_px=self.settings.small_half_px)

    def view(self, frame: StampedFrame) -> CameraView:
        """Return a frame with its camera. Raises PointingError ``bad_reading``."""
        if not all(map(math.isfinite, (frame.pan_rad, frame.tilt_rad, *frame.true_rad))):
            raise PointingError("bad_reading", f"frame {frame.frame_id} has no finite joint angles")
        camera = self._rig.camera_in_rover(frame.camera, *frame.true_rad)
        return CameraView(grey(frame.image), camera, frame)


def match_facts(found: PatchMatch) -> Mapping[str, Any]:
    """Return a match's numbers for a step's detail."""
    return {
        "pixel_px": rounded(found.pixel_px),
        "sigma_px": rounded(found.sigma_px),
        "correlation": round(found.correlation, 3),
        "second": round(found.second, 3),
    }


def _best(found: Sequence[PatchMatch]) -> PatchMatch:
    """Return the good match of several, else the one that came nearest to one."""
    ranks = {"good": 0, "ambiguous": 1, "flat": 2, "weak": 3, "border": 4}
    return min(found, key=lambda one: (ranks[one.verdict], -one.correlation))


def _good(found: PatchMatch, view: CameraView) -> PatchMatch:
    """Pass a good match. Raises PointingError with the verdict in its code."""
    if found.verdict == "good":
        return found
    raise _refusal(found, view)


def _refusal(found: PatchMatch, view: CameraView, advice: str = "") -> PointingError:
    code = "target_not_found" if found.verdict == "weak" else f"target_{found.verdict}"
    message = f"the target is not found in the image of {view.frame.camera}: {found.reason}{advice}"
    return PointingError(code, message)


def _plane_at(camera: CameraModel, pixel_px: FloatArray, range_m: float) -> Plane:
    """Return the facing plane at a range. Raises PointingError for a pixel without a ray."""
    try:
        return facing_plane(camera, pixel_px, range_m)
    except CalibError as error:
        raise PointingError("outside_image", str(error)) from None

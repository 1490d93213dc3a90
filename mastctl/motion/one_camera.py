"""Pointing with one camera: how far the clicked thing is was given, follows from a plane, or is not known.

What is not known is counted with (`calib.geometry.line_of_sight`): between
`NEAREST_M` and infinity at first, and less after each view from elsewhere that shows
the thing. There is no second camera that could confirm a match; instead the thing must be found near the line
on which its range can put it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from calib.geometry.covariance import stored_covariance
from calib.geometry.line_of_sight import (
    NORMAL_95,
    SeenFrom,
    Sight,
    range_to_plane,
    seen_from,
    shown,
    unknown_range,
)
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.patch import PatchMatch
from calib.matching.shown_view import FLOOR_RAD
from calib.matching.warp import Plane, facing_plane
from mastctl.devices.keep_out import Pair
from mastctl.motion.measurement import ACROSS_PX, CameraView, Clicked, RigCameras, rounded
from mastctl.motion.requests import PointingError, PointRequest
from mastctl.motion.steps import FoundAgain

NEAREST_M = 1.0
"""A thing of unknown range is assumed at this or farther, in 95 of 100: nearer than a mast's camera has the
ground only looking straight down."""
PIXEL_SIGMA_PX = 0.2
"""Of a pixel for a position's covariance: noise and calibration. What the match shows is added."""
RangeFrom = Literal["given", "plane", "parallax", "unknown"]
TRIED_SIGMAS = (1.0, -1.0, 2.0)
"""Beside the likeliest range, where a thing of unknown range is searched: nearer, farther, nearer still."""
KNOWN_SHARE = 0.5
"""Parallax has shown a range when it left less than this part of the sigma that nothing else leaves."""


class OneCamera:
    """What one camera knows of a target: the newest line of ``sight``, and what says how far the target is.

    Raises CalibError if the clicked pixel does not meet the plane that it is said to lie in, or has no ray.
    """

    def __init__(self, rig: Rig, sigma_rad: Pair, found: FoundAgain, request: PointRequest) -> None:
        self._rig = rig
        self._sigma_rad = sigma_rad
        self._calibration = stored_covariance(rig)
        camera, joints = found.view.frame.camera, found.view.frame.true_rad
        pixel, now = found.clicked_px, found.now
        self.range_from: RangeFrom = "unknown"
        inverse, sigma = self._unknown = unknown_range(NEAREST_M)
        if request.range_m is not None:
            self.range_from, inverse, sigma = "given", 1.0 / request.range_m, 0.0
        elif request.plane is not None:
            point, normal = np.array(request.plane.point_m), np.array(request.plane.normal)
            away_m = range_to_plane(rig, camera, joints, pixel, point, normal)
            self.range_from, inverse, sigma = "plane", 1.0 / away_m, 0.0
        self.sight = Sight(camera, joints, pixel, inverse, sigma)
        self._plane = request.plane
        self.learn(now, found.pixel_px, found.sigma_px, self.expected(now))

    @property
    def position_m(self) -> FloatArray:
        """The likeliest place of the target, (3,), rover frame."""
        return self.sight.position_m(self._rig)

    def facts(self) -> Mapping[str, Any]:
        """Return what is known of the range, for a step's detail."""
        near, far = self.sight.range_interval_m
        return {
            "range_from": self.range_from,
            "range_m": round(self.sight.range_m, 5),
            "range_interval_m": [round(near, 5), None if far is None else round(far, 5)],
            "position_m": rounded(self.position_m, 5),
        }

    def clicked(self, found: FoundAgain) -> Clicked:
        """Return the clicked thing with the surfaces that it may lie on."""
        view, pixel = found.view, found.clicked_px
        if self._plane is not None:
            plane = Plane(np.array(self._plane.point_m), np.array(self._plane.normal))
            facing = facing_plane(view.camera, pixel, self.sight.range_m)
            return Clicked(view, pixel, plane, (facing,))
        near, sigma = self.sight.inverse_m, self.sight.inverse_sigma_m
        ranges_m = [self.sight.range_m]
        if sigma > 0.0:
            ranges_m += [1.0 / max(near + by * sigma, 1e-3) for by in TRIED_SIGMAS]
        plane, *others = (facing_plane(view.camera, pixel, range_m) for range_m in ranges_m)
        return Clicked(view, pixel, plane, tuple(others))

    def expected(self, now: CameraView) -> SeenFrom:
        """Return where a new view should show the target. Raises CalibError if it cannot."""
        return seen_from(
            self._rig,
            self.sight,
            now.frame.camera,
            now.frame.true_rad,
            sigma_px=PIXEL_SIGMA_PX,
            sigma_rad=self._sigma_rad,
            calibration=self._calibration,
        )

    def find(self, cameras: RigCameras, clicked: Clicked, now: CameraView) -> PatchMatch:
        """Find the clicked thing in a new view. Raises PointingError as `RigCameras.find`."""
        try:
            return cameras.find(clicked, now)
        except PointingError as error:
            if self.range_from != "unknown" or not error.code.startswith("target_"):
                raise
            message = f"{error}; how far it is was not known: give range_m or a plane"
            raise PointingError(error.code, message) from None

    def predicted(self, seen: PatchMatch, expected: SeenFrom) -> dict[str, Any]:
        """Return how sure the prediction of a view was, for its pointing."""
        match_px = float(seen.sigma_px.max())
        known = expected.whole_px2(self.sight.inverse_sigma_m) + match_px**2 * np.eye(2)
        sigma_px = np.sqrt(np.diag(known))
        return {"predicted_sigma_px": sigma_px.tolist(), "predicted_covariance_px2": known.tolist()}

    def check(self, now: CameraView, seen: PatchMatch, expected: SeenFrom) -> dict[str, float]:
        """Pass a match that lies where the range can put it; return how far off, for the record.

        Raises PointingError ``off_the_line``.
        """
        reach = NORMAL_95 * 1.5 * self.sight.inverse_sigma_m
        low, high = max(-reach, -self.sight.inverse_m), reach
        along, off = expected.along_px_m, seen.pixel_px - expected.pixel_px
        length2 = float(along @ along)
        at = min(max(float(off @ along) / length2, low), high) if length2 > 0.0 else 0.0
        beside_px = float(np.linalg.norm(off - at * along))
        model = now.camera
        focal_px = model.focal_px[0]
        most_px = ACROSS_PX + FLOOR_RAD * focal_px
        if beside_px > most_px:
            raise PointingError(
                "off_the_line",
                f"{now.frame.camera} finds the target's likeness {beside_px:.1f} px from where its "
                f"range can put it, at most {most_px:.1f} px is expected",
            )
        return {"beside_px": round(beside_px, 3)}

    def learn(self, now: CameraView, pixel_px: FloatArray, sigma_px: float, expected: SeenFrom) -> None:
        """Take what a view has shown. Raises CalibError."""
        before = self.sight
        self.sight = shown(
            self._rig, before, now.frame.camera, now.frame.true_rad, pixel_px, expected, sigma_px
        )
        if self.range_from == "unknown" and self.sight.inverse_sigma_m < KNOWN_SHARE * self._unknown[1]:
            self.range_from = "parallax"

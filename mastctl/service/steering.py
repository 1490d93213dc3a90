"""Requests to point and to follow: judged against the mast file in use, then begun."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

from drivers.clock import Clock
from mastctl.answers import Preview
from mastctl.control.operations import Operation, OperationRunner
from mastctl.devices.devices import Devices
from mastctl.devices.frames import check_known
from mastctl.devices.judge import Limits
from mastctl.drift.watch import DriftWatch
from mastctl.errors import NoLonger, NotNow, Stopped
from mastctl.motion.loop import REPEAT_AFTER_S, PointingLoop
from mastctl.motion.requests import (
    PixelTarget,
    PointRequest,
    TrackRequest,
    aim_of,
    check_pair,
    clicked_frame,
)
from mastctl.motion.track import ACTIVE, RoverPose, Tracker
from mastctl.panorama.panoramas import Panoramas
from mastctl.service.masts import Masts

R = TypeVar("R", bound=TrackRequest)

LOOKS_S = 120.0  # a pointing's images, each of which may be waited for
MARGIN_S = 15.0
CLICK_AGE_S = 300.0  # a person may look at an image for minutes before clicking; the sun moves meanwhile


def usual_s(limits: Limits, looks: int) -> float:
    """Return how long an operation is given that moves the head, seconds, if its request does not say.

    Each move has its own deadline, from distance over speed; this one is behind those: ``looks`` times the
    longest way within the limits, one axis after the other, and its images; 0 for a move without an image.
    """
    way_rad = sum(high - low for low, high in (limits.pan_rad, limits.tilt_rad))
    way_s = way_rad / limits.speed_rad_per_s
    return max(1, looks) * way_s + looks * LOOKS_S + MARGIN_S


class Steering:
    """Where the head is sent, and the target that it follows; safe to use from any thread.

    ``masts`` keeps the mast file the same while a request is judged and begun; ``rig`` is its part that is
    configured; ``drift`` gets each pointing's end. ``repeat_after_s``:
    `mastctl.motion.loop.REPEAT_AFTER_S` of another length; None for that.
    """

    def __init__(
        self,
        masts: Masts,
        devices: Devices,
        clock: Clock,
        operations: OperationRunner,
        tracker: Tracker,
        drift: DriftWatch,
        panoramas: Panoramas,
        repeat_after_s: float | None = None,
    ) -> None:
        self._panoramas = panoramas
        self._masts = masts
        self._devices = devices
        self._clock = clock
        self._operations = operations
        self._tracker = tracker
        self._drift = drift
        self._repeat_after_s = REPEAT_AFTER_S if repeat_after_s is None else repeat_after_s

    def point(self, request: PointRequest) -> Operation:
        """Start a pointing operation and return its first record.

        Raises NotKnown, NoLonger, BadRequest if camera, frame, pixel or joint angles do not fit this rig;
        NotNow if the frame is of another mast file, head or rover moved since, or as
        `mastctl.control.operations.OperationRunner.start`.
        """
        recorded = request.model_dump(exclude_none=True)
        clicked = None if request.panorama is None else self._panoramas.seen(request.panorama)
        with self._masts.unchanged() as mast:
            view_rad = None
            if clicked is not None:
                request, view_rad = self._panoramas.pointed(request, clicked[0], clicked[1][0])
                recorded |= {} if request.pixel is None else {"pixel": request.pixel}
            request = self._in_rover(request)
            self._check(request, clicked is not None)
            loop = self._loop()

            def run(record: Callable[[Any], None], cancelled: threading.Event) -> Any:
                with self._devices.exposure_fixed():
                    return loop(record, cancelled).run(request, view_rad)

            return self._operations.start(recorded, run, partial(self._drift.ended, mast.stored))

    def preview(self, request: PointRequest, cancelled: threading.Event) -> Preview:
        """Return what a pixel of a named frame shows and where the head would go; nothing moves.

        Raises as `point` and `mastctl.motion.loop.PointingLoop.preview`.
        """
        target = request.panorama
        if target is not None:
            seen, frames = self._panoramas.seen(target)
            self._check_rover_stands(frames[0].camera, self._panoramas.began_s(target.id))
        with self._masts.unchanged():
            if target is not None:
                request, _ = self._panoramas.pointed(request, seen, frames[0])
            self._check(request, target is not None)
            loop = self._loop()(lambda step: None, cancelled)
        if target is None:
            return loop.preview(request)
        return loop.preview_kept(
            request, frames[:1] if target.by_direction else frames, seen.pixel_px, seen.range_m
        )

    def start_track(self, request: TrackRequest) -> Operation:
        """Begin to follow what a pixel shows, or what is seen at a position; return the start's record.

        Raises as `point`; NotNow ``busy`` also while a track runs.
        """
        recorded = {"track": request.model_dump(exclude_none=True)}
        with self._masts.unchanged():
            request = self._in_rover(request)
            if request.pixel is not None:
                check_known(request.pixel.camera, self._masts.in_use.rig.cameras)
                check_pair(request.pixel.camera, self._masts.in_use.rig, self._masts.in_use.stored.rig)
                self._check_digest(request.pixel)
                self._check_pixel(request.pixel)
            return self._tracker.start(request, recorded)

    def look(self) -> Operation:
        """Look for the track's target once more and return the look's first record.

        Raises as `mastctl.motion.track.Tracker.look`.
        """
        with self._masts.unchanged():
            return self._tracker.look()

    def take_pose(self, pose: RoverPose, look: bool) -> str | None:
        """Take the rover's pose; return the id of the look that follows, if one does.

        Raises as `mastctl.motion.track.Tracker.take_pose`.
        """
        if look:
            self._operations.let_stopped_end()
        running = self._tracker.status.operation
        try:
            with self._masts.unchanged():
                return self._tracker.take_pose(pose, look, self._turn_sun)
        finally:
            ended = self._tracker.status
            if running is not None and ended.state not in ACTIVE:
                self._operations.end(running, Stopped(ended.reason))

    def _turn_sun(self, pose: RoverPose) -> None:
        """Keep the sun of the site frame out as it is from a pose."""
        self._devices.judge.rover_stands(pose.site_from_rover.inverse.rotation)

    def _loop(self) -> Callable[[Callable[[Any], None], threading.Event], PointingLoop]:
        """Return what makes a pointing by the mast file of now."""
        rig, wait_s = self._masts.in_use.rig, self._repeat_after_s
        return partial(PointingLoop, rig, self._devices, self._clock, repeat_after_s=wait_s)

    def _in_rover(self, request: R) -> R:
        """Return a request in the rover frame of now; before a pose, site and rover are one."""
        pose = self._tracker.pose
        return request if pose is None else request.in_rover(pose.site_from_rover)

    def _check(self, request: PointRequest, of_panorama: bool) -> None:
        """Refuse a request that does not fit the mast file in use; see `point`."""
        if request.pixel is not None:
            self._check_digest(request.pixel)
            if not of_panorama:
                self._check_pixel(request.pixel)
        if request.angles_rad is not None:
            self._devices.judge.check_goal(*request.angles_rad)
        if request.aim is not None:
            aim_of(request, self._masts.in_use.rig)

    def _check_digest(self, target: PixelTarget) -> None:
        taken_with, in_use = target.mast_digest, self._masts.in_use.stored.digest
        if taken_with not in (None, in_use):
            message = (
                f"the pixel was taken with mast file {taken_with:.8}..., the one in use is {in_use:.8}..."
            )
            raise NotNow("other_mast_file", message)

    def _check_pixel(self, target: PixelTarget) -> None:
        frame = clicked_frame(target, self._masts.in_use.rig, self._devices.store.by_id)
        age_s = self._clock.now_s() - frame.mid_exposure_s
        if age_s > CLICK_AGE_S:
            message = f"frame {frame.frame_id} is {age_s:.0f} s old, at most {CLICK_AGE_S:.0f} s is allowed"
            raise NoLonger("frame_too_old", message)
        self._devices.store.publish(frame)  # kept until it has been found again, however many are watched
        self._check_rover_stands(frame.camera, frame.exposure_began_s)

    def _check_rover_stands(self, camera: str, exposure_began_s: float) -> None:
        """Refuse an image of another place of the rover. Raises NotNow ``rover_moved``."""
        moved_s = self._tracker.moved_s
        if moved_s is not None and exposure_began_s < moved_s:
            message = f"the rover moved since this image of {camera} was exposed; take another"
            raise NotNow("rover_moved", message)

"""Requests to point and to follow: judged against the mast file in use, then begun."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from calib.geometry.rig import Rig
from drivers.clock import Clock
from mastctl.control.operations import OperationRunner
from mastctl.control.records import Operation
from mastctl.devices.devices import Devices
from mastctl.devices.frames import check_known
from mastctl.devices.limits import Limits
from mastctl.errors import NotNow
from mastctl.motion.loop import PointingLoop
from mastctl.motion.requests import (
    AnglesTarget,
    PixelTarget,
    PointRequest,
    PositionTarget,
    aim_of,
    check_pair,
    clicked_frame,
)
from mastctl.motion.results import Preview
from mastctl.motion.settings import PointingSettings
from mastctl.motion.track import ACTIVE, RoverPose
from mastctl.motion.tracker import Tracker
from mastctl.service.masts import Masts
from mastctl.watch.residuals import CalibrationHealth

LOOKS_S = 120.0  # a pointing's pictures, each of which may be waited for
MARGIN_S = 15.0
CLICK_AGE_S = 300.0  # a person may look at a picture for minutes before clicking; the sun moves meanwhile


def usual_s(limits: Limits, looks: int) -> float:
    """Return how long an operation is given that moves the head, seconds, if it asks for no time of its own.

    Each move has its own deadline, from distance over speed; this one is behind those.

    Parameters
    ----------
    limits
        The longest way there is, one axis after the other, and the speed.
    looks
        How often it goes there and looks; 0 for a move without a picture.
    """
    way_rad = sum(high - low for low, high in (limits.pan_rad, limits.tilt_rad))
    way_s = way_rad / limits.speed_rad_per_s
    return max(1, looks) * way_s + looks * LOOKS_S + MARGIN_S


class Steering:
    """Where the head is sent, and what it follows; safe to use from any thread.

    Parameters
    ----------
    masts
        The mast file in use, which stays the same while a request is judged and begun.
    rig
        Its part that this daemon can see with.
    devices, clock
        The head and the cameras, and what stamps them.
    operations, tracker
        What runs, and what is followed.
    health
        Is told of each pointing's end.
    repeat_after_s
        Of pointings, as `mastctl.motion.settings.PointingSettings` has it; None for its default.
    """

    def __init__(
        self,
        masts: Masts,
        rig: Rig,
        devices: Devices,
        clock: Clock,
        operations: OperationRunner,
        tracker: Tracker,
        health: CalibrationHealth,
        repeat_after_s: float | None = None,
    ) -> None:
        self._masts = masts
        self._devices = devices
        self._clock = clock
        self._operations = operations
        self._tracker = tracker
        self._health = health
        self.repeat_after_s = repeat_after_s
        self.use_rig(rig)

    def use_rig(self, rig: Rig) -> None:
        """Point by another mast file, and by what is set now, from now on."""
        self._rig = rig
        settings = PointingSettings()
        if self.repeat_after_s is not None:
            settings = replace(settings, repeat_after_s=self.repeat_after_s)
        self._loop = PointingLoop(rig, self._devices, self._devices.door.limits, self._clock, settings)

    def point(self, request: PointRequest, told: Mapping[str, Any]) -> Operation:
        """Start a pointing operation and return its first record.

        Parameters
        ----------
        request
            What to point at.
        told
            The request as it came, for the record.

        Raises
        ------
        NotKnown, NoLonger, BadRequest
            If camera, frame, pixel or joint angles do not fit this rig.
        NotNow
            If the frame is of another mast file, head or rover moved since, or what
            `mastctl.control.operations.OperationRunner.start` says stands against it.
        """
        with self._masts.unchanged() as mast:
            if isinstance(request.target, PositionTarget):
                request = replace(request, target=self._in_rover(request.target))
            self._check(request)
            loop = self._loop

            def run(record: Callable[[Any], None], cancelled: threading.Event) -> Any:
                with self._devices.exposure_held():
                    return loop.run(request, record, cancelled)

            return self._operations.start(told, run, partial(self._health.ended, mast.stored))

    def preview(self, request: PointRequest, cancelled: threading.Event) -> Preview:
        """Return what a pixel of a named frame shows and where the head would go; nothing moves.

        Raises
        ------
        NotKnown, NoLonger, BadRequest, NotNow
            As `point`.
        MastctlError, DriverError, CalibError
            As `mastctl.motion.loop.PointingLoop.preview`.
        """
        with self._masts.unchanged():
            self._check(request)
            loop = self._loop
        return loop.preview(request, cancelled)

    def start_track(self, target: PixelTarget | PositionTarget, told: Mapping[str, Any]) -> Operation:
        """Begin to follow what a pixel shows, or what is seen at a position; return the start's record.

        Raises
        ------
        NotKnown, NoLonger, BadRequest, NotNow
            As for `point`; ``busy`` also while a track runs.
        """
        with self._masts.unchanged():
            if isinstance(target, PositionTarget):
                target = self._in_rover(target)
            if isinstance(target, PixelTarget):
                check_known(target.camera, self._rig.cameras)
                check_pair(target.camera, self._rig, self._masts.in_use.stored.rig)
            self._check(PointRequest(target))
            return self._tracker.start(target, told)

    def look(self) -> Operation:
        """Look for the track's target once more and return the look's first record.

        Raises
        ------
        NotNow, Unable
            As `mastctl.motion.tracker.Tracker.look`.
        """
        with self._masts.unchanged():
            return self._tracker.look()

    def take_pose(self, pose: RoverPose, look: bool) -> str | None:
        """Take where the rover stands; return the id of the look that follows, if one does.

        Raises
        ------
        BadRequest, NotNow
            As `mastctl.motion.tracker.Tracker.take_pose`.
        """
        if look:
            self._operations.let_stopped_end()
        running = self._tracker.status.operation
        with self._masts.unchanged():
            begun = self._tracker.take_pose(pose, look, self._stands)
        ended = self._tracker.status
        if running is not None and ended.state not in ACTIVE:
            self._operations.end_stopped(running, ended.reason)
        return begun

    def _stands(self, pose: RoverPose) -> None:
        """Have the sun of the site frame kept out by a pose."""
        self._devices.door.rover_stands(pose.site_from_rover.inverse.rotation)

    def _check(self, request: PointRequest) -> None:
        """Refuse a request that does not fit the mast file in use; see `point`."""
        target = request.target
        if isinstance(target, PixelTarget):
            self._check_pixel(target)
        if isinstance(target, AnglesTarget):
            self._devices.door.check_goal(target.pan_rad, target.tilt_rad)
        if request.aim is not None:
            aim_of(request, self._rig)

    def _check_pixel(self, target: PixelTarget) -> None:
        stored = self._masts.in_use.stored
        taken_with, in_use = target.mast_digest, stored.digest
        if taken_with not in (None, in_use):
            words = f"the pixel was taken with mast file {taken_with:.8}..., the one in use is {in_use:.8}..."
            raise NotNow("other_mast_file", words)
        find = partial(self._devices.frame_by_id, max_age_s=CLICK_AGE_S)
        frame = clicked_frame(target, self._rig, find)
        self._devices.hold(frame)  # until it has been found again, however many pictures somebody watches
        moved_s = self._tracker.moved_s
        if moved_s is not None and frame.exposure_began_s < moved_s:
            words = f"the rover moved since this image of {target.camera} was exposed; take another"
            raise NotNow("rover_moved", words)

    def _in_rover(self, target: PositionTarget) -> PositionTarget:
        """A position in the rover frame of now; before the first pose that is the site frame."""
        pose = self._tracker.pose
        if target.frame != "site" or pose is None:
            return target
        x, y, z = pose.site_from_rover.inverse.points(np.array(target.position_m)).tolist()
        return PositionTarget((x, y, z), "rover")

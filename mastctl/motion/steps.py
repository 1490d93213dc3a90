"""The steps that a pointing and a track's look have in common, each with its entry in the record."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.verdict import PatchMatch
from drivers.clock import Clock
from mastctl.devices.joint_history import HeadReading
from mastctl.devices.keep_out import Pair
from mastctl.devices.limits import Limits
from mastctl.errors import NotNow
from mastctl.motion.evidence import MotionSeen, apart, repeated
from mastctl.motion.head import DevicesLike, SteeredHead
from mastctl.motion.requests import PixelTarget, clicked_frame
from mastctl.motion.results import Step, counts_left, rounded
from mastctl.motion.settings import PointingSettings
from mastctl.motion.views import CameraView, Clicked, RigCameras, match_facts


@dataclass(frozen=True, eq=False)
class FoundAgain:
    """A clicked thing, found again in new images.

    Attributes
    ----------
    view, clicked_px
        The named frame, and the pixel (2,) that was clicked in it.
    now, other
        New images of the clicked camera and of its partner; None where one camera points alone.
    pixel_px, sigma_px
        (2,) the thing in ``now``, and one sigma of either coordinate.
    resting
        The head while they were taken.
    """

    view: CameraView
    clicked_px: FloatArray
    now: CameraView
    other: CameraView | None
    pixel_px: FloatArray
    sigma_px: float
    resting: HeadReading


class Steps:
    """Head and cameras during one request.

    Parameters
    ----------
    rig
        The part of the mast file in use that is configured.
    limits
        For the choice among solutions; ``devices`` checks them again, and knows what is kept out.
    clock
        The clock that stamps readings and frames.
    record
        Gets each step when it ends.
    cancelled
        Set by a stop; the request ends with PointingError ``stopped`` soon after.

    Attributes
    ----------
    last
        The step that was begun last.
    pointing
        Which pointing of the request the next steps belong to; the record names the second and later ones.
    motion_evidence
        What the last look's images say about the move before it, by camera (`MotionSeen`).
    """

    def __init__(
        self,
        rig: Rig,
        devices: DevicesLike,
        limits: Limits,
        clock: Clock,
        settings: PointingSettings,
        record: Callable[[Step], None],
        cancelled: threading.Event,
    ) -> None:
        self.head = SteeredHead(devices, limits, clock, settings, cancelled)
        self.cameras = RigCameras(devices, rig, settings, self.head.check_not_stopped)
        self.last = "request"
        self.pointing = 1
        self.motion_evidence: Mapping[str, Mapping[str, Any]] = {}
        self._motion_seen = MotionSeen(rig, settings.view)
        self._rig = rig
        self._devices = devices
        self._limits = limits
        self._clock = clock
        self._settings = settings
        self._record = record

    @contextmanager
    def step(self, name: str) -> Iterator[dict[str, Any]]:
        """Record what happens inside as one step; a request that was stopped does not begin it.

        The dict becomes the step's detail. A failed step gets the error's code and message too, and the error
        goes on.
        """
        self.last = name
        started_s = self._clock.now_s()
        detail: dict[str, Any] = {"pointing": self.pointing} if self.pointing > 1 else {}
        try:
            self.head.check_not_stopped()
            yield detail
        except BaseException as error:
            detail.update(code=getattr(error, "code", "internal"), message=" ".join(str(error).split()))
            self._record(Step(name, "failed", started_s, self._clock.now_s() - started_s, detail))
            raise
        self._record(Step(name, "done", started_s, self._clock.now_s() - started_s, detail))

    def rest(self) -> HeadReading:
        """Return the reading of a head that rests. Raises PointingError, DriverError."""
        with self.step("rest") as detail:
            resting = self.head.resting()
            detail.update(_angles(resting))
        return resting

    def clicked(self, target: PixelTarget, alone: bool = False) -> FoundAgain:
        """Take a fresh pair, or the clicked camera's image ``alone``, and find in it what was clicked.

        Raises MastctlError, DriverError if camera, frame or pixel do not fit (`clicked_frame`), or the thing
        is not found.
        """
        view = self.cameras.view(clicked_frame(target, self._rig, self._devices.frame_by_id))
        pixel = np.array([target.x_px, target.y_px])
        partner = None if alone else self.cameras.partner(target.camera)
        cameras = (target.camera,) if partner is None else (target.camera, partner)
        resting = self.rest()
        with self.step("frames") as detail:
            fresh = self.cameras.new(cameras, self._clock.now_s(), resting)
            now, other = fresh[target.camera], None if partner is None else fresh[partner]
            detail.update(frame_ids=[fresh[name].frame.frame_id for name in cameras])
            detail.update(apart(now, [] if other is None else [other]))
            self._motion_seen.remember(fresh)
            if view.frame.mast_digest != now.frame.mast_digest:
                message = f"frame {target.frame_id} was taken with another mast file"
                raise NotNow("other_mast_file", message)
        with self.step("target") as detail:
            again = self.cameras.again(view, pixel, now)
            detail.update(match_facts(again))
        return FoundAgain(view, pixel, now, other, again.pixel_px, float(again.sigma_px.max()), resting)

    def go_to_true(self, pan_rad: float, tilt_rad: float, camera: str) -> tuple[Pair, HeadReading]:
        """Go to true angles, as `go` does; return the readings that were commanded, and the arrival."""
        goal = self._devices.goal((pan_rad, tilt_rad), self.head.read())
        return goal, self.go(*goal, camera)

    def go(self, pan_rad: float, tilt_rad: float, camera: str | None = None) -> HeadReading:
        """Check the limits, move until the head reads the angles, wait until settled; return the reading.

        Where the head knows its counts, the record says what these leave, in pixels of ``camera``.

        Raises OutsideLimits, KeptOut, PointingError, Stopped, DriverError if the angles may not be commanded
        or are not reached.
        """
        with self.step("limits") as detail:
            detail.update(pan_rad=pan_rad, tilt_rad=tilt_rad)
            self._limits.check(pan_rad, tilt_rad)
            self.head.check_goal(pan_rad, tilt_rad)
        with self.step("move") as detail:
            allowed_s = self.head.time_allowed_s(pan_rad, tilt_rad)
            detail.update(pan_rad=pan_rad, tilt_rad=tilt_rad, allowed_s=round(allowed_s, 3))
            begun_s = self._clock.now_s()
            self.head.send(pan_rad, tilt_rad)
        with self.step("settle") as detail:
            settled = self.head.arrived(pan_rad, tilt_rad, begun_s + allowed_s)
            model = None if camera is None else self._rig.cameras[camera].model
            detail.update(_angles(settled), **counts_left(self._devices, settled.tilt_rad, model))
            detail.update(count_rad=dict(self._devices.counts_rad))
        return settled

    def before(
        self,
        cameras: Sequence[str],
        goal_rad: Pair,
        needed: Sequence[str] = (),
        timeout_s: float | None = None,
    ) -> None:
        """Take images to compare with after a move, where there are none yet and they will show something.

        ``goal_rad`` are the true angles that it leads to. A camera that gives none is left out, and named in
        the record, unless it is ``needed``.

        Raises PointingError, DriverError if a needed one gives none, or the head does not answer; nothing has
        moved.
        """
        configured = self._devices.newest_frames()
        known = [name for name in cameras if name in configured]
        lacking = self._motion_seen.lacking(known, self.head.read().true_rad, goal_rad)
        if not lacking:
            return
        with self.step("before") as detail:
            began_s, resting = self._clock.now_s(), self.head.resting()
            views, missing = self.cameras.some(lacking, began_s, resting, needed, timeout_s)
            if views:
                detail.update(frame_ids=[view.frame.frame_id for view in views.values()])
                self._motion_seen.remember(views)
            if missing:
                detail.update(missing=missing)

    def look(self, cameras: Sequence[str], settled: HeadReading) -> dict[str, CameraView]:
        """Take new images, exposed after the head had settled, that moved as the head did.

        Raises PointingError, DriverError if none come; `BadFrame` if one shows another view than the joints
        say.
        """
        with self.step("look") as detail:
            views = self.cameras.new(cameras, settled.time_s, settled)
            first, *others = views.values()
            detail.update(frame_ids=[view.frame.frame_id for view in views.values()], **apart(first, others))
            self._motion_seen.check(views, detail)
            self.motion_evidence = detail["motion_evidence"]
        return views

    def repeated(
        self, clicked: Clicked, first: CameraView, seen: PatchMatch, settled: HeadReading, aim_px: FloatArray
    ) -> tuple[CameraView, PatchMatch]:
        """Measure once more in a later image (`mastctl.motion.evidence.repeated`); return what counts.

        That is what the later image shows; the first one's, if the settings want no second.
        """
        if not self._settings.repeat_after_s:
            return first, seen
        with self.step("repeat") as detail:
            self.head.watch_until(first.frame.exposure_began_s + self._settings.repeat_after_s)
            later, again, proven = repeated(self.cameras, clicked, first, seen, settled)
            name = first.frame.camera
            detail.update(camera=name, frame_ids=[later.frame.frame_id], **match_facts(again))
            detail.update(residual_px=rounded(again.pixel_px - aim_px), **proven)
            self.motion_evidence = {**self.motion_evidence, name: {**self.motion_evidence[name], **proven}}
        return later, again


def _angles(reading: HeadReading) -> dict[str, float]:
    """Where the head is, for a step's detail: as read, and truly."""
    true_pan_rad, true_tilt_rad = reading.true_rad
    return {
        "pan_rad": reading.pan_rad,
        "tilt_rad": reading.tilt_rad,
        "true_pan_rad": true_pan_rad,
        "true_tilt_rad": true_tilt_rad,
    }

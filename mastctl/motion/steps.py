"""The steps that a pointing and a track's look have in common, each with its entry in the record."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from typing import Any, ParamSpec, Protocol, TypeVar

import numpy as np

from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.verdict import PatchMatch
from drivers.clock import Clock, deadlines_on
from drivers.errors import DriverError
from mastctl.devices.frames import StampedFrame
from mastctl.devices.joint_history import HeadReading
from mastctl.devices.keep_out import Pair
from mastctl.devices.limits import Limits
from mastctl.errors import NotNow
from mastctl.motion.evidence import MotionSeen, apart, check_one_moment, repeated
from mastctl.motion.head import SteeredHead, SteeredHeadLike, result_unless
from mastctl.motion.looking import CameraView, Clicked, FramesLike, RigCameras, match_facts
from mastctl.motion.requests import PixelTarget, clicked_frame
from mastctl.motion.results import Step, StepRecorder, counts_told, rounded
from mastctl.motion.settings import PointingSettings

P = ParamSpec("P")
T = TypeVar("T")


class DevicesLike(SteeredHeadLike, FramesLike, Protocol):
    """What the steps need of `mastctl.devices.devices.Devices`."""

    def frame_by_id(self, frame_id: str) -> StampedFrame: ...


@dataclass(frozen=True, eq=False)
class FoundAgain:
    """A clicked thing, found again in fresh pictures.

    Attributes
    ----------
    view, clicked_px
        The named frame, and the pixel (2,) that was clicked in it.
    now, other
        New pictures of the clicked camera and of its partner; None if that was not asked.
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
    """Head and eyes during one request.

    Attributes
    ----------
    head, eyes
        What the steps are made with.
    pointing
        Which pointing of the request the next steps belong to; the record names the second and later ones.
    motion_evidence
        What the last look's pictures say about the move before it, by camera (`MotionSeen`).
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
        self.eyes = RigCameras(devices, rig, settings)
        self.pointing = 1
        self.motion_evidence: Mapping[str, Mapping[str, Any]] = {}
        self._motion_seen = MotionSeen(rig, settings.view)
        self._rig = rig
        self._devices = devices
        self._limits = limits
        self._clock = clock
        self._settings = settings
        self._recorder = StepRecorder(record, clock, self.head.check_not_stopped)

    @property
    def last(self) -> str:
        """The step that was begun last."""
        return self._recorder.last

    def step(self, name: str) -> AbstractContextManager[dict[str, Any]]:
        """Record what happens inside as one step; the dict becomes its detail."""
        return self._recorder.step(name, **({"pointing": self.pointing} if self.pointing > 1 else {}))

    def unless_stopped(self, work: Callable[P, T], *args: P.args, **options: P.kwargs) -> T:
        """Return what ``work(*args, **options)`` returns, which only waits or computes and moves nothing.

        Raises
        ------
        PointingError
            ``stopped``, soon after a stop (`abandoned.LOOKED_S`), however long the work still takes.
        """
        work_of = partial(work, *args, **options)
        return result_unless(self.head.check_not_stopped, work_of, deadlines_on(self._clock))

    def rest(self) -> HeadReading:
        """Return the reading of a head that rests. Raises PointingError, DriverError."""
        with self.step("rest") as detail:
            resting = self.head.resting()
            detail.update(**_stands(resting))
        return resting

    def clicked(self, target: PixelTarget, alone: bool = False) -> FoundAgain:
        """Take a fresh pair, or the clicked camera's picture ``alone``, and find in it what was clicked.

        Raises
        ------
        MastctlError, DriverError
            If camera, frame or pixel do not fit (`clicked_frame`), or the thing is not found.
        """
        view = self.eyes.view(clicked_frame(target, self._rig, self._devices.frame_by_id))
        pixel = np.array([target.x_px, target.y_px])
        partner = None if alone else self.eyes.partner(target.camera)
        cameras = (target.camera,) if partner is None else (target.camera, partner)
        resting = self.rest()
        with self.step("frames") as detail:
            began_s = self._clock.now_s()
            fresh = self.unless_stopped(self.eyes.new, cameras, began_s, resting)
            now, other = fresh[target.camera], None if partner is None else fresh[partner]
            detail.update(frame_ids=[fresh[name].frame.frame_id for name in cameras])
            detail.update(apart(now, [] if other is None else [other]))
            self._motion_seen.remember(fresh)
            if view.frame.mast_digest != now.frame.mast_digest:
                words = f"frame {target.frame_id} was taken with another mast file"
                raise NotNow("other_mast_file", words)
        with self.step("target") as detail:
            again = self.unless_stopped(self.eyes.again, view, pixel, now)
            detail.update(match_facts(again))
        sigma_px = float(again.sigma_px.max())
        return FoundAgain(view, pixel, now, other, again.pixel_px, sigma_px, resting)

    def go_to_true(self, pan_rad: float, tilt_rad: float, camera: str) -> tuple[Pair, HeadReading]:
        """Go to true angles, as `go` does; return the readings that were commanded, and the arrival."""
        here = self.head.read()
        goal = self.head.goal((pan_rad, tilt_rad), here)
        return goal, self.go(*goal, camera)

    def go(self, pan_rad: float, tilt_rad: float, camera: str | None = None) -> HeadReading:
        """Check the limits, move until the head reads the angles, wait until settled; return the reading.

        Where the head knows its counts, the record says what these leave, in pixels of ``camera``.

        Raises
        ------
        OutsideLimits, KeptOut, PointingError, Stopped, DriverError
            If the angles may not be commanded or are not reached.
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
            detail.update(**_stands(settled))
            model = None if camera is None else self._rig.cameras[camera].model
            detail.update(counts_told(self._devices, settled.tilt_rad, model))
            detail.update(count_rad=dict(self._devices.counts_rad))
        return settled

    def before(
        self,
        cameras: Sequence[str],
        goal_rad: tuple[float, float],
        needed: Sequence[str] = (),
        timeout_s: float | None = None,
    ) -> None:
        """Take pictures to compare with after a move, where there are none yet and they will tell something.

        ``goal_rad`` are the true angles that it leads to. A camera that gives none is left out, and named in
        the record, unless it is ``needed``.

        Raises
        ------
        PointingError, DriverError
            If a needed one gives none, or the head does not answer; nothing has moved.
        """
        configured = self._devices.newest_frames()
        here = self.head.read()
        lacking = self._motion_seen.lacking(
            [name for name in cameras if name in configured], here.true_rad, goal_rad
        )
        if not lacking:
            return
        with self.step("before") as detail:
            began_s, resting, missing = self._clock.now_s(), self.head.resting(), dict[str, str]()
            while asked := [name for name in lacking if name not in missing]:
                try:
                    views = self.unless_stopped(self.eyes.new, asked, began_s, resting, timeout_s)
                except DriverError as error:
                    if error.device not in asked or error.device in needed:
                        raise
                    missing[error.device] = " ".join(str(error).split())
                    continue
                detail.update(frame_ids=[view.frame.frame_id for view in views.values()])
                self._motion_seen.remember(views)
                break
            if missing:
                detail.update(missing=missing)

    def look(self, cameras: Sequence[str], settled: HeadReading) -> dict[str, CameraView]:
        """Take new pictures, exposed after the head had settled, that moved as the head did.

        Raises
        ------
        PointingError, DriverError
            If none come; `BadFrame` if one shows another view than the joints say.
        """
        with self.step("look") as detail:
            views = self.unless_stopped(self.eyes.new, cameras, settled.time_s, settled)
            first, *others = views.values()
            detail.update(frame_ids=[view.frame.frame_id for view in views.values()], **apart(first, others))
            self._motion_seen.check(views, detail)
            self.motion_evidence = detail["motion_evidence"]
        return views

    def repeated(
        self, clicked: Clicked, first: CameraView, seen: PatchMatch, settled: HeadReading, aim_px: FloatArray
    ) -> tuple[CameraView, PatchMatch]:
        """Measure once more in a later picture, as `repeated` says; return what is to be told.

        That is what the later picture shows; the first one's, if the settings want no second.
        """
        if not self._settings.repeat_after_s:
            return first, seen
        with self.step("repeat") as detail:
            self.head.watch_until(first.frame.exposure_began_s + self._settings.repeat_after_s)
            later, again, proven = self.unless_stopped(
                repeated, self.eyes, self._settings, clicked, first, seen, settled
            )
            residual_px = rounded(again.pixel_px - aim_px)
            detail.update(camera=first.frame.camera, frame_ids=[later.frame.frame_id], **match_facts(again))
            detail.update(residual_px=residual_px, **proven)
            name = first.frame.camera
            self.motion_evidence = {**self.motion_evidence, name: {**self.motion_evidence[name], **proven}}
        return later, again

    def one_moment(
        self, view: CameraView, pixel_px: FloatArray, others: Sequence[CameraView], resting: HeadReading
    ) -> dict[str, Any]:
        """Check that pictures of several eyes serve one measurement, as `check_one_moment` says."""
        return self.unless_stopped(
            check_one_moment, self.eyes, self._settings, view, pixel_px, others, resting
        )


def _stands(reading: HeadReading) -> dict[str, float]:
    """Where the head stands, for a step's detail: as read, and truly."""
    true_pan_rad, true_tilt_rad = reading.true_rad
    return {
        "pan_rad": reading.pan_rad,
        "tilt_rad": reading.tilt_rad,
        "true_pan_rad": true_pan_rad,
        "true_tilt_rad": true_tilt_rad,
    }

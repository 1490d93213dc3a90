"""The steps that a pointing and a track's look have in common: head and cameras, each step in the record."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.geometry.pointing import Solution, ordered
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from drivers.clock import Clock
from mastctl.answers import Step
from mastctl.devices.devices import Devices
from mastctl.devices.joint_history import DITHER_RAD, HeadReading, RestWatch
from mastctl.devices.keep_out import KeptOut, Pair
from mastctl.motion.measurement import (
    CameraView,
    RigCameras,
    apart,
    available,
    match_facts,
)
from mastctl.motion.requests import PixelTarget, PointingError, clicked_frame

POLL_S = 0.02  # between readings while the head moves
DWELL_S = 0.15
"""How long the reading must stay the same: three exposures, and longer than a mast's ringing after the axis
reports its position reached. A reading that dithers is watched for a second."""
ARRIVAL_TOLERANCE_RAD = 6e-3
"""How far from the commanded angle a head may rest: three counts and half the backlash of a 12-bit servo.
What remains is measured in the image."""
MOVE_MARGIN_S = 4.0  # beyond distance over speed and the dwell: ramps, an approach from one side, the rest
JUMP_RAD = 0.035  # beyond what twice the speed allows between readings: two slips of a degree
REST_WAIT_S = 2.0  # how long a request waits for a head that still moves


@dataclass(frozen=True, eq=False)
class FoundAgain:
    """A pixel (2,) that was clicked in the named frame ``view``, found again in a new image ``now``.

    ``other`` is a new image of the camera's partner; None where one camera points alone. ``sigma_px`` is one
    sigma of either coordinate of ``pixel_px``, (2,) in ``now``. The head was ``resting`` for both.
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

    A reading of the head must be free of faults, and reachable from the last one at twice the speed cap, or
    lie on the way to the commanded angles (a replayed head is there at once). The head has settled when it
    rests (`RestWatch`); it has arrived when it rests where it was sent.

    ``rig`` is the configured part of the mast file in use.
    ``record`` gets each step when it ends. ``cancelled`` is set by a stop; the request ends with
    PointingError ``stopped`` soon after. ``last`` is the step that was begun last, ``pointing`` the pointing
    that the next steps belong to, ``motion_evidence`` what the last images say about the move before them, by
    camera.
    """

    def __init__(
        self,
        rig: Rig,
        devices: Devices,
        clock: Clock,
        record: Callable[[Step], None],
        cancelled: threading.Event,
    ) -> None:
        self.cameras = RigCameras(devices, rig, self.check_not_stopped)
        self.last = "request"
        self.pointing = 1
        self.motion_evidence: Mapping[str, Mapping[str, Any]] = {}
        self._rig = rig
        self._devices = devices
        self._limits = devices.judge.limits
        self._clock = clock
        self._record = record
        self._cancelled = cancelled
        self._last_reading: HeadReading | None = None
        self._goal: Pair | None = None

    @contextmanager
    def step(self, name: str) -> Iterator[dict[str, Any]]:
        """Record what happens inside as one step, with the dict as its detail, and the error that ends it.

        A request that was stopped does not begin it.
        """
        self.last = name
        began_s = self._clock.now_s()
        detail: dict[str, Any] = {"pointing": self.pointing} if self.pointing > 1 else {}
        one = Step(name=name, state="failed", started_s=began_s, duration_s=0.0, detail=detail)
        try:
            self.check_not_stopped()
            yield detail
            one["state"] = "done"
        except BaseException as error:
            detail.update(code=getattr(error, "code", "internal"), message=" ".join(str(error).split()))
            raise
        finally:
            one["duration_s"] = self._clock.now_s() - began_s
            self._record(one)

    @contextmanager
    def whole(self, name: str) -> Iterator[dict[str, Any]]:
        """Record what happens inside as one step, without the steps that it is made of."""
        with self.step(name) as detail:
            record, self._record = self._record, lambda part: None
            try:
                yield detail
            finally:
                self._record, self.last = record, name

    def check_not_stopped(self) -> None:
        """Pass unless the request was cancelled. Raises PointingError ``stopped``."""
        if self._cancelled.is_set():
            raise PointingError("stopped", "the operation was stopped")

    # The head

    def read(self) -> HeadReading:
        """Return a reading that can be true. Raises PointingError ``bad_reading``, ``head_fault``."""
        reading, before = self._devices.read(), self._last_reading
        if reading.faults:
            raise PointingError("head_fault", f"the head reports: {'; '.join(reading.faults)}")
        if before is not None:
            passed_s = reading.time_s - before.time_s
            reach = 2.0 * self._limits.speed_rad_per_s * passed_s + JUMP_RAD
            goal = self._goal or (before.pan_rad, before.tilt_rad)
            jump = max(
                _outside(reading.pan_rad, before.pan_rad, goal[0]),
                _outside(reading.tilt_rad, before.tilt_rad, goal[1]),
            )
            if jump > reach:
                message = f"the head's reading jumped {jump:.3f} rad off its way in {passed_s:.3f} s"
                raise PointingError("bad_reading", f"{message}, at most {reach:.3f} rad is possible")
        self._last_reading = reading
        return reading

    def resting(self) -> HeadReading:
        """Return the reading of a head that rests now. Raises PointingError ``head_moving``; as `read`."""
        watch = RestWatch(0.0, DITHER_RAD)
        settled, last = self._rests(watch, self._clock.now_s() + REST_WAIT_S)
        if not settled:
            message = f"the head still moves after {REST_WAIT_S:g} s of waiting"
            raise PointingError("head_moving", f"{message}: {watch.seen()}")
        return last

    def rest(self) -> HeadReading:
        """Return the reading of a head that rests, as a step. Raises PointingError, DriverError."""
        with self.step("rest") as detail:
            resting = self.resting()
            detail.update(_angles(resting))
        return resting

    def chosen(self, solutions: Sequence[Solution], start: HeadReading) -> Solution:
        """Return the solution of the closed form (true joint angles) that is taken from a start.

        Of those that no keep-out bars, upright ones first, then the nearest; an angle is taken whole turns
        away too, where a cable lets the pan turn so far. Raises Unreachable, KeptOut.
        """

        def goal(one: Solution) -> Pair:
            return self._devices.goal((one.pan_rad, one.tilt_rad), start)

        at = start.pan_rad, start.tilt_rad
        refused: KeptOut | None = None
        for one in ordered(solutions, self._limits.pan_rad, self._limits.tilt_rad, *at, goal):
            try:
                self._devices.judge.check_from(at, goal(one))
            except KeptOut as error:
                refused = refused or error
            else:
                return one
        assert refused is not None
        raise refused

    def go_to_true(self, pan_rad: float, tilt_rad: float) -> tuple[Pair, HeadReading]:
        """Go to true angles, as `go` does; return the readings that were commanded, and the arrival."""
        goal = self._devices.goal((pan_rad, tilt_rad), self.read())
        return goal, self.go(*goal)

    def go(self, pan_rad: float, tilt_rad: float) -> HeadReading:
        """Check the limits, move until the head reads the angles, wait until settled; return the reading."""
        with self.step("limits") as detail:
            detail.update(pan_rad=pan_rad, tilt_rad=tilt_rad)
            self.check_goal(pan_rad, tilt_rad)
        with self.step("move") as detail:
            allowed_s = self.time_allowed_s(pan_rad, tilt_rad)
            detail.update(pan_rad=pan_rad, tilt_rad=tilt_rad, allowed_s=round(allowed_s, 3))
            began_s = self._clock.now_s()
            self.send(pan_rad, tilt_rad)
        with self.step("settle") as detail:
            settled = self.arrived(pan_rad, tilt_rad, began_s + allowed_s)
            detail.update(_angles(settled), count_rad=dict(self._devices.judge.counts_rad))
        return settled

    def check_goal(self, pan_rad: float, tilt_rad: float) -> None:
        """Pass angles to which the head may be sent from where it rests. Raises OutsideLimits, KeptOut."""
        now = self.read()
        self._devices.judge.check_from((now.pan_rad, now.tilt_rad), (pan_rad, tilt_rad))

    def time_allowed_s(self, pan_rad: float, tilt_rad: float) -> float:
        """Return the deadline of a move to these angles: distance over speed, ramps, dwell, margin."""
        now = self.read()
        distance = max(abs(pan_rad - now.pan_rad), abs(tilt_rad - now.tilt_rad))
        return distance / self._limits.speed_rad_per_s + DWELL_S + MOVE_MARGIN_S

    def send(self, pan_rad: float, tilt_rad: float) -> None:
        """Start the move at the speed cap."""
        self.check_not_stopped()
        self._goal = (pan_rad, tilt_rad)
        self._devices.move(pan_rad, tilt_rad)

    def arrived(self, pan_rad: float, tilt_rad: float, deadline_s: float) -> HeadReading:
        """Wait until the head rests at these angles and return the reading.

        Raises PointingError ``did_not_arrive``, ``did_not_settle`` at the deadline (clock time), ``stopped``.
        """
        watch = RestWatch(DWELL_S, DITHER_RAD)
        while True:
            settled, last = self._rests(watch, deadline_s)
            off = last.pan_rad - pan_rad, last.tilt_rad - tilt_rad
            if settled and max(map(abs, off)) <= ARRIVAL_TOLERANCE_RAD:
                return last
            if self._clock.now_s() < deadline_s:
                self._clock.sleep(POLL_S)
                continue  # a head that rests elsewhere may not have started yet
            where = f"pan {off[0]:+.4f} rad and tilt {off[1]:+.4f} rad from the commanded angles"
            if max(map(abs, off)) > ARRIVAL_TOLERANCE_RAD:
                most = f"at most {ARRIVAL_TOLERANCE_RAD:g} rad is expected"
                raise PointingError("did_not_arrive", f"at its deadline the head is {where}, {most}")
            raise PointingError(
                "did_not_settle", f"at its deadline the head still moves, {where}: {watch.seen()}"
            )

    def _rests(self, watch: RestWatch, deadline_s: float) -> tuple[bool, HeadReading]:
        """Read until the head rests (True) or the deadline passes; return the last reading."""
        while True:
            self.check_not_stopped()
            reading = self.read()
            if watch.rests(reading):
                return True, reading
            if self._clock.now_s() >= deadline_s:
                return False, reading
            self._clock.sleep(POLL_S)

    # The cameras

    def clicked(self, target: PixelTarget, alone: bool = False) -> FoundAgain:
        """Take a fresh pair, or the clicked camera's image ``alone``, and find in it what was clicked."""
        view = self.cameras.view(clicked_frame(target, self._rig, self._devices.store.by_id))
        pixel = np.array([target.x_px, target.y_px])
        partner = None if alone else self.cameras.partner(target.camera)
        cameras = (target.camera,) if partner is None else (target.camera, partner)
        resting = self.rest()
        with self.step("frames") as detail:
            fresh = self.cameras.new(cameras, self._clock.now_s(), resting)
            now, other = fresh[target.camera], None if partner is None else fresh[partner]
            detail.update(frame_ids=[fresh[name].frame.frame_id for name in cameras])
            detail.update(apart(now, [] if other is None else [other]))
            self.cameras.remember(fresh)
        with self.step("target") as detail:
            again = self.cameras.again(view, pixel, now)
            detail.update(match_facts(again))
        return FoundAgain(view, pixel, now, other, again.pixel_px, float(again.sigma_px.max()), resting)

    def before(
        self,
        cameras: Sequence[str],
        goal_rad: Pair,
        needed: Sequence[str] = (),
        timeout_s: float | None = None,
    ) -> None:
        """Take images to compare with after a move, where there are none yet and they will show something.

        ``goal_rad``: true angles that it leads to. A camera that gives none is left out unless ``needed``.
        """
        lacking = self.cameras.lacking(cameras, self.read().true_rad, goal_rad)
        if not lacking:
            return
        with self.step("before") as detail:
            began_s, resting = self._clock.now_s(), self.resting()
            views, missing = available(
                lacking, lambda left: self.cameras.new(left, began_s, resting, timeout_s), needed
            )
            if views:
                detail.update(frame_ids=[view.frame.frame_id for view in views.values()])
                self.cameras.remember(views)
            if missing:
                detail.update(missing=missing)

    def capture(self, cameras: Sequence[str], settled: HeadReading) -> dict[str, CameraView]:
        """Take new images, exposed after the head had settled. Raises BadFrame if they did not move as it."""
        with self.step("look") as detail:
            views = self.cameras.new(cameras, settled.time_s, settled)
            first, *others = views.values()
            detail.update(frame_ids=[view.frame.frame_id for view in views.values()], **apart(first, others))
            self.cameras.check_motion(views, detail)
            self.motion_evidence = detail["motion_evidence"]
        return views


def _outside(value: float, one: float, other: float) -> float:
    """How far a value lies outside the range between two others."""
    return max(min(one, other) - value, value - max(one, other), 0.0)


def _angles(reading: HeadReading) -> dict[str, float]:
    """Where the head is, for a step's detail: as read, and truly."""
    true_pan_rad, true_tilt_rad = reading.true_rad
    return {
        "pan_rad": reading.pan_rad,
        "tilt_rad": reading.tilt_rad,
        "true_pan_rad": true_pan_rad,
        "true_tilt_rad": true_tilt_rad,
    }

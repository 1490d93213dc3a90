"""Turns the head to and fro, and records frames and joint readings meanwhile.

The cameras are called directly, not through the service's checks: stamps that cannot be true are what this is
to find out. The head goes through `mastctl.devices.devices`, so that limits and stop are the service's own.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from drivers.clock import Clock
from drivers.errors import DriverError, NoReply
from drivers.interfaces import Camera, Frame, Reading
from mastctl.devices.devices import Devices
from mastctl.devices.judge import Limits
from mastctl.errors import MastctlError, Stopped
from mastctl.setup.sync_fit import REACH_S, OffsetFit, fit_offset
from mastctl.setup.sync_motion import CannotTell, JointMotion, Patches, choose_patches

SPEEDS = (1.0, 0.4, 0.7)  # parts of the chosen speed, an odd number, so that each goes both ways
USUAL_AMPLITUDE_RAD = 0.07
MOST_OF_VIEW = 0.15  # of the narrowest camera's view, to either side
USUAL_SPEED = 5.0  # amplitudes a second
READ_EVERY_S = 0.005
REST_S = REACH_S + 0.4  # before the picture at rest: also one that is stamped too new shows the rest
ARRIVE_S = 10.0
FRAME_TIMEOUT_S = 5.0
GRACE_S = 1.0  # beyond it a driver that should have answered hangs
END_S = FRAME_TIMEOUT_S + GRACE_S  # a driver that is still at work at the end is left to itself
LOST_FRAMES = 3
LATEST_S = 2.0  # from a frame's exposure to its coming, beside what its stamps may be off


@dataclass(frozen=True)
class SweepPlan:
    """How the head is turned: pan goes ``amplitude_rad`` to either side for ``seconds``."""

    amplitude_rad: float
    speed_rad_per_s: float
    seconds: float


@dataclass
class Sightings:
    """What one camera gave: stamps, places of its patches, and why it gave no more."""

    patches: Patches | None = None
    stamps_s: list[float] = field(default_factory=list)
    places_px: list[FloatArray] = field(default_factory=list)
    came_after_s: float = math.inf  # the least time from a stamp to the moment its frame came
    uncertainty_s: float = 0.0
    failure: str = ""

    def check_clock(self) -> None:
        """Refuse stamps far from when frames came: rounds of a sweep look alike. Raises CannotTell."""
        if -REACH_S <= self.came_after_s <= REACH_S + LATEST_S:
            return
        side = "earlier" if self.came_after_s > 0 else "later"
        raise CannotTell(
            f"its stamps are {abs(self.came_after_s):.1f} s {side} than the moments at which its frames "
            "came; seconds of CLOCK_MONOTONIC are expected"
        )


def plan_sweep(
    rig: Rig,
    cameras: Sequence[str],
    limits: Limits,
    amplitude_rad: float | None,
    speed_rad_per_s: float | None,
    seconds: float,
) -> SweepPlan:
    """Return a sweep that the cameras' views allow, as far as it was not requested otherwise."""
    if amplitude_rad is None:
        narrowest = min(_view_rad(rig, name) for name in cameras)
        amplitude_rad = min(USUAL_AMPLITUDE_RAD, MOST_OF_VIEW * narrowest)
    if speed_rad_per_s is None:
        speed_rad_per_s = min(USUAL_SPEED * amplitude_rad, limits.speed_rad_per_s)
    return SweepPlan(amplitude_rad, speed_rad_per_s, seconds)


def _view_rad(rig: Rig, camera: str) -> float:
    """How wide a camera sees along its middle row."""
    model = rig.cameras[camera].model
    width, height = model.size_px
    ends = model.ray(np.array([[0.0, (height - 1) / 2], [width - 1.0, (height - 1) / 2]])).directions
    return float(np.arccos(np.clip(ends[0] @ ends[1], -1.0, 1.0)))


class Sweep:
    """One measurement by the head of ``devices`` and open cameras on it, by name.

    ``stop``, set from anywhere, ends it: the head is halted where it is. ``clock`` stamps readings and
    frames.
    """

    def __init__(
        self,
        devices: Devices,
        cameras: Mapping[str, Camera],
        rig: Rig,
        limits: Limits,
        stop: threading.Event,
        clock: Clock,
    ) -> None:
        self._devices = devices
        self._cameras = cameras
        self._rig = rig
        self._limits = limits
        self._stop = stop
        self._clock = clock
        self._over = threading.Event()
        self._readings: list[Reading] = []
        self.seen = {name: Sightings() for name in cameras}

    def run(self, plan: SweepPlan) -> None:
        """Sweep, and bring the head back to its start.

        Raises
        ------
        Stopped
            If it was stopped; the head is at rest there.
        OutsideLimits, KeptOut
            Before anything moves, if the sweep would pass a limit or a keep-out.
        DriverError
            If the head fails; it is halted. The failure of a camera is in `seen`.
        """
        self._rest()
        start = self._devices.read()
        for side in (-1, 1):
            goal = start.pan_rad + side * plan.amplitude_rad, start.tilt_rad
            self._limits.check(*goal)
            self._devices.judge.check_move(goal, lambda: start)
        self._limits.speed(plan.speed_rad_per_s)
        threads = [
            self._clock.thread(partial(self._follow, name, start, plan), f"sweep {name}")
            for name in self._cameras
        ]
        for thread in threads:
            thread.start()
        try:
            self._wait_for_choices()
            if self._to_and_fro(start, plan):
                self._go(start.pan_rad, start.tilt_rad, plan.speed_rad_per_s)
        except BaseException:
            self._devices.stop()
            raise
        finally:
            self._over.set()
            end_s = self._clock.now_s() + END_S
            while any(thread.is_alive() for thread in threads) and self._clock.now_s() < end_s:
                self._clock.sleep(READ_EVERY_S)

    def fit(self, camera: str) -> OffsetFit:
        """Return a camera's offset to the joint readings. Raises CannotTell."""
        seen = self.seen[camera]
        if seen.failure and not seen.stamps_s:
            raise CannotTell(seen.failure)
        if seen.patches is None or not seen.stamps_s:
            raise CannotTell("it gave no image while the head turned")
        seen.check_clock()
        motion = JointMotion(
            np.array([reading.time_s for reading in self._readings]),
            np.array([reading.pan_rad for reading in self._readings]),
        )
        try:
            return fit_offset(motion, np.array(seen.stamps_s), np.array(seen.places_px), seen.patches.rows)
        except CannotTell as error:
            raise CannotTell(f"{error}; {seen.failure}" if seen.failure else str(error)) from None

    def _check_stop(self) -> None:
        if self._stop.is_set():
            raise Stopped("it was stopped; the head is at rest there")

    def _note(self) -> Reading:
        """Record the newest reading."""
        reading = self._devices.last_reading
        if reading is None:
            reading = self._devices.read()
        if not self._readings or reading.time_s > self._readings[-1].time_s:
            self._readings.append(reading)
        return reading

    def _pause(self) -> None:
        self._check_stop()
        self._clock.sleep(READ_EVERY_S)
        self._check_stop()

    def _rest(self) -> None:
        """Wait until the head has been at rest for long enough."""
        since_s = self._clock.now_s()
        until_s = since_s + ARRIVE_S
        while self._clock.now_s() - since_s < REST_S:
            if self._note().moving:
                since_s = self._clock.now_s()
            if self._clock.now_s() > until_s:
                raise NoReply("the head does not come to rest", device="pan_tilt")
            self._pause()

    def _wait_for_choices(self) -> None:
        """Wait until for each camera patches are chosen or it is known why not."""
        until_s = self._clock.now_s() + FRAME_TIMEOUT_S + GRACE_S
        while waiting := [one for one in self.seen.values() if one.patches is None and not one.failure]:
            if self._clock.now_s() > until_s:
                for seen in waiting:
                    seen.failure = "its driver did not come back from next_frame in time"
                return
            self._pause()

    def _to_and_fro(self, start: Reading, plan: SweepPlan) -> int:
        """Turn for the plan's time, and return how many ways that made: no more than any camera sees."""
        until_s = self._clock.now_s() + plan.seconds
        ways, side = 0, 1
        while self._clock.now_s() < until_s and not all(seen.failure for seen in self.seen.values()):
            speed = plan.speed_rad_per_s * SPEEDS[ways % len(SPEEDS)]
            self._go(start.pan_rad + side * plan.amplitude_rad, start.tilt_rad, speed)
            ways, side = ways + 1, -side
        return ways

    def _go(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float) -> None:
        """Go there, and record readings until the head is at rest."""
        self._check_stop()
        self._devices.move(pan_rad, tilt_rad, speed_rad_per_s)
        sent_s = self._clock.now_s()
        while True:
            reading = self._note()
            if reading.time_s > sent_s + 0.05 and not reading.moving:
                return
            if self._clock.now_s() - sent_s > ARRIVE_S:
                raise NoReply(f"the head does not come to pan {pan_rad:.3f} rad", device="pan_tilt")
            self._pause()

    def _choose(self, name: str, start: Reading, plan: SweepPlan) -> Patches:
        """Take a camera's image at rest and choose what to follow in it."""
        frame = self._cameras[name].next_frame(self._clock.now_s(), FRAME_TIMEOUT_S)
        joints_rad = self._rig.joints.true_rad((start.pan_rad, start.tilt_rad))
        return choose_patches(frame.image, self._rig, name, joints_rad, plan.amplitude_rad)

    def _follow(self, name: str, start: Reading, plan: SweepPlan) -> None:
        """In a thread of its own: choose patches of an image at rest, and find them in what comes."""
        seen, camera = self.seen[name], self._cameras[name]
        try:
            patches = self._choose(name, start, plan)
        except (DriverError, MastctlError) as error:
            seen.failure = str(error)
            return
        except Exception as error:  # a foreign driver may raise anything
            seen.failure = f"its driver failed in next_frame: {type(error).__name__}: {error}"
            return
        if seen.failure:  # it took too long: the head may be turning already
            return
        seen.patches = patches
        lost, after_s = 0, self._clock.now_s()
        while not self._over.is_set():
            try:
                frame = camera.next_frame(after_s, FRAME_TIMEOUT_S)
                self._take(seen, patches, frame)
                after_s, lost = max(after_s, frame.mid_exposure_s - frame.exposure_s / 2), 0
            except Exception as error:  # a foreign driver may raise anything
                lost += 1
                if lost == LOST_FRAMES and not self._over.is_set():
                    known = isinstance(error, DriverError)
                    seen.failure = str(error) if known else f"{type(error).__name__}: {error}"
                    return
                self._clock.sleep(0.05)

    def _take(self, seen: Sightings, patches: Patches, frame: Frame) -> None:
        stamp_s = float(frame.mid_exposure_s)
        seen.came_after_s = min(seen.came_after_s, self._clock.now_s() - stamp_s)
        if seen.stamps_s and stamp_s <= seen.stamps_s[-1]:
            self._clock.sleep(0.002)  # the same one again
            return
        places_px = patches.places_px(frame.image)
        seen.uncertainty_s = float(getattr(frame, "mid_uncertainty_s", 0.0))
        seen.stamps_s.append(stamp_s)
        seen.places_px.append(places_px)

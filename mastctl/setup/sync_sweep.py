"""Turns the head to and fro, and records frames and joint readings meanwhile.

The cameras are called directly, not through the service's checks: stamps that cannot be true are what this is
to find out. The head goes through `mastctl.devices.devices`, so that limits and stop are the service's own.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import cv2
import numpy as np

from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.patch import peaks
from calib.matching.warp import Grey, grey, summit
from drivers.clock import Clock
from drivers.errors import NoReply
from drivers.interfaces import Camera, Image, Reading
from mastctl.devices.devices import Devices
from mastctl.devices.judge import Limits
from mastctl.setup.sync_fit import REACH_S, CannotTell, JointMotion, OffsetFit, fit_offset

SIGNIFICANT_SIGMAS = 3.0
LEAST_S = 0.0005  # an offset that small needs no correction
SPEEDS = (1.0, 0.4, 0.7)  # parts of the chosen speed, an odd number, so that each goes both ways
USUAL_AMPLITUDE_RAD = 0.07
MOST_OF_VIEW = 0.15  # of the narrowest camera's view, to either side
USUAL_SPEED = 5.0  # amplitudes a second
READ_EVERY_S = 0.005
REST_S = REACH_S + 0.4  # before the picture at rest: also one that is stamped too new shows the rest
ARRIVE_S = 10.0
BEGUN_S = 0.05  # a reading so long after a move shows it
FRAME_TIMEOUT_S = 5.0
END_S = FRAME_TIMEOUT_S + 1.0  # beyond it a driver that should have answered hangs
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
    seconds: float,
) -> SweepPlan:
    """Return a sweep that the cameras' views allow, as far as it was not requested otherwise."""
    if amplitude_rad is None:
        models = [rig.cameras[name].model for name in cameras]
        narrowest = min(2 * math.atan(one.size_px[0] / 2 / one.focal_px[0]) for one in models)
        amplitude_rad = min(USUAL_AMPLITUDE_RAD, MOST_OF_VIEW * narrowest)
    return SweepPlan(amplitude_rad, min(USUAL_SPEED * amplitude_rad, limits.speed_rad_per_s), seconds)


class Sweep:
    """One measurement by the head of ``devices`` and open cameras on it, by name.

    An interrupt halts the head where it is. ``clock`` stamps readings and frames.
    """

    def __init__(
        self,
        devices: Devices,
        cameras: Mapping[str, Camera],
        rig: Rig,
        limits: Limits,
        clock: Clock,
    ) -> None:
        self._devices = devices
        self._cameras = cameras
        self._rig = rig
        self._limits = limits
        self._clock = clock
        self._over = threading.Event()
        self._readings: list[Reading] = []
        self.seen = {name: Sightings() for name in cameras}

    def run(self, plan: SweepPlan) -> None:
        """Sweep, and bring the head back to its start; a camera's failure is in `seen`.

        Raises OutsideLimits and KeptOut before anything moves, if the sweep would pass a limit or a keep-out;
        DriverError if the head fails: it is at rest then.
        """
        self._rest("the head does not come to rest", REST_S)
        start = self._devices.read()
        for side in (-1, 1):
            goal = start.pan_rad + side * plan.amplitude_rad, start.tilt_rad
            self._limits.check(*goal)
            self._devices.judge.check_move(goal, lambda: start)
        self._limits.speed(plan.speed_rad_per_s)
        self._await(self._threads(partial(self._choose, start, plan)))
        for seen in self.seen.values():
            if seen.patches is None:
                seen.failure = seen.failure or f"it gave no image within {END_S:g} s"
        threads = self._threads(self._follow)
        try:
            if self._to_and_fro(start, plan):
                self._go(start.pan_rad, start.tilt_rad, plan.speed_rad_per_s)
        except BaseException:
            self._devices.stop()
            raise
        finally:
            self._over.set()
            self._await(threads)

    def found(self, camera: str, in_use_s: float) -> dict[str, Any]:
        """Return a camera's result as JSON; ``offset_s`` is null, and ``failure`` says why, if there is none.

        ``in_use_s`` is the offset that its stamps have already; ``left_s`` is what is left beside it.
        """
        seen = self.seen[camera]
        found: dict[str, Any] = {
            "offset_s": None,
            "sigma_s": None,
            "in_use_s": in_use_s,
            "stated_uncertainty_s": seen.uncertainty_s,
            "seen_frames": len(seen.stamps_s),
            "warning": None,
            "failure": None,
        }
        try:
            fit = self._fit(seen)
        except CannotTell as error:
            failures = [str(error), seen.failure] if seen.stamps_s and seen.failure else [str(error)]
            return found | {"failure": "; ".join(failures)}
        beyond_s = SIGNIFICANT_SIGMAS * fit.sigma_s + seen.uncertainty_s
        if abs(fit.offset_s) > max(beyond_s, LEAST_S):
            side = "later" if fit.offset_s > 0 else "earlier"
            found["warning"] = (
                f"{camera}: its pictures were taken {1e3 * abs(fit.offset_s):.1f} ms {side} than its stamps "
                f"say, which contradicts them: {1e3 * beyond_s:.1f} ms are explained (three sigma, and "
                f"{1e3 * seen.uncertainty_s:.1f} ms that the driver states)"
            )
        return found | vars(fit) | {"offset_s": in_use_s + fit.offset_s, "left_s": fit.offset_s}

    def _fit(self, seen: Sightings) -> OffsetFit:
        """A camera's offset to the joint readings. Raises CannotTell."""
        if seen.patches is None or not seen.stamps_s:
            raise CannotTell(seen.failure or "it gave no image while the head turned")
        seen.check_clock()
        motion = JointMotion(
            np.array([reading.time_s for reading in self._readings]),
            np.array([reading.pan_rad for reading in self._readings]),
        )
        return fit_offset(motion, np.array(seen.stamps_s), np.array(seen.places_px), seen.patches.rows)

    def _threads(self, work: Callable[[str], None]) -> list[threading.Thread]:
        """Begin some work for each camera that has not failed, in a thread of its own."""
        names = [name for name, seen in self.seen.items() if not seen.failure]
        threads = [self._clock.thread(partial(work, name), f"sweep {name}") for name in names]
        for thread in threads:
            thread.start()
        return threads

    def _await(self, threads: Sequence[threading.Thread]) -> None:
        """Wait for threads; a driver that is still at work at the end is left to itself."""
        end_s = self._clock.now_s() + END_S
        while any(thread.is_alive() for thread in threads) and self._clock.now_s() < end_s:
            self._clock.sleep(READ_EVERY_S)

    def _note(self) -> Reading:
        """Record the newest reading."""
        reading = self._devices.last_reading
        if reading is None:
            reading = self._devices.read()
        if not self._readings or reading.time_s > self._readings[-1].time_s:
            self._readings.append(reading)
        return reading

    def _rest(self, message: str, rest_s: float = 0.0) -> None:
        """Record readings until the head has been at rest for some time. Raises NoReply."""
        began_s = since_s = self._clock.now_s()
        while self._clock.now_s() - began_s <= ARRIVE_S:
            reading, now_s = self._note(), self._clock.now_s()
            if reading.moving or reading.time_s <= began_s + BEGUN_S:
                since_s = now_s
            elif now_s - since_s >= rest_s:
                return
            self._clock.sleep(READ_EVERY_S)
        raise NoReply(message, device="pan_tilt")

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
        self._devices.move(pan_rad, tilt_rad, speed_rad_per_s)
        self._rest(f"the head does not come to pan {pan_rad:.3f} rad")

    def _choose(self, start: Reading, plan: SweepPlan, name: str) -> None:
        """Take a camera's image at rest and choose what to follow in it; its failure is in `seen`."""
        joints_rad = self._rig.joints.true_rad((start.pan_rad, start.tilt_rad))
        try:
            frame = self._cameras[name].next_frame(self._clock.now_s(), FRAME_TIMEOUT_S)
            self.seen[name].patches = choose_patches(
                frame.image, self._rig, name, joints_rad, plan.amplitude_rad
            )
        except Exception as error:  # a foreign driver may raise anything
            self.seen[name].failure = str(error) or type(error).__name__

    def _follow(self, name: str) -> None:
        """Find a camera's patches in what comes."""
        seen, camera = self.seen[name], self._cameras[name]
        assert seen.patches is not None
        lost, after_s = 0, self._clock.now_s()
        while not self._over.is_set():
            try:
                frame = camera.next_frame(after_s, FRAME_TIMEOUT_S)
                stamp_s = float(frame.mid_exposure_s)
                seen.came_after_s = min(seen.came_after_s, self._clock.now_s() - stamp_s)
                if seen.stamps_s and stamp_s <= seen.stamps_s[-1]:
                    self._clock.sleep(0.002)  # the same one again
                    continue
                seen.places_px.append(seen.patches.places_px(frame.image))
                seen.stamps_s.append(stamp_s)
                seen.uncertainty_s = float(getattr(frame, "mid_uncertainty_s", 0.0))
                after_s, lost = max(after_s, stamp_s - frame.exposure_s / 2), 0
            except Exception as error:  # a foreign driver may raise anything
                lost += 1
                if lost == LOST_FRAMES and not self._over.is_set():
                    seen.failure = str(error) or type(error).__name__
                    return
                self._clock.sleep(0.05)


HALF_PX = 15
MOST_PATCHES = 12
LEAST_CORRELATION = 0.6  # motion blurs the pictures that are compared with one at rest
LEAST_LEAD = 0.05  # before the best place elsewhere
APART_PX = 6
PAD_PX = 12
NEAR = 1.4  # so much further than infinitely distant things do near ones move
FAR_M = 1e5


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches of one camera's image, (2 HALF_PX + 1) squares of grey, and where each is searched.

    ``centres_px`` (p, 2) are their places in the image at rest, ``windows_px`` (p, 4) the corners (x0, y0,
    x1, y1), inclusive, of where their centres may come to lie, ``ways`` (p, 2) the unit vectors along which
    they move, and ``rows`` (p,) their rows in image heights from the middle.
    """

    templates: tuple[Grey, ...]
    centres_px: FloatArray
    windows_px: FloatArray
    ways: FloatArray
    rows: FloatArray

    def places_px(self, image: Image) -> FloatArray:
        """Return the (p,) places along their ways in a picture; not-a-number where a patch is not found."""
        picture = grey(image)
        return np.array([self._place_px(picture, number) for number in range(len(self.templates))])

    def _place_px(self, picture: Grey, number: int) -> float:
        x0, y0, x1, y1 = self.windows_px[number].astype(int)
        part = picture[y0 - HALF_PX : y1 + HALF_PX + 1, x0 - HALF_PX : x1 + HALF_PX + 1]
        found = cv2.matchTemplate(part, self.templates[number], cv2.TM_CCOEFF_NORMED)
        score = np.asarray(found, np.float32)
        (x, y), best, second = peaks(score, APART_PX)
        height, width = score.shape
        if best < max(LEAST_CORRELATION, second + LEAST_LEAD):
            return np.nan
        if not (0 < x < width - 1 and 0 < y < height - 1):
            return np.nan
        offset = np.array([summit(*score[y, x - 1 : x + 2]), summit(*score[y - 1 : y + 2, x])])
        place = np.array([x0 + x, y0 + y]) + offset - self.centres_px[number]
        return float(place @ self.ways[number])


def choose_patches(
    image: Image, rig: Rig, camera: str, joints_rad: tuple[float, float], amplitude_rad: float
) -> Patches:
    """Choose textured patches that stay in the image while pan goes ``amplitude_rad`` to either side.

    ``image`` is of a head at rest at ``joints_rad`` (pan, tilt). ``rig`` predicts roughly where things go;
    the measurement does not use it. Raises CannotTell if nothing differs from its surroundings.
    """
    picture = grey(image)
    height, width = picture.shape
    apart_px = max(2 * HALF_PX, height / 8)  # a rolling shutter shows between patches of many rows
    corners = cv2.goodFeaturesToTrack(picture, 400, 0.02, apart_px, blockSize=9)
    if corners is None:
        raise CannotTell("the scene is too plain: nothing in the picture can be followed")
    centres = np.rint(corners.reshape(-1, 2)).astype(np.float64)
    ends = np.stack([moved_px(rig, camera, joints_rad, side * amplitude_rad, centres) for side in (-1, 1)])
    moves = NEAR * (ends - centres)
    low = np.floor(np.minimum(centres + moves.min(axis=0), centres) - PAD_PX)
    high = np.ceil(np.maximum(centres + moves.max(axis=0), centres) + PAD_PX)
    inside = np.isfinite(moves).all(axis=(0, 2))
    inside &= (low >= HALF_PX).all(axis=1) & (high <= np.array([width, height]) - 1 - HALF_PX).all(axis=1)
    chosen = np.flatnonzero(inside)[:MOST_PATCHES]  # the clearest come first
    if not len(chosen):
        raise CannotTell(
            "nothing that can be followed stays in the picture; a smaller --amplitude, or a view with more "
            "texture in its middle, is expected"
        )
    ways = (ends[1] - ends[0])[chosen]
    return Patches(
        templates=tuple(
            picture[y - HALF_PX : y + HALF_PX + 1, x - HALF_PX : x + HALF_PX + 1].copy()
            for x, y in centres[chosen].astype(int)
        ),
        centres_px=centres[chosen],
        windows_px=np.hstack([low, high])[chosen],
        ways=ways / np.linalg.norm(ways, axis=1, keepdims=True),
        rows=(centres[chosen, 1] - (height - 1) / 2) / height,
    )


def moved_px(
    rig: Rig, camera: str, joints_rad: tuple[float, float], pan_by_rad: float, pixels_px: FloatArray
) -> FloatArray:
    """Return where far things at (n, 2) pixels come to lie when pan goes further; nan out of reach."""
    model = rig.cameras[camera].model
    pan_rad, tilt_rad = joints_rad
    rays = model.ray(pixels_px)
    far = rig.mast.rover_from_head(pan_rad, tilt_rad).points(rays.origins_m + FAR_M * rays.directions)
    back = rig.mast.rover_from_head(pan_rad + pan_by_rad, tilt_rad).inverse.points(far)
    found: FloatArray = model.project(back)[0]
    return found

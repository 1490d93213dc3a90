"""The devices as the service uses them: one owner thread each, answers checked, the one door for moves.

Every call blocks for a bounded time and may come from any thread. The head is read all the time (50 times a
second while it moves, 20 while it rests), so that each frame gets the joint angles at its mid-exposure.
This module does not decide where to point, and an answer that cannot be true is an error. Only a reading,
which moves nothing, is asked for once more: no operation ends because one answer was lost on the line.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np

from calib.mast.rig import Rig
from drivers.absent_camera import AbsentCamera
from drivers.clock import Clock, deadlines_on
from drivers.errors import BadFrame, BadReply, DriverError, LineLost, NoFreshFrame, NoReply
from drivers.interfaces import (
    AxisReport,
    Camera,
    Frame,
    FrameTime,
    KnowsSize,
    Paced,
    PanTilt,
    Reading,
    Reporting,
)
from drivers.pairing import Offset, Pairing, learned
from mastctl.devices import frames as frame_checks
from mastctl.devices import joint_history
from mastctl.devices.exposure_hold import ExposureHold
from mastctl.devices.frames import FrameStore, StampedFrame
from mastctl.devices.joint_history import JointHistory
from mastctl.devices.limits import Limits
from mastctl.devices.stops import Stops
from mastctl.devices.thread import Asked, DeviceThread, Fault, Words
from mastctl.errors import MastctlError, NoLonger, Stopped

log = logging.getLogger(__name__)

HEAD = "pan_tilt"
READ_TIMEOUT_S = 1.0
MOVE_TIMEOUT_S = 1.0
STOP_TIMEOUT_S = 1.0
SIZE_TIMEOUT_S = 1.0
CAMERA_GRACE_S = 3.0  # beyond the time given to next_frame: copying and decoding on a busy machine
MOVING_PERIOD_S = 0.02
RESTING_PERIOD_S = 0.05
REST_S = 0.3  # after a move was taken, before a reading that says rest is one of its end
WORDS = {
    "read": Words("the head is read again"),
    "move": Words("a later move is taken in time", late_is_fault=True),
    "next_frame": Words("a picture comes"),
    "recent_times": Words("a pair of pictures comes"),
    "hold_exposure": Words("an operation can hold the exposure again"),
    "release_exposure": Words("an operation has held and released the exposure again"),
}
MOVED_RAD = 1e-5  # a head camera's picture that stays the same to the last bit beyond this is frozen


class HardwareLike(Protocol):
    """What `drivers.open_hardware` gives, as far as it is used here."""

    @property
    def pan_tilt(self) -> PanTilt: ...
    @property
    def cameras(self) -> Mapping[str, Camera]: ...


class Devices:
    """The head and the cameras behind their threads.

    Parameters
    ----------
    hardware
        The opened drivers; closing them is left to their opener, after `close`.
    limits
        Soft limits, checked in `move` as the last thing before the driver is called.
    mast_digest
        SHA-256 (hex) of the mast file in use, part of every frame's facts.
    clock
        Stamps are judged against it; deadlines run on it too, or in real time if it is turned by hand.
    rig
        The mast file's content: image sizes, and which cameras ride on the head. Without it sizes are
        not checked and no camera is taken for frozen.
    camera_grace_s
        How long past its time a camera may take before it counts as hanging, seconds; 3 by default.
    """

    def __init__(
        self,
        hardware: HardwareLike,
        limits: Limits,
        mast_digest: str,
        clock: Clock,
        rig: Rig | None = None,
        camera_grace_s: float | None = None,
    ) -> None:
        self._pan_tilt = hardware.pan_tilt
        self._cameras = dict(hardware.cameras)
        self._limits = limits
        self._clock = clock
        self._time = deadlines_on(clock)
        self._grace_s = CAMERA_GRACE_S if camera_grace_s is None else camera_grace_s
        self._history = JointHistory()
        self._store = FrameStore(mast_digest)
        self._sizes_px: dict[str, tuple[int, int]] = {}
        self._on_head: set[str] = set()
        if rig is not None:
            self._take_rig(rig)
        self._paired_s: dict[str, float] = {}  # per camera when the last frame that served a set began
        self._learned: dict[tuple[str, str], Offset] = {}
        self._still_since: dict[str, StampedFrame] = {}  # per camera the first frame of the same content
        self._stamping = {name: threading.Lock() for name in self._cameras}
        self._gate = threading.Lock()
        self._blocks: dict[object, str] = {}  # who lets no move out, and why
        self._closed = False
        self._last_faults: tuple[str, ...] = ()
        # The last move's ticket and when it was taken, until the head was read at rest after it.
        self._moved: tuple[int, float] | None = None
        self._stop_lost = False  # a lost line kept a stop from the head, which was not read at rest since
        self._camera_threads = {name: self._thread_of(name) for name in self._cameras}
        if rig is not None:
            self._check_sizes()
        self._head = DeviceThread(
            HEAD, between=self._poll, between_timeout_s=READ_TIMEOUT_S, words=WORDS, clock=self._time
        )
        self._stops = Stops(self._head, HEAD, lambda: self._pan_tilt.stop(), self._time)

    # The head

    @property
    def last_reading(self) -> Reading | None:
        """The last good reading of the head, None before the first; its age is the clock minus its time_s."""
        return self._history.newest

    def read(self) -> Reading:
        """Return the joint state measured now; what was not answered properly is asked for once more.

        Raises
        ------
        NoReply, BadReply, DriverError
            If the head does not answer in 1 s, both questions together, or answers what cannot be true. The
            error is that of the first question.
        """
        until_s = self._time.now_s() + READ_TIMEOUT_S
        try:
            return self._head.call("read", self._read_once, READ_TIMEOUT_S)
        except (NoReply, BadReply) as error:
            left_s = until_s - self._time.now_s()
            if left_s <= 0:
                raise
            try:
                return self._head.call("read", self._read_once, left_s)
            except DriverError:
                raise error from None

    def report(self) -> Mapping[str, AxisReport]:
        """Return where each axis was sent and stands in counts; empty for a head that does not know.

        Raises
        ------
        NoReply, BadReply, DriverError
            If the head does not tell within 1 s, or tells something else.
        """
        return self._head.call("report", self._reported, READ_TIMEOUT_S, told=False)

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        """Start the head towards the angles, radians, and return; at most at the speed cap.

        Raises
        ------
        OutsideLimits
            If an angle or the speed may not be commanded; nothing was sent.
        Stopped
            If a stop came first, moves are blocked, or a stop has not come back from the driver yet;
            nothing was sent.
        NoReply, DriverError
            If the head does not take the command in 1 s.
        """
        ticket = self._stops.ticket()

        def send() -> None:
            with self._gate:
                if self._blocks:
                    raise Stopped(next(iter(self._blocks.values())))
            self._stops.check(ticket)
            self._limits.check(pan_rad, tilt_rad)
            speed = self._limits.speed(speed_rad_per_s)
            self._history.move_sent(self._clock.now_s())
            self._pan_tilt.move(float(pan_rad), float(tilt_rad), speed)
            self._moved = ticket, self._time.now_s()

        self._head.call("move", send, MOVE_TIMEOUT_S)

    def stop(self) -> None:
        """Halt the head at once, whatever hangs (`mastctl.devices.stops`); moves still waiting are never
        sent.

        Raises
        ------
        NoReply, DriverError
            If the head did not confirm within 1 s; it may still move.
        """
        try:
            self._stops.send(STOP_TIMEOUT_S)
        except LineLost:
            self._stop_lost = True
            raise

    def block_moves(self, holder: object, reason: str) -> None:
        """Refuse every further move, with this reason, until the holder (any key) allows them again."""
        with self._gate:
            self._blocks[holder] = reason

    def allow_moves(self, holder: object) -> None:
        """Take back what this holder blocked; moves are taken when nobody blocks them."""
        with self._gate:
            self._blocks.pop(holder, None)

    # The cameras

    def frames(
        self, cameras: Sequence[str], exposed_after_s: float, timeout_s: float
    ) -> dict[str, StampedFrame]:
        """Return one frame of each camera, asked for in parallel, with its facts.

        Frames of several cameras belong together (`drivers.pairing`): exposed at one trigger, or nearest in
        time. Each serves one such set. All are ``moving`` if the head moved at any time from the first
        exposure to the end of the last.

        Parameters
        ----------
        cameras
            Names of configured cameras.
        exposed_after_s
            Only frames whose exposure began after this moment count, seconds of CLOCK_MONOTONIC.
        timeout_s
            What each camera is given, seconds; the call itself ends at most the grace and 1 s later.

        Raises
        ------
        NotKnown
            ``unknown_camera`` if a name is not configured.
        NoFreshFrame, BadFrame, NoReply, DriverError
            If a camera did not deliver, or none that belong together; the first in the order asked.
        BadReply
            If the head's readings do not reach around an exposure.
        """
        for camera in cameras:
            frame_checks.check_known(camera, self._cameras)
        deadline_s = self._time.now_s() + timeout_s
        names = tuple(dict.fromkeys(cameras))
        if len(names) < 2:
            frames = self._fetched(dict.fromkeys(names, exposed_after_s), deadline_s)
            return {name: self._stamped(name, frame) for name, frame in frames.items()}
        used_s = max(self._paired_s.get(name, -math.inf) for name in names)
        pairing = Pairing(names[0], self._offsets(names, deadline_s))
        frames = self._fetched(pairing.moments(max(exposed_after_s, used_s)), deadline_s)
        while after_s := pairing.again(frames):
            if self._time.now_s() > deadline_s:
                words = f"no frames of {', '.join(names)} that belong together came within {timeout_s:g} s"
                raise NoFreshFrame(words, device=min(after_s))
            frames |= self._fetched(after_s, deadline_s)
        self._paired_s |= {name: frame.exposure_began_s for name, frame in frames.items()}
        return self._together({name: self._stamped(name, frame) for name, frame in frames.items()})

    def _offsets(self, names: Sequence[str], deadline_s: float) -> dict[str, Offset]:
        """What is known of each camera's times beside the first one's."""
        first = names[0]
        asked: dict[str, Asked[_Times | None]] = {}
        for name in names:
            tell = partial(self._times_of, name)
            left_s = max(0.0, deadline_s - self._time.now_s())
            asked[name] = self._camera_threads[name].submit("recent_times", tell, left_s + self._grace_s)
        times = {
            name: self._camera_threads[name].wait(told, deadline_s + self._grace_s)
            for name, told in asked.items()
        }
        for name in names[1:]:
            before = self._learned.get((first, name))
            try:
                self._learned[first, name] = learned(times[first], times[name], before)
            except Exception as error:
                words = f"the drivers tell no times of {first} and {name}: {type(error).__name__}: {error}"
                raise DriverError(words, device=name) from None
        return {name: self._learned[first, name] for name in names[1:]}

    def _fetched(self, after_s: Mapping[str, float], deadline_s: float) -> dict[str, Frame | StampedFrame]:
        """One frame of each named camera, exposed after its moment."""
        asked: dict[str, Asked[Frame | StampedFrame]] = {}
        for camera, exposed_after_s in after_s.items():
            take = self._taker(camera, exposed_after_s, deadline_s)
            left_s = max(0.0, deadline_s - self._time.now_s())
            asked[camera] = self._camera_threads[camera].submit("next_frame", take, left_s + self._grace_s)
        return {
            camera: self._camera_threads[camera].wait(told, deadline_s + self._grace_s)
            for camera, told in asked.items()
        }

    def _stamped(self, camera: str, frame: Frame | StampedFrame) -> StampedFrame:
        return frame if isinstance(frame, StampedFrame) else self._stamp(camera, frame)

    def _together(self, frames: dict[str, StampedFrame]) -> dict[str, StampedFrame]:
        """Frames that serve one measurement: if the head moved between two exposures, it moved in all."""
        if any(frame.moving for frame in frames.values()):
            moving = True
        else:
            began_s = min(frame.exposure_began_s for frame in frames.values())
            ended_s = max(frame.mid_exposure_s + frame.exposure_s / 2 for frame in frames.values())
            moving = self._history.at_exposure(began_s, (began_s + ended_s) / 2, ended_s, HEAD).moving
        if not moving:
            return frames
        return {name: replace(frame, moving=True) for name, frame in frames.items()}

    def frame_by_id(self, frame_id: str, max_age_s: float | None = None) -> StampedFrame:
        """Return a frame that is still kept.

        Raises
        ------
        NotKnown, NoLonger, NotNow
            ``frame_unknown``, ``frame_too_old`` or ``other_mast_file``.
        """
        frame = self._store.by_id(frame_id)
        age_s = self._clock.now_s() - frame.mid_exposure_s
        if max_age_s is not None and age_s > max_age_s:
            raise NoLonger(
                "frame_too_old", f"frame {frame_id} is {age_s:.0f} s old, at most {max_age_s:.0f} s is taken"
            )
        return frame

    def newest_frames(self) -> dict[str, StampedFrame | None]:
        """Return each configured camera's newest frame, None where there is none yet; asks no camera."""
        return {camera: self._store.newest(camera) for camera in self._cameras}

    @contextmanager
    def exposure_held(self) -> Iterator[None]:
        """Keep every camera's exposure as it is inside the block: a measurement compares its pictures.

        Nothing is waited for; see `mastctl.devices.exposure_hold`.
        """
        holds = [
            ExposureHold(thread, partial(self._cameras.__getitem__, name))
            for name, thread in self._camera_threads.items()
        ]
        begun = [hold for hold in holds if hold.begin()]
        try:
            yield
        finally:
            for hold in begun:
                hold.end()

    # All

    def use_rig(self, rig: Rig, mast_digest: str) -> None:
        """Stamp frames with another mast file from now on, and forget those that were stamped before."""
        self._take_rig(rig)
        self._store.change_mast(mast_digest)

    def _take_rig(self, rig: Rig) -> None:
        self._sizes_px = {name: camera.model.size_px for name, camera in rig.cameras.items()}
        self._on_head = {name for name, camera in rig.cameras.items() if camera.on == "head"}

    def faults(self) -> tuple[Fault, ...]:
        """Return what is wrong with any device now, what the head reports about itself included."""
        found = [*self._head.faults(), *self._stops.faults()]
        reading = self._history.newest
        if reading is not None:
            found += [
                Fault(
                    HEAD, "device_fault", f"{HEAD}: {word}", reading.time_s, "the head no longer reports it"
                )
                for word in reading.faults
            ]
        for thread in self._camera_threads.values():
            found += thread.faults()
        return tuple(found)

    def close(self) -> None:
        """Stop the head and end the threads; takes some 4 s at most and never raises."""
        self.block_moves(self, "the service is closing")
        with self._gate:
            if self._closed:
                return
            self._closed = True
        try:
            self.stop()
        except (DriverError, MastctlError) as error:
            log.error("the head did not confirm the last stop: %s", error)
        until_s = self._time.now_s() + 2.0
        for thread in (self._head, *self._camera_threads.values()):
            thread.close(max(0.1, until_s - self._time.now_s()))

    # In the devices' own threads

    def _read_once(self) -> Reading:
        answer = self._pan_tilt.read()
        newest = self._history.newest
        reading = joint_history.checked(
            answer, HEAD, self._clock.now_s(), None if newest is None else newest.time_s
        )
        reading = self._history.add(reading)
        if reading.faults != self._last_faults:
            self._last_faults = tuple(reading.faults)
            log.warning("%s reports: %s", HEAD, "; ".join(reading.faults) or "healthy again")
        if self._stop_lost and not reading.moving:
            self._stop_lost = False
            self._stops.rests()
        if self._moved is not None and not reading.moving:
            ticket, moved_s = self._moved
            if self._time.now_s() - moved_s > REST_S:
                self._moved = None
                self._stops.proved(ticket)
        return reading

    def _thread_of(self, camera: str) -> DeviceThread:
        """The thread of a camera; that of an absent one looks after it, and tells its absence as a fault."""
        if not isinstance(self._cameras[camera], AbsentCamera):
            return DeviceThread(camera, words=WORDS, clock=self._time)
        words = {**WORDS, "next_frame": Words("it is there, or a picture comes")}
        return DeviceThread(
            camera,
            between=lambda: self._join(camera),
            between_name="next_frame",
            words=words,
            clock=self._time,
        )

    def _join(self, name: str) -> None:
        """Put a camera that was absent at the start in its place, if it is there. Raises DriverError."""
        place = self._cameras[name]
        if isinstance(place, AbsentCamera):
            self._cameras[name] = place.appeared()
            log.warning("%s is here", name)
        self._check_size(name)

    def _check_sizes(self) -> None:
        """Pass cameras that do not tell their size now, or have the mast file's. Raises BadFrame."""
        until_s = self._time.now_s() + SIZE_TIMEOUT_S
        asked = {
            name: thread.submit("size_px", partial(self._check_size, name), SIZE_TIMEOUT_S, told=False)
            for name, thread in self._camera_threads.items()
        }
        for name, told in asked.items():
            try:
                self._camera_threads[name].wait(told, until_s)
            except BadFrame:
                for thread in self._camera_threads.values():
                    thread.close(0.1)
                raise
            except DriverError as error:
                log.warning("%s; the size is seen in its pictures", error)

    def _check_size(self, name: str) -> None:
        """Pass a camera that does not know its size, or has the mast file's. Raises BadFrame."""
        camera = self._cameras[name]
        if isinstance(camera, KnowsSize) and name in self._sizes_px:
            width, height = camera.size_px
            frame_checks.check_size(name, (int(width), int(height)), self._sizes_px[name])

    def _poll(self) -> float:
        return MOVING_PERIOD_S if self._read_once().moving else RESTING_PERIOD_S

    def _reported(self) -> Mapping[str, AxisReport]:
        head = self._pan_tilt
        told = dict(head.report()) if isinstance(head, Reporting) else {}
        for axis in told.values():
            if not isinstance(axis, AxisReport):
                words = f"report returned {type(axis).__name__} where an AxisReport is expected"
                raise BadReply(words, device=HEAD)
        return told

    def _times_of(self, name: str) -> _Times | None:
        """What a camera tells of its frames' times; None if it is not `Paced`."""
        camera = self._cameras[name]
        if not isinstance(camera, Paced):
            return None
        recent = [FrameTime(one.sequence, one.exposure_began_s) for one in camera.recent_times()]
        return _Times(float(camera.period_s), str(camera.trigger), recent)

    def _taker(
        self, camera: str, exposed_after_s: float, deadline_s: float
    ) -> Callable[[], Frame | StampedFrame]:
        def take() -> Frame | StampedFrame:
            newest = self._store.newest(camera)
            if newest is not None and newest.exposure_began_s > exposed_after_s:
                return newest  # somebody else's request brought it a moment ago
            answer = self._cameras[camera].next_frame(
                exposed_after_s, max(0.0, deadline_s - self._time.now_s())
            )
            now_s = self._clock.now_s()
            frame = frame_checks.checked(answer, camera, self._sizes_px.get(camera), exposed_after_s, now_s)
            if newest is not None:
                try:
                    _check_order(frame, newest)
                except BadFrame:  # refused once; a camera that came back counting from 0 goes on after that
                    self._store.begin_again(camera)
                    raise
            return frame

        return take

    # In the caller's thread

    def _stamp(self, camera: str, frame: Frame) -> StampedFrame:
        """Give a frame its joint angles and id, and keep it."""
        began_s = frame.mid_exposure_s - frame.exposure_s / 2
        ended_s = frame.mid_exposure_s + frame.exposure_s / 2
        until_s = self._time.now_s() + READ_TIMEOUT_S
        while (newest := self._history.newest) is None or newest.time_s < ended_s:
            self.read()
            if self._time.now_s() > until_s:
                raise BadReply("the readings stay behind the frame's exposure", device=HEAD)
        joints = self._history.at_exposure(began_s, frame.mid_exposure_s, ended_s, HEAD)
        frame_id, mast_digest = self._store.name(camera, frame.sequence)
        stamped = StampedFrame(
            frame_id=frame_id,
            camera=camera,
            image=frame.image,
            sequence=frame.sequence,
            mid_exposure_s=frame.mid_exposure_s,
            exposure_s=frame.exposure_s,
            pan_rad=joints.pan_rad,
            tilt_rad=joints.tilt_rad,
            moving=joints.moving,
            mast_digest=mast_digest,
        )
        with self._stamping[camera]:
            self._check_alive(stamped)
            return self._store.add(stamped)

    def _check_alive(self, frame: StampedFrame) -> None:
        """Refuse a head camera's picture that did not change at all while the head moved."""
        since = self._still_since.get(frame.camera)
        if since is None or not np.array_equal(since.image, frame.image):
            self._still_since[frame.camera] = frame
            return
        moved_rad = max(abs(frame.pan_rad - since.pan_rad), abs(frame.tilt_rad - since.tilt_rad))
        if frame.camera in self._on_head and moved_rad > MOVED_RAD:
            raise BadFrame(
                f"the picture is frozen: equal to the last bit although the head moved {moved_rad:.6f} rad",
                device=frame.camera,
            )


@dataclass(frozen=True)
class _Times:
    """A camera's times as it told them: what `drivers.pairing.learned` asks for."""

    period_s: float
    trigger: str
    recent: Sequence[FrameTime]

    def recent_times(self) -> Sequence[FrameTime]:
        return self.recent


def _check_order(frame: Frame, newest: StampedFrame) -> None:
    """Refuse a frame whose count and time do not go forward together."""
    ahead = frame.sequence - newest.sequence
    later_s = frame.mid_exposure_s - newest.mid_exposure_s
    if (ahead > 0) != (later_s > 0) or (ahead < 0) != (later_s < 0) or ahead < 0:
        raise BadFrame(
            f"frame {frame.sequence} is {later_s:.3f} s after frame {newest.sequence}: "
            "count and time must grow together",
            device=newest.camera,
        )

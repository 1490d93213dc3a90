"""The cameras as the service uses them: one thread each, sets that belong together, with their facts.

A frame gets the joint angles at its mid-exposure from the head's readings around it. An answer that cannot
be true is an error.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import numpy as np

from calib.geometry.mode import SensorMode
from calib.geometry.rig import Rig, RigCamera
from drivers.absent import AbsentCamera
from drivers.clock import Clock, SystemClock
from drivers.errors import BadFrame, BadReply, DriverError, NoFreshFrame
from drivers.frame_times import Offset, Pace, Pairing, learned
from drivers.interfaces import Camera, Frame, FrameTime, Reading
from mastctl.control.standing import StandingFault
from mastctl.devices import frames as frame_checks
from mastctl.devices.camera_settings import CameraControls
from mastctl.devices.fault_watch import FaultWords
from mastctl.devices.frames import FrameStore, StampedFrame
from mastctl.devices.joint_history import JointHistory
from mastctl.devices.thread import DeviceThread, ThreadCall
from mastctl.errors import NoLonger

log = logging.getLogger(__name__)

READINGS_S = 1.0  # for the head's readings to reach beyond an exposure
SIZE_TIMEOUT_S = 1.0
CAMERA_GRACE_S = 3.0  # beyond the time given to next_frame: copying and decoding on a busy machine
GLANCES_SHARE = 0.1  # of real time that glances hold up a simulation's clock, at most
GLANCE_PATIENCE_S, GLANCE_AGAIN_S = 20.0, 0.5  # of real time, for pictures that are needed
UNTOLD = "%s; the camera is used, and not compared with the mast file in this"
MOVED_RAD = 1e-5  # a head camera's picture that stays the same to the last bit beyond this is frozen
WORDS = {
    "next_frame": FaultWords("a picture comes"),
    "recent_times": FaultWords("a pair of pictures comes"),
    "hold_exposure": FaultWords("an operation can hold the exposure again"),
    "release_exposure": FaultWords("an operation has held and released the exposure again"),
}


class Cameras:
    """The cameras behind their threads.

    Parameters
    ----------
    cameras
        The opened drivers by name; closing them is left to their opener.
    store
        Keeps the frames.
    history, read, head
        The head's readings so far, what takes a new one, and the head's name, for errors.
    clock, time
        Stamps are judged against the one; deadlines run on the other.
    rig
        As in `mastctl.devices.devices.Devices`.
    grace_s
        How long past its time a camera may take before it counts as hanging, seconds; 3 by default.

    Attributes
    ----------
    settings
        The settings of each.
    sensor_modes
        That of each camera that is open and knows it.

    Raises
    ------
    BadFrame
        If a camera that knows its size, or its sensor's mode, has another than the mast file's.
    """

    def __init__(
        self,
        cameras: Mapping[str, Camera],
        store: FrameStore,
        history: JointHistory,
        read: Callable[[], Reading],
        head: str,
        clock: Clock,
        time: Clock,
        rig: Rig | None,
        grace_s: float | None,
    ) -> None:
        self._cameras = dict(cameras)
        self._threads: dict[str, DeviceThread] = {}
        self.settings = CameraControls(self._cameras, self._threads, clock)
        self._store = store
        self._history = history
        self._read = read
        self._head = head
        self._clock = clock
        self._time = time
        self._grace_s = CAMERA_GRACE_S if grace_s is None else grace_s
        self.sensor_modes: dict[str, SensorMode] = {}
        self._refused: dict[str, BadFrame] = {}
        self._calibrated: dict[str, RigCamera] = {}
        if rig is not None:
            self.use_rig(rig)
        self._paired_s: dict[str, float] = {}  # per camera when the last frame that served a set began
        self._learned: dict[tuple[str, str], Offset] = {}
        self._still_since: dict[str, StampedFrame] = {}  # per camera the first frame of the same content
        self._stamping = {name: threading.Lock() for name in self._cameras}
        self._looking = threading.Condition()
        self._looks = Counter[str]()  # calls of `frames` under way, of each camera
        self._people = SystemClock()  # who only watches lives in real time
        self._row: list[object] = []  # where a glance holds up the clock: one after the other as they came
        self._glance_from_s = 0.0  # and not before this moment
        self._threads.update({name: self._thread_of(name) for name in self._cameras})
        if rig is not None:
            self._check_sizes()

    def frames(
        self, cameras: Sequence[str], exposed_after_s: float, timeout_s: float
    ) -> dict[str, StampedFrame]:
        """Return one frame of each camera, asked for in parallel, with its facts; before any `glance`.

        Frames of several cameras belong together (`drivers.frame_times`): exposed at one trigger, or nearest
        in time. Each serves one such set. All are ``moving`` if the head moved at any time from the first
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
        names = tuple(dict.fromkeys(cameras))
        with self._looking:
            self._looks.update(names)
        try:
            return self._look(names, exposed_after_s, timeout_s)
        finally:
            with self._looking:
                self._looks.subtract(names)
                self._looking.notify_all()

    def glance(
        self, camera: str, exposed_after_s: float, max_age_s: float, timeout_s: float, told: bool = False
    ) -> StampedFrame:
        """Return a frame for somebody who only watches, and who is never in the way of `frames`.

        A frame that somebody needed serves, if it is new enough. The camera itself is asked only while no
        call of `frames` waits for it; on a clock that stands while a picture is made, while none waits for
        any camera, and for `GLANCES_SHARE` of real time at most. Not for who is at work on such a clock.

        Parameters
        ----------
        camera
            The name of a configured camera.
        exposed_after_s, max_age_s
            The exposure began after that moment of CLOCK_MONOTONIC, and at most so long ago, seconds.
        timeout_s
            What the camera is given, seconds.
        told
            Whether the frame is told of, and recorded.

        Raises
        ------
        NoFreshFrame
            Also if only needed frames were taken for `GLANCE_PATIENCE_S`, and none new enough.
        BadFrame, NoReply, DriverError, BadReply
            As `frames`.
        """
        place = object()
        with self._looking:
            self._row.append(place)
        try:
            return self._in_turn(place, camera, exposed_after_s, max_age_s, timeout_s, told)
        finally:
            with self._looking:
                self._row.remove(place)
                self._looking.notify_all()

    def _in_turn(
        self,
        place: object,
        camera: str,
        exposed_after_s: float,
        max_age_s: float,
        timeout_s: float,
        told: bool,
    ) -> StampedFrame:
        until_s = self._people.now_s() + GLANCE_PATIENCE_S
        while True:
            after_s = max(exposed_after_s, self._clock.now_s() - max_age_s)
            newest = self._store.newest(camera)
            if newest is not None and newest.exposure_began_s > after_s:
                return self._stamped(camera, newest, told)
            with self._looking:
                began_s = self._people.now_s()
                if self._in_the_way(camera, place):
                    if began_s > until_s:
                        raise NoFreshFrame("all pictures taken now are needed elsewhere", device=camera)
                    early_s = self._glance_from_s - began_s
                    self._looking.wait(early_s if early_s > 0.0 else GLANCE_AGAIN_S)
                    continue
            try:
                frame = self._glanced(camera, self._known_from(after_s), self._time.now_s() + timeout_s)
                if frame is not None:
                    return self._stamped(camera, frame, told)
            finally:
                with self._looking:
                    ended_s = self._people.now_s()
                    self._glance_from_s = ended_s + (ended_s - began_s) * (1.0 / GLANCES_SHARE - 1.0)

    def _in_the_way(self, camera: str, place: object) -> bool:
        """Whether a glance would hold anybody up."""
        if not self._clock.stands_for_work:
            return self._looks[camera] > 0
        early = self._people.now_s() < self._glance_from_s
        return early or self._row[0] is not place or any(count > 0 for count in self._looks.values())

    def _glanced(self, camera: str, after_s: float, deadline_s: float) -> Frame | StampedFrame | None:
        """A frame for watching; None where somebody needs one of that camera before it is begun."""
        take = self._taker(camera, after_s, deadline_s)

        def unless_needed() -> Frame | StampedFrame | None:
            return None if self._looks[camera] > 0 else take()

        left_s = max(0.0, deadline_s - self._time.now_s())
        asked = self._threads[camera].submit("next_frame", unless_needed, left_s + self._grace_s)
        return self._threads[camera].wait(asked, deadline_s + self._grace_s)

    def _known_from(self, exposed_after_s: float) -> float:
        """The moment, or a later one before which nobody knows where the head stood."""
        if (oldest_s := self._history.oldest_s) is None:
            oldest_s = self._read().time_s
        return max(exposed_after_s, oldest_s)

    def _look(
        self, names: Sequence[str], exposed_after_s: float, timeout_s: float
    ) -> dict[str, StampedFrame]:
        deadline_s = self._time.now_s() + timeout_s
        exposed_after_s = self._known_from(exposed_after_s)
        if len(names) < 2:
            frames = self._fetched(dict.fromkeys(names, exposed_after_s), deadline_s)
            return {name: self._stamped(name, frame, True) for name, frame in frames.items()}
        used_s = max(self._paired_s.get(name, -math.inf) for name in names)
        pairing = Pairing(names[0], self._offsets(names, deadline_s))
        frames = self._fetched(pairing.moments(max(exposed_after_s, used_s)), deadline_s)
        while after_s := pairing.again(frames):
            if self._time.now_s() > deadline_s:
                words = f"no frames of {', '.join(names)} that belong together came within {timeout_s:g} s"
                raise NoFreshFrame(words, device=min(after_s))
            frames |= self._fetched(after_s, deadline_s)
        self._paired_s |= {name: frame.exposure_began_s for name, frame in frames.items()}
        return self._together({name: self._stamped(name, frame, True) for name, frame in frames.items()})

    def _offsets(self, names: Sequence[str], deadline_s: float) -> dict[str, Offset]:
        """What is known of each camera's times beside the first one's."""
        first = names[0]
        asked: dict[str, ThreadCall[Pace | None]] = {}
        for name in names:
            tell = partial(self._pace_of, name)
            left_s = max(0.0, deadline_s - self._time.now_s())
            asked[name] = self._threads[name].submit("recent_times", tell, left_s + self._grace_s)
        times = {
            name: self._threads[name].wait(told, deadline_s + self._grace_s) for name, told in asked.items()
        }
        for name in names[1:]:
            before = self._learned.get((first, name))
            try:
                self._learned[first, name] = learned(times[first], times[name], before)
            except Exception as error:
                words = f"the drivers give no times of {first} and {name}: {type(error).__name__}: {error}"
                raise DriverError(words, device=name) from None
        return {name: self._learned[first, name] for name in names[1:]}

    def _fetched(self, after_s: Mapping[str, float], deadline_s: float) -> dict[str, Frame | StampedFrame]:
        """One frame of each named camera, exposed after its moment."""
        asked: dict[str, ThreadCall[Frame | StampedFrame]] = {}
        for camera, exposed_after_s in after_s.items():
            take = self._taker(camera, exposed_after_s, deadline_s)
            left_s = max(0.0, deadline_s - self._time.now_s())
            asked[camera] = self._threads[camera].submit("next_frame", take, left_s + self._grace_s)
        return {
            camera: self._threads[camera].wait(told, deadline_s + self._grace_s)
            for camera, told in asked.items()
        }

    def _stamped(self, camera: str, frame: Frame | StampedFrame, told: bool) -> StampedFrame:
        if not isinstance(frame, StampedFrame):
            return self._stamp(camera, frame, told)
        if told:
            self._store.tell(frame)  # until now it was only watched
        return frame

    def _together(self, frames: dict[str, StampedFrame]) -> dict[str, StampedFrame]:
        """Frames that serve one measurement: if the head moved between two exposures, it moved in all."""
        if any(frame.moving for frame in frames.values()):
            moving = True
        else:
            began_s = min(frame.exposure_began_s for frame in frames.values())
            ended_s = max(frame.mid_exposure_s + frame.exposure_s / 2 for frame in frames.values())
            moving = self._history.at_exposure(began_s, (began_s + ended_s) / 2, ended_s, self._head).moving
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

    def hold(self, frame: StampedFrame, by: str, kept: int) -> None:
        """Keep a frame for who looks at it, as `mastctl.devices.frames.FrameStore.hold`."""
        self._store.hold(frame, by, kept)

    def let_go(self, by: str) -> None:
        """Hold nothing more for somebody."""
        self._store.let_go(by)

    def newest_frames(self) -> dict[str, StampedFrame | None]:
        """Return each configured camera's newest frame, None where there is none yet; asks no camera."""
        return {camera: self._store.newest(camera) for camera in self._cameras}

    @contextmanager
    def exposure_held(self) -> Iterator[None]:
        """Keep every camera's exposure as it is inside the block: a measurement compares its pictures.

        Nothing is waited for; see `mastctl.devices.camera_settings`.
        """
        holds = [self.settings.hold(name) for name in self._threads]
        begun = [hold for hold in holds if hold.begin()]
        try:
            yield
        finally:
            for hold in begun:
                hold.end()

    def use_rig(self, rig: Rig) -> None:
        """Judge pictures by another mast file's sizes and mounts from now on."""
        self._calibrated = dict(rig.cameras)
        self.settings.calibrated()

    def faults(self) -> list[StandingFault]:
        """Return what is wrong with any camera now."""
        own = [fault for thread in self._threads.values() for fault in thread.faults()]
        return own + self.settings.faults()

    def errors(self) -> dict[tuple[str, str, str], int]:
        """Return how often calls have failed since the start: by camera, call, and the error's code."""
        return {
            (name, *kind): count
            for name, thread in self._threads.items()
            for kind, count in thread.errors().items()
        }

    def counts(self) -> dict[str, tuple[int, int]]:
        """Return how many frames each camera sent, and how many of its frames were lost or damaged."""
        found = {}
        for name, camera in self._cameras.items():
            counters = camera.counters
            if counters is not None:
                found[name] = counters.good, counters.damaged + counters.dropped
        return found

    def close(self, until_s: float) -> None:
        """End the threads; waits until a moment of the deadlines' clock, and for each 0.1 s at least."""
        for thread in self._threads.values():
            thread.close(max(0.1, until_s - self._time.now_s()))

    # In the cameras' own threads

    def _thread_of(self, camera: str) -> DeviceThread:
        """The thread of a camera; that of an absent one looks after it, and tells its absence as a fault."""
        if not isinstance(self._cameras[camera], AbsentCamera):
            return DeviceThread(camera, words=WORDS, clock=self._time)
        words = {**WORDS, "next_frame": FaultWords("it is there, or a picture comes")}
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
        try:
            self._check_as_calibrated(name)
        except BadFrame as refused:
            self._refused[name] = refused
            raise
        except Exception as error:
            if name in self._refused:  # until it is seen to be right
                raise
            log.warning(UNTOLD, error if isinstance(error, DriverError) else f"{name}: {error!r}")
        self._refused.pop(name, None)

    def _check_sizes(self) -> None:
        """Pass cameras that are as calibrated, or do not tell it now. Raises BadFrame."""
        until_s = self._time.now_s() + SIZE_TIMEOUT_S
        asked = {
            name: thread.submit("info", partial(self._check_as_calibrated, name), SIZE_TIMEOUT_S, told=False)
            for name, thread in self._threads.items()
        }
        for name, told in asked.items():
            try:
                self._threads[name].wait(told, until_s)
            except BadFrame:
                for thread in self._threads.values():
                    thread.end()
                raise
            except DriverError as error:
                log.warning(UNTOLD, error)

    def _check_as_calibrated(self, name: str) -> None:
        """Pass a camera whose sensor mode and size, as far as it knows them, are the mast file's.

        Raises
        ------
        BadFrame
            If one is not.
        BadReply
            If it returns something else than a sensor mode, or than a size.
        Exception
            That of a driver that fails to answer.
        """
        calibrated = self._calibrated.get(name)
        info = self._cameras[name].info
        # The mode first: its refusal says better than that of the size what would mend it.
        self._check_mode(name, info.sensor_mode, calibrated)
        if info.size_px is not None and calibrated is not None:
            try:
                width, height = (int(side) for side in info.size_px)
            except (TypeError, ValueError, OverflowError):
                words = f"info.size_px is {type(info.size_px).__name__} where (width, height) is expected"
                raise BadReply(words, device=name) from None
            frame_checks.check_size(name, (width, height), calibrated.model.size_px)

    def _check_mode(self, name: str, mode: SensorMode | None, calibrated: RigCamera | None) -> None:
        if mode is None:
            return
        if not isinstance(mode, SensorMode):
            words = f"info.sensor_mode is {type(mode).__name__} where a SensorMode is expected"
            raise BadReply(words, device=name)
        self.sensor_modes[name] = mode
        if calibrated is not None and (then := calibrated.sensor_mode) is not None:
            frame_checks.check_mode(name, mode, then)
            if mode.crop_px is None and then.crop_px is not None:
                log.warning(
                    "%s: its driver does not report which part of its sensor is read; the crop "
                    "is not compared with the mast file's",
                    name,
                )

    def _pace_of(self, name: str) -> Pace | None:
        """What a camera states of its frames' times; None for one without a steady rate."""
        camera = self._cameras[name]
        info = camera.info
        if info.period_s is None:
            return None
        recent = [FrameTime(one.sequence, one.exposure_began_s) for one in camera.recent_times()]
        return Pace(float(info.period_s), str(info.trigger), recent)

    def _taker(
        self, camera: str, exposed_after_s: float, deadline_s: float
    ) -> Callable[[], Frame | StampedFrame]:
        def take() -> Frame | StampedFrame:
            newest = self._store.newest(camera)
            if newest is not None and newest.exposure_began_s > exposed_after_s:
                return newest  # somebody else's request brought it a moment ago
            if camera in self._refused:
                raise BadFrame(str(self._refused[camera]))
            answer = self._cameras[camera].next_frame(
                exposed_after_s, max(0.0, deadline_s - self._time.now_s())
            )
            now_s = self._clock.now_s()
            known = self._calibrated.get(camera)
            size_px = None if known is None else known.model.size_px
            frame = frame_checks.checked(answer, camera, size_px, exposed_after_s, now_s)
            if newest is not None:
                try:
                    _check_order(frame, newest)
                except BadFrame:  # refused once; a camera that came back counting from 0 goes on after that
                    self._store.begin_again(camera)
                    raise
            return frame

        return take

    # In the caller's thread

    def _stamp(self, camera: str, frame: Frame, told: bool) -> StampedFrame:
        """Give a frame its joint angles and id, and keep it."""
        began_s = frame.mid_exposure_s - frame.exposure_s / 2
        ended_s = frame.mid_exposure_s + frame.exposure_s / 2
        until_s = self._time.now_s() + READINGS_S
        while (newest := self._history.newest) is None or newest.time_s < ended_s:
            if self._read().time_s < ended_s and self._time.now_s() > until_s:
                raise BadReply("the readings stay behind the frame's exposure", device=self._head)
        joints = self._history.at_exposure(began_s, frame.mid_exposure_s, ended_s, self._head)
        frame_id, mast_digest = self._store.name(camera, frame.sequence)
        stamped = StampedFrame(
            frame_id=frame_id,
            camera=camera,
            image=frame.image,
            jpeg=frame.jpeg,
            sequence=frame.sequence,
            mid_exposure_s=frame.mid_exposure_s,
            exposure_s=frame.exposure_s,
            pan_rad=joints.pan_rad,
            tilt_rad=joints.tilt_rad,
            moving=joints.moving,
            mast_digest=mast_digest,
            true_pan_rad=joints.true_rad[0],
            true_tilt_rad=joints.true_rad[1],
            pan_approach=joints.approach[0],
            tilt_approach=joints.approach[1],
            settings=frame.settings,
        )
        with self._stamping[camera]:
            self._check_alive(stamped)
            return self._store.add(stamped, told)

    def _check_alive(self, frame: StampedFrame) -> None:
        """Refuse a head camera's picture that did not change at all while the head moved."""
        since = self._still_since.get(frame.camera)
        if since is None or not np.array_equal(since.image, frame.image):
            self._still_since[frame.camera] = frame
            return
        moved_rad = max(abs(frame.pan_rad - since.pan_rad), abs(frame.tilt_rad - since.tilt_rad))
        known = self._calibrated.get(frame.camera)
        if known is not None and known.on == "head" and moved_rad > MOVED_RAD:
            raise BadFrame(
                f"the picture is frozen: equal to the last bit although the head moved {moved_rad:.6f} rad",
                device=frame.camera,
            )


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

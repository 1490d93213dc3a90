"""The cameras as the service uses them: one thread each, settings, sets of frames that belong together."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np

from calib.geometry.mode import SensorMode
from calib.geometry.rig import JointErrors, Rig, RigCamera
from drivers.absent import AbsentCamera
from drivers.clock import Clock, deadlines_on
from drivers.errors import BadFrame, BadReply, DriverError, NoFreshFrame
from drivers.frame_times import Offset, Pace, Pairing, learned
from drivers.interfaces import Camera, CameraSetting, Frame, FrameTime, Reading
from mastctl.devices.frames import (
    FrameStore,
    StampedFrame,
    check_known,
    check_mode,
    check_order,
    check_size,
    check_wanted,
    checked,
    checked_setting,
)
from mastctl.devices.joint_history import JointHistory
from mastctl.devices.thread import Check, DeviceThread
from mastctl.errors import NotNow

log = logging.getLogger(__name__)
T = TypeVar("T")

HEAD = "pan_tilt"
READINGS_S = 1.0  # for the head's readings to reach beyond an exposure
SIZE_TIMEOUT_S = 1.0
CAMERA_GRACE_S = 3.0  # beyond the time given to next_frame: copying and decoding on a busy machine
NOT_COMPARED = "%s; the camera is used, and not compared with the mast file in this"
MOVED_RAD = 1e-5  # a head camera's image that stays the same to the last bit beyond this is frozen
FAULTS = {
    "next_frame": "a picture comes",
    "recent_times": "a pair of pictures comes",
    "hold_exposure": "an operation can hold the exposure again",
    "release_exposure": "an operation has held and released the exposure again",
}

FIX_TIMEOUT_S = 3.0  # a driver waits up to 2 s for changes under way to show
SET_TIMEOUT_S = 2.0


class Cameras:
    """The part of `mastctl.devices.devices.Devices` that takes images; a subclass reads the head.

    ``store`` has the frames that are kept. ``sensor_modes`` says which pixels of its sensor each camera's
    images show, of those that are open and know it. Raises BadFrame if a camera that knows its size, or its
    sensor's mode, has not the mast file's.
    """

    def __init__(
        self,
        cameras: Mapping[str, Camera],
        store: FrameStore,
        clock: Clock,
        rig: Rig | None,
        grace_s: float = CAMERA_GRACE_S,
    ) -> None:
        self.store = store
        self.sensor_modes: dict[str, SensorMode] = {}
        self._cameras = dict(cameras)
        self._clock = clock
        self._time = deadlines_on(clock)
        self._grace_s = grace_s
        self._joints = JointErrors() if rig is None else rig.joints
        self._history = JointHistory(self._joints)
        self._calibrated: dict[str, RigCamera] = {} if rig is None else dict(rig.cameras)
        self._fixed = Counter[str]()  # by how many operations, of each camera, counted in its own thread
        self._paired_s: dict[str, float] = {}  # per camera when the last frame that served a set began
        self._learned: dict[tuple[str, str], Offset] = {}
        self._still_since: dict[str, StampedFrame] = {}  # per camera the first frame of the same content
        self._threads = {name: self._thread_of(name) for name in self._cameras}
        if rig is not None:
            self._check_sizes()

    def read(self) -> Reading:
        """Return the joint state measured now. Raises NoReply, BadReply, DriverError."""
        raise NotImplementedError

    def settings(self, camera: str) -> tuple[list[CameraSetting], bool]:
        """Return what a camera is set to, and whether an operation keeps it; empty if nothing can change.

        Raises NotKnown; NoReply, BadReply, DriverError if the camera does not answer within 2 s.
        """
        check_known(camera, self._cameras)
        return self._threads[camera].call(
            "settings",
            lambda: (self._settings_of(camera), self._fixed[camera] > 0),
            SET_TIMEOUT_S,
            noted=False,
        )

    def change_settings(self, camera: str, wanted: Mapping[str, float]) -> list[str]:
        """Change some of a camera's settings; return sentences about what became another than wanted.

        Raises BadSetting for one that it lacks, cannot change, or that is out of its bounds; NotNow ``busy``
        if an operation keeps them; else as `settings`.
        """
        check_known(camera, self._cameras)

        def change() -> list[str]:
            if self._fixed[camera]:
                why = "an operation compares its pictures and keeps its settings; wait for it or stop it"
                raise NotNow("busy", f"{camera}: {why}")
            before = self._settings_of(camera)
            notes = [str(note) for note in self._cameras[camera].adjust(check_wanted(before, wanted, camera))]
            had = next((one.value for one in before if one.name == "focus"), None)
            if had is not None and wanted.get("focus", had) != had:
                notes.append(f"{camera}: its focus was {had:g}; a mast file is of one focus alone")
            return notes

        return self._threads[camera].call("adjust", change, SET_TIMEOUT_S, noted=False)

    @contextmanager
    def exposure_fixed(self) -> Iterator[None]:
        """Keep every camera's exposure and settings as they are inside the block.

        Both ends are queued in each camera's own thread, and no caller waits for them. The beginning comes
        before every image that is taken after it, the end after the beginning, however late that is. So a
        camera that hangs or refuses keeps no operation waiting; its fault says so.
        """
        stacks = {name: ExitStack() for name in self._cameras}

        def begin(name: str) -> None:
            self._fixed[name] += 1
            stacks[name].callback(self._fixed.subtract, [name])
            stacks[name].enter_context(self._cameras[name].exposure_held())

        def queue(call: str, name: str, function: Callable[[], None]) -> None:
            with suppress(DriverError):  # closed, and with it the camera
                self._threads[name].submit(call, function, FIX_TIMEOUT_S)

        for name in stacks:
            queue("hold_exposure", name, partial(begin, name))
        try:
            yield
        finally:
            for name, stack in stacks.items():
                queue("release_exposure", name, stack.close)

    def frames(
        self,
        cameras: Sequence[str],
        exposed_after_s: float,
        timeout_s: float,
        check: Check | None = None,
    ) -> dict[str, StampedFrame]:
        """Return one frame of each camera, taken in parallel, in the order of the names, with its facts.

        Frames of several cameras belong together (`drivers.frame_times`): exposed at one trigger, or nearest
        in time. Each serves one such set. All are ``moving`` if the head moved at any time from the first
        exposure to the end of the last.

        Every exposure began after ``exposed_after_s``, seconds of CLOCK_MONOTONIC. Each camera is given
        ``timeout_s``; the call ends at most the grace and 1 s later. ``check`` is called while frames are
        waited for; what it raises ends the wait.

        Raises NotKnown ``unknown_camera``; NoFreshFrame, BadFrame, NoReply, DriverError of the first camera
        that did not deliver; BadReply if the head's readings do not reach around an exposure.
        """
        for camera in cameras:
            check_known(camera, self._cameras)
        names = tuple(dict.fromkeys(cameras))
        deadline_s = self._time.now_s() + timeout_s
        exposed_after_s = self._known_from(exposed_after_s)
        if len(names) < 2:
            frames = self._fetched(dict.fromkeys(names, exposed_after_s), deadline_s, check)
            return {name: self._stamped(name, frame) for name, frame in frames.items()}
        used_s = max(self._paired_s.get(name, -math.inf) for name in names)
        pairing = Pairing(names[0], self._offsets(names, deadline_s))
        frames = self._fetched(pairing.moments(max(exposed_after_s, used_s)), deadline_s, check)
        while after_s := pairing.again(frames):
            if self._time.now_s() > deadline_s:
                message = f"no frames of {', '.join(names)} that belong together came within {timeout_s:g} s"
                raise NoFreshFrame(message, device=min(after_s))
            frames |= self._fetched(after_s, deadline_s, check)
        self._paired_s |= {name: frame.exposure_began_s for name, frame in frames.items()}
        return self._together({name: self._stamped(name, frame) for name, frame in frames.items()})

    def watched_frame(
        self, camera: str, exposed_after_s: float, max_age_s: float, timeout_s: float
    ) -> StampedFrame:
        """Return a frame of one camera for those that only watch: it is not published.

        Its exposure began after that moment of CLOCK_MONOTONIC, and at most so long ago, seconds. One that an
        operation took serves. Raises as `frames`.
        """
        after_s = max(exposed_after_s, self._clock.now_s() - max_age_s)
        newest = self.store.newest(camera)
        if newest is not None and newest.exposure_began_s > after_s:
            return newest
        deadline_s = self._time.now_s() + timeout_s
        frames = self._fetched({camera: self._known_from(after_s)}, deadline_s)
        return self._stamped(camera, frames[camera], published=False)

    def newest_frames(self) -> dict[str, StampedFrame | None]:
        """Return each configured camera's newest frame, None where there is none yet; takes no image."""
        return {camera: self.store.newest(camera) for camera in self._cameras}

    def frame_counts(self) -> dict[str, tuple[int, int]]:
        """Return how many frames were received and missed, of each camera whose driver counts them."""
        counters = {name: camera.counters for name, camera in self._cameras.items()}
        return {
            name: (one.good, one.damaged + one.dropped) for name, one in counters.items() if one is not None
        }

    # In the cameras' own threads

    def _thread_of(self, camera: str) -> DeviceThread:
        """The thread of a camera; that of an absent one opens it when it comes; its absence is a fault."""
        absent = isinstance(self._cameras[camera], AbsentCamera)
        faults = FAULTS | ({"next_frame": "it is there, or a picture comes"} if absent else {})
        thread = DeviceThread(camera, faults=faults, clock=self._time)
        if absent:
            thread.poll("next_frame", partial(self._join, camera), 1.0)
        return thread

    def _join(self, name: str) -> None:
        """Put a camera that was absent at the start in its place, if it is there. Raises DriverError."""
        place = self._cameras[name]
        if isinstance(place, AbsentCamera):
            camera = place.appeared()
            self._check_as_calibrated(name, camera)
            self._cameras[name] = camera
            log.warning("%s is present", name)

    def _check_sizes(self) -> None:
        """Pass cameras that are as calibrated, or do not answer now. Raises BadFrame."""
        for name, thread in self._threads.items():
            check = partial(self._check_as_calibrated, name, self._cameras[name])
            try:
                thread.call("info", check, SIZE_TIMEOUT_S, noted=False)
            except BadFrame:
                for one in self._threads.values():
                    one.end()
                raise
            except DriverError as error:
                log.warning(NOT_COMPARED, error)

    def _check_as_calibrated(self, name: str, camera: Camera) -> None:
        """Pass a camera whose sensor mode and size, as far as it knows them, are the mast file's.

        Raises BadFrame if one is not, and what its driver raises.
        """
        info, calibrated = camera.info, self._calibrated.get(name)
        mode, then = info.sensor_mode, None if calibrated is None else calibrated.sensor_mode
        # The mode first: its refusal says better than that of the size what would mend it.
        if isinstance(mode, SensorMode):
            self.sensor_modes[name] = mode
            if then is not None:
                check_mode(name, mode, then)
        if info.size_px is not None and calibrated is not None:
            width, height = map(int, info.size_px)
            check_size(name, (width, height), calibrated.model.size_px)

    def _settings_of(self, camera: str) -> list[CameraSetting]:
        return [checked_setting(one, camera) for one in self._cameras[camera].settings()]

    def _pace_of(self, name: str) -> Pace | None:
        """What a camera states of its frames' times; None for one without a steady rate."""
        camera = self._cameras[name]
        info = camera.info
        if info.period_s is None:
            return None
        recent = [FrameTime(one.sequence, one.exposure_began_s) for one in camera.recent_times()]
        return Pace(float(info.period_s), str(info.trigger), recent)

    def _take(self, camera: str, exposed_after_s: float, deadline_s: float) -> Frame | StampedFrame:
        newest = self.store.newest(camera)
        if newest is not None and newest.exposure_began_s > exposed_after_s:
            return newest  # another request brought it a moment ago
        self._join(camera)
        left_s = max(0.0, deadline_s - self._time.now_s())
        answer = self._cameras[camera].next_frame(exposed_after_s, left_s)
        known = self._calibrated.get(camera)
        size_px = None if known is None else known.model.size_px
        frame = checked(answer, camera, size_px, exposed_after_s, self._clock.now_s())
        if newest is not None:
            try:
                check_order(frame, newest)
            except BadFrame:  # refused once; a camera that came back counting from 0 goes on after that
                self.store.begin_again(camera)
                raise
        return frame

    # In the caller's thread

    def _known_from(self, exposed_after_s: float) -> float:
        """The moment, or a later one before which the place of the head is not known."""
        if (oldest_s := self._history.oldest_s) is None:
            oldest_s = self.read().time_s
        return max(exposed_after_s, oldest_s)

    def _offsets(self, names: Sequence[str], deadline_s: float) -> dict[str, Offset]:
        """What is known of each camera's times beside the first one's."""
        first = names[0]
        paces = {name: partial(self._pace_of, name) for name in names}
        times = self._in_parallel("recent_times", paces, deadline_s)
        for name in names[1:]:
            before = self._learned.get((first, name))
            try:
                self._learned[first, name] = learned(times[first], times[name], before)
            except Exception as error:
                message = f"the drivers give no times of {first} and {name}: {type(error).__name__}: {error}"
                raise DriverError(message, device=name) from None
        return {name: self._learned[first, name] for name in names[1:]}

    def _fetched(
        self, after_s: Mapping[str, float], deadline_s: float, check: Check | None = None
    ) -> dict[str, Frame | StampedFrame]:
        """One frame of each named camera, exposed after its moment."""
        takes = {name: partial(self._take, name, moment, deadline_s) for name, moment in after_s.items()}
        return self._in_parallel("next_frame", takes, deadline_s, check)

    def _in_parallel(
        self,
        call: str,
        functions: Mapping[str, Callable[[], T]],
        deadline_s: float,
        check: Check | None = None,
    ) -> dict[str, T]:
        """What functions return in the threads of the cameras that they are named by."""
        timeout_s = max(0.0, deadline_s - self._time.now_s()) + self._grace_s
        calls = {name: self._threads[name].submit(call, one, timeout_s) for name, one in functions.items()}
        late_s = deadline_s + self._grace_s
        return {name: self._threads[name].wait(one, late_s, check) for name, one in calls.items()}

    def _together(self, frames: dict[str, StampedFrame]) -> dict[str, StampedFrame]:
        """Frames that serve one measurement: if the head moved between two exposures, it moved in all."""
        moving = any(frame.moving for frame in frames.values())
        if not moving:
            began_s = min(frame.exposure_began_s for frame in frames.values())
            ended_s = max(frame.mid_exposure_s + frame.exposure_s / 2 for frame in frames.values())
            middle_s = (began_s + ended_s) / 2
            moving = self._history.at_exposure(began_s, middle_s, ended_s, HEAD).moving
        return {name: replace(frame, moving=True) for name, frame in frames.items()} if moving else frames

    def _stamped(self, camera: str, frame: Frame | StampedFrame, published: bool = True) -> StampedFrame:
        """Give a frame its joint angles and id, and keep it."""
        if isinstance(frame, StampedFrame):
            if published:
                self.store.publish(frame)  # until now it was only watched
            return frame
        began_s, ended_s = frame.exposure_began_s, frame.mid_exposure_s + frame.exposure_s / 2
        until_s = self._time.now_s() + READINGS_S
        while (newest := self._history.newest) is None or newest.time_s < ended_s:
            if self.read().time_s < ended_s and self._time.now_s() > until_s:
                raise BadReply("the readings stay behind the frame's exposure", device=HEAD)
        joints = self._history.at_exposure(began_s, frame.mid_exposure_s, ended_s, HEAD)
        frame_id, mast_digest = self.store.name(camera, frame.sequence)
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
        self._check_alive(stamped)
        kept = self.store.add(stamped)
        if published:
            self.store.publish(kept)
        return kept

    def _check_alive(self, frame: StampedFrame) -> None:
        """Refuse a head camera's image that did not change at all while the head moved."""
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

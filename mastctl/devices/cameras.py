"""The cameras as the service uses them: one thread each, settings, sets of frames that belong together."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from calib.geometry.mode import SensorMode
from calib.geometry.rig import Rig, RigCamera
from drivers.absent import AbsentCamera
from drivers.clock import Clock
from drivers.errors import BadFrame, BadReply, BadSetting, DriverError, NoFreshFrame
from drivers.frame_times import Offset, Pace, Pairing, learned
from drivers.interfaces import SETTINGS, Camera, CameraSetting, Frame, FrameTime, Reading
from mastctl.control.machine import StandingFault
from mastctl.devices import frames as frame_checks
from mastctl.devices.frames import KEPT_FRAMES, REQUESTED, FrameStore, StampedFrame, check_known
from mastctl.devices.joint_history import JointHistory
from mastctl.devices.thread import Check, DeviceThread, ThreadCall
from mastctl.errors import NoLonger, NotNow

log = logging.getLogger(__name__)

READINGS_S = 1.0  # for the head's readings to reach beyond an exposure
SIZE_TIMEOUT_S = 1.0
CAMERA_GRACE_S = 3.0  # beyond the time given to next_frame: copying and decoding on a busy machine
WATCHED_SHARE = 0.1  # of real time that watched frames may keep a simulation's clock from going on
NOT_COMPARED = "%s; the camera is used, and not compared with the mast file in this"
MOVED_RAD = 1e-5  # a head camera's image that stays the same to the last bit beyond this is frozen
FAULTS = {
    "next_frame": "a picture comes",
    "recent_times": "a pair of pictures comes",
    "hold_exposure": "an operation can hold the exposure again",
    "release_exposure": "an operation has held and released the exposure again",
}

HOLD_TIMEOUT_S = 3.0  # a driver waits up to 2 s for changes under way to show
SET_TIMEOUT_S = 2.0


class CameraControls:
    """The settings of all cameras, changed between operations; safe from any thread.

    ``cameras`` and ``threads`` may get other entries later. ``clock`` stamps the faults.
    """

    def __init__(
        self, cameras: Mapping[str, Camera], threads: Mapping[str, DeviceThread], clock: Clock
    ) -> None:
        self._cameras = cameras
        self._threads = threads
        self._clock = clock
        self._holds = Counter[str]()  # of each camera, counted in its own thread
        self._refocused: Mapping[str, _Refocused] = {}  # replaced, never edited

    def of(self, name: str) -> tuple[list[CameraSetting], bool]:
        """Return what a camera is set to, and whether an operation keeps it; empty if nothing can change.

        Raises NotKnown; NoReply, BadReply, DriverError if the camera does not answer within 2 s.
        """
        check_known(name, self._cameras)
        return self._threads[name].call("settings", lambda: self._read(name), SET_TIMEOUT_S, noted=False)

    def change(self, name: str, wanted: Mapping[str, float]) -> list[str]:
        """Change some of a camera's settings; return a sentence for each that became another than wanted.

        Raises BadSetting for one that it lacks, cannot change, or that is out of its bounds; NotNow ``busy``
        if an operation keeps them; else as `of`.
        """
        check_known(name, self._cameras)

        def change() -> list[str]:
            if self._holds[name]:
                why = "an operation compares its pictures and holds its settings; wait for it or stop it"
                raise NotNow("busy", f"{name}: {why}")
            before, _ = self._read(name)
            changes = check_wanted(before, wanted, name)
            try:
                notes = [str(note) for note in self._cameras[name].adjust(changes)]
            except BaseException:
                with suppress(Exception):  # the first error counts
                    self._note_focus(name, wanted, before)
                raise
            self._note_focus(name, wanted, before)
            return notes

        return self._threads[name].call("adjust", change, SET_TIMEOUT_S, noted=False)

    def hold(self, name: str) -> Callable[[], None]:
        """Keep a camera's exposure and settings as they are; return what ends that.

        Both ends are queued in the camera's own thread, and no caller waits for them. The beginning comes
        before every image that is taken after it, the end after the beginning, however late that is. So a
        camera that hangs or refuses keeps no operation waiting; its fault says so.
        """
        stack = ExitStack()

        def enter() -> None:
            self._holds[name] += 1
            stack.callback(self._holds.subtract, [name])
            stack.enter_context(self._cameras[name].exposure_held())

        def release() -> None:
            with suppress(DriverError):  # closed, and with it the camera
                self._threads[name].submit("release_exposure", stack.close, HOLD_TIMEOUT_S, anyway=True)

        try:
            self._threads[name].submit("hold_exposure", enter, HOLD_TIMEOUT_S)
        except DriverError:  # overdue or closed: its fault says so already, and it takes no images
            return lambda: None
        return release

    def calibrated(self) -> None:
        """Treat the focus that each camera has now as that of the mast file, which came into use."""
        self._refocused = {}

    def faults(self) -> list[StandingFault]:
        """Return a fault for each camera that has another focus than it was calibrated with."""
        return [
            StandingFault(
                name,
                "refocused",
                f"{name}: its focus is {one.now:g} and was {one.calibrated:g} when the mast file came into "
                "use; the calibration is not of this focus",
                one.since_s,
                f"its focus is {one.calibrated:g} again, or another mast file is in use",
            )
            for name, one in self._refocused.items()
        ]

    def _read(self, name: str) -> tuple[list[CameraSetting], bool]:
        """In the camera's thread: what it states, if that can be."""
        return [_checked(one, name) for one in self._cameras[name].settings()], self._holds[name] > 0

    def _note_focus(self, name: str, wanted: Mapping[str, float], before: Sequence[CameraSetting]) -> None:
        """Compare a focus that was to be changed with that of before its first change."""
        if "focus" not in wanted:
            return
        had = next((one.value for one in before if one.name == "focus"), None)
        now = next((one.value for one in self._read(name)[0] if one.name == "focus"), None)
        former = self._refocused.get(name)
        calibrated = former.calibrated if former is not None else had
        others = {key: one for key, one in self._refocused.items() if key != name}
        if calibrated is None or now is None or now == calibrated:
            self._refocused = others
        else:
            since_s = self._clock.now_s() if former is None else former.since_s
            self._refocused = {**others, name: _Refocused(calibrated, now, since_s)}


@dataclass(frozen=True)
class _Refocused:
    """The focus that a camera was calibrated with, the one that it has, and since when it is not that."""

    calibrated: float
    now: float
    since_s: float


def _checked(one: object, camera: str) -> CameraSetting:
    """What a driver states of a setting, its numbers as Python's own. Raises BadReply for what cannot be."""
    if not isinstance(one, CameraSetting) or one.name not in SETTINGS:
        name = getattr(one, "name", type(one).__name__)
        expected = f"where one of {', '.join(SETTINGS)} is expected"
        raise BadReply(f"settings returned {name!r} {expected}", device=camera)
    try:
        low, high, step = map(frame_checks.number, (one.minimum, one.maximum, one.step))
        value = None if one.value is None else frame_checks.number(one.value)
        if not (
            low <= high and step >= 0 and isinstance(one.automatic, bool) and isinstance(one.refusal, str)
        ):
            raise ValueError("minimum <= maximum, a step of 0 or more, a truth value and a text are expected")
    except (TypeError, ValueError) as error:
        found = f"settings returned {one.name} with {one!r:.300}: {error}"
        raise BadReply(found, device=camera) from None
    return replace(one, minimum=low, maximum=high, step=step, value=value)


def check_wanted(
    known: Sequence[CameraSetting], wanted: Mapping[str, float], camera: str
) -> dict[str, float]:
    """Return settings that a camera has, can change, and that are within its bounds. Raises BadSetting.

    Bounds are shown with six digits, and one that comes back so is the bound.
    """
    has = {one.name: one for one in known}
    found: dict[str, float] = {}
    for name, value in wanted.items():
        if name not in has:
            known_ones = f"it has {', '.join(has)}" if has else "nothing of it can be changed while it runs"
            raise BadSetting(f"it has no {name}; {known_ones}", device=camera)
        one, unit = has[name], SETTINGS[name] and f" {SETTINGS[name]}"
        if one.refusal:
            raise BadSetting(f"{name} {one.refusal}", device=camera)
        low, high = f"{one.minimum:g}", f"{one.maximum:g}"
        if not min(float(low), one.minimum) <= value <= max(float(high), one.maximum):
            message = f"{name} is to be {value:g}{unit}, {low} to {high}{unit} is expected"
            raise BadSetting(message, device=camera)
        found[name] = min(max(value, one.minimum), one.maximum)
    return found


class Cameras:
    """The cameras behind their threads: the part of `mastctl.devices.devices.Devices` that takes images.

    ``sensor_modes`` says which pixels of its sensor each camera's images show, of those that are open and
    know it. Raises BadFrame if a camera that knows its size, or its sensor's mode, has not the mast file's.
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
        self._read_head = read
        self._head_name = head
        self._clock = clock
        self._time = time
        self._grace_s = CAMERA_GRACE_S if grace_s is None else grace_s
        self.sensor_modes: dict[str, SensorMode] = {}
        self._refused: dict[str, BadFrame] = {}
        self._calibrated: dict[str, RigCamera] = {} if rig is None else dict(rig.cameras)
        self._paired_s: dict[str, float] = {}  # per camera when the last frame that served a set began
        self._learned: dict[tuple[str, str], Offset] = {}
        self._still_since: dict[str, StampedFrame] = {}  # per camera the first frame of the same content
        self._watching = threading.Lock()
        self._watch_from_s = 0.0  # of real time
        self._threads.update({name: self._thread_of(name) for name in self._cameras})
        if rig is not None:
            self._check_sizes()

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
            frame_checks.check_known(camera, self._cameras)
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
        operation took serves. A clock that stands while an image is made is kept from going on for
        `WATCHED_SHARE` of real time at most. Not for a thread at work on such a clock. Raises as `frames`.
        """

        def watched() -> StampedFrame:
            after_s = max(exposed_after_s, self._clock.now_s() - max_age_s)
            newest = self._store.newest(camera)
            if newest is not None and newest.exposure_began_s > after_s:
                return newest
            deadline_s = self._time.now_s() + timeout_s
            frames = self._fetched({camera: self._known_from(after_s)}, deadline_s)
            return self._stamped(camera, frames[camera], published=False)

        if not self._clock.stands_for_work:
            return watched()
        with self._watching:
            time.sleep(max(0.0, self._watch_from_s - time.monotonic()))
            began_s = time.monotonic()
            try:
                return watched()
            finally:
                ended_s = time.monotonic()
                self._watch_from_s = ended_s + (ended_s - began_s) * (1.0 / WATCHED_SHARE - 1.0)

    def frame_by_id(self, frame_id: str, max_age_s: float | None = None) -> StampedFrame:
        """Return a kept frame, not older than so. Raises as `mastctl.devices.frames.FrameStore.by_id`."""
        frame = self._store.by_id(frame_id)
        age_s = self._clock.now_s() - frame.mid_exposure_s
        if max_age_s is not None and age_s > max_age_s:
            raise NoLonger(
                "frame_too_old", f"frame {frame_id} is {age_s:.0f} s old, at most {max_age_s:.0f} s is taken"
            )
        return frame

    def hold(self, frame: StampedFrame, by: str = REQUESTED, kept: int = KEPT_FRAMES) -> None:
        """Keep a frame, as `mastctl.devices.frames.FrameStore.hold`."""
        self._store.hold(frame, by, kept)

    def let_go(self, by: str) -> None:
        """Keep nothing more for one holder."""
        self._store.let_go(by)

    def newest_frames(self) -> dict[str, StampedFrame | None]:
        """Return each configured camera's newest frame, None where there is none yet; takes no image."""
        return {camera: self._store.newest(camera) for camera in self._cameras}

    @contextmanager
    def exposure_held(self) -> Iterator[None]:
        """Keep every camera's exposure as it is inside the block: a measurement compares its images.

        Nothing is waited for (`CameraControls.hold`).
        """
        releases = [self.settings.hold(name) for name in self._threads]
        try:
            yield
        finally:
            for release in releases:
                release()

    def camera_faults(self) -> list[StandingFault]:
        """Return what is wrong with any camera now."""
        own = [fault for thread in self._threads.values() for fault in thread.faults()]
        return own + self.settings.faults()

    def frame_counts(self) -> dict[str, tuple[int, int]]:
        """Return how many frames were received and missed, of each camera whose driver counts them."""
        counters = {name: camera.counters for name, camera in self._cameras.items()}
        return {
            name: (one.good, one.damaged + one.dropped) for name, one in counters.items() if one is not None
        }

    def close_cameras(self, until_s: float) -> None:
        """End the threads; waits until a moment of the deadlines' clock, and for each 0.1 s at least."""
        for thread in self._threads.values():
            thread.close(max(0.1, until_s - self._time.now_s()))

    # In the cameras' own threads

    def _thread_of(self, camera: str) -> DeviceThread:
        """The thread of a camera; that of an absent one opens it when it comes; its absence is a fault."""
        if not isinstance(self._cameras[camera], AbsentCamera):
            return DeviceThread(camera, faults=FAULTS, clock=self._time)
        faults = {**FAULTS, "next_frame": "it is there, or a picture comes"}
        return DeviceThread(
            camera,
            between=lambda: self._join(camera),
            between_name="next_frame",
            faults=faults,
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
            log.warning(NOT_COMPARED, error if isinstance(error, DriverError) else f"{name}: {error!r}")
        self._refused.pop(name, None)

    def _check_sizes(self) -> None:
        """Pass cameras that are as calibrated, or do not answer now. Raises BadFrame."""
        until_s = self._time.now_s() + SIZE_TIMEOUT_S
        calls = {
            name: thread.submit("info", partial(self._check_as_calibrated, name), SIZE_TIMEOUT_S, noted=False)
            for name, thread in self._threads.items()
        }
        for name, call in calls.items():
            try:
                self._threads[name].wait(call, until_s)
            except BadFrame:
                for thread in self._threads.values():
                    thread.end()
                raise
            except DriverError as error:
                log.warning(NOT_COMPARED, error)

    def _check_as_calibrated(self, name: str) -> None:
        """Pass a camera whose sensor mode and size, as far as it knows them, are the mast file's.

        Raises BadFrame if one is not, and what its driver raises.
        """
        info, calibrated = self._cameras[name].info, self._calibrated.get(name)
        mode, then = info.sensor_mode, None if calibrated is None else calibrated.sensor_mode
        # The mode first: its refusal says better than that of the size what would mend it.
        if isinstance(mode, SensorMode):
            self.sensor_modes[name] = mode
            if then is not None:
                frame_checks.check_mode(name, mode, then)
                if mode.crop_px is None and then.crop_px is not None:
                    log.warning(
                        "%s: its driver does not report which part of its sensor is read; the crop "
                        "is not compared with the mast file's",
                        name,
                    )
        if info.size_px is not None and calibrated is not None:
            width, height = map(int, info.size_px)
            frame_checks.check_size(name, (width, height), calibrated.model.size_px)

    def _pace_of(self, name: str) -> Pace | None:
        """What a camera states of its frames' times; None for one without a steady rate."""
        camera = self._cameras[name]
        info = camera.info
        if info.period_s is None:
            return None
        recent = [FrameTime(one.sequence, one.exposure_began_s) for one in camera.recent_times()]
        return Pace(float(info.period_s), str(info.trigger), recent)

    def _take(self, camera: str, exposed_after_s: float, deadline_s: float) -> Frame | StampedFrame:
        newest = self._store.newest(camera)
        if newest is not None and newest.exposure_began_s > exposed_after_s:
            return newest  # another request brought it a moment ago
        if camera in self._refused:
            raise BadFrame(str(self._refused[camera]))
        left_s = max(0.0, deadline_s - self._time.now_s())
        answer = self._cameras[camera].next_frame(exposed_after_s, left_s)
        known = self._calibrated.get(camera)
        size_px = None if known is None else known.model.size_px
        frame = frame_checks.checked(answer, camera, size_px, exposed_after_s, self._clock.now_s())
        if newest is not None:
            try:
                _check_order(frame, newest)
            except BadFrame:  # refused once; a camera that came back counting from 0 goes on after that
                self._store.begin_again(camera)
                raise
        return frame

    # In the caller's thread

    def _known_from(self, exposed_after_s: float) -> float:
        """The moment, or a later one before which the place of the head is not known."""
        if (oldest_s := self._history.oldest_s) is None:
            oldest_s = self._read_head().time_s
        return max(exposed_after_s, oldest_s)

    def _offsets(self, names: Sequence[str], deadline_s: float) -> dict[str, Offset]:
        """What is known of each camera's times beside the first one's."""
        first = names[0]
        calls: dict[str, ThreadCall[Pace | None]] = {}
        for name in names:
            left_s = max(0.0, deadline_s - self._time.now_s())
            pace = partial(self._pace_of, name)
            calls[name] = self._threads[name].submit("recent_times", pace, left_s + self._grace_s)
        times = {
            name: self._threads[name].wait(one, deadline_s + self._grace_s) for name, one in calls.items()
        }
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
        calls: dict[str, ThreadCall[Frame | StampedFrame]] = {}
        for camera, exposed_after_s in after_s.items():
            take = partial(self._take, camera, exposed_after_s, deadline_s)
            left_s = max(0.0, deadline_s - self._time.now_s())
            calls[camera] = self._threads[camera].submit("next_frame", take, left_s + self._grace_s)
        return {
            camera: self._threads[camera].wait(call, deadline_s + self._grace_s, check)
            for camera, call in calls.items()
        }

    def _together(self, frames: dict[str, StampedFrame]) -> dict[str, StampedFrame]:
        """Frames that serve one measurement: if the head moved between two exposures, it moved in all."""
        moving = any(frame.moving for frame in frames.values())
        if not moving:
            began_s = min(frame.exposure_began_s for frame in frames.values())
            ended_s = max(frame.mid_exposure_s + frame.exposure_s / 2 for frame in frames.values())
            middle_s = (began_s + ended_s) / 2
            moving = self._history.at_exposure(began_s, middle_s, ended_s, self._head_name).moving
        return {name: replace(frame, moving=True) for name, frame in frames.items()} if moving else frames

    def _stamped(self, camera: str, frame: Frame | StampedFrame, published: bool = True) -> StampedFrame:
        """Give a frame its joint angles and id, and keep it."""
        if isinstance(frame, StampedFrame):
            if published:
                self._store.publish(frame)  # until now it was only watched
            return frame
        began_s = frame.mid_exposure_s - frame.exposure_s / 2
        ended_s = frame.mid_exposure_s + frame.exposure_s / 2
        until_s = self._time.now_s() + READINGS_S
        while (newest := self._history.newest) is None or newest.time_s < ended_s:
            if self._read_head().time_s < ended_s and self._time.now_s() > until_s:
                raise BadReply("the readings stay behind the frame's exposure", device=self._head_name)
        joints = self._history.at_exposure(began_s, frame.mid_exposure_s, ended_s, self._head_name)
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
        return self._store.add(stamped, published, self._check_alive)

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

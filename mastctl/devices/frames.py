"""Frames with their facts, and those that are kept, found again by id.

A frame's id is ``<camera>-<sequence>-<mast>-<run>``: the last two are the first 8 digits of the mast file's
digest and a token of this run of the camera, so that an id kept from yesterday, or from before the mast
file changed, never names another image. Clients treat ids as opaque.
"""

from __future__ import annotations

import re
import secrets
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from calib.geometry.mode import BadMode, SensorMode, flip_name, mode_between
from drivers.errors import BadFrame, BadReply, BadSetting, NoFreshFrame
from drivers.interfaces import SETTINGS, CameraSetting, Frame, Image
from mastctl.errors import NoLonger, NotKnown, NotNow
from mastctl.frame_facts import FrameFacts

_FRAME_ID = re.compile(r"(.{1,100})-([0-9]{6,20})-([0-9a-f]{8})-([0-9a-f]{4})", re.ASCII)
KEPT_FRAMES = 16  # per camera; six cameras of 1024x768 grey are 75 MB
NEWEST = "newest"  # the keeper of each camera's last frames
REQUESTED = "requested"  # of frames that were given by name: to a snapshot, a click
OPERATIONS = "operations"  # of the images that pointings end with
NOT_WATCHING = (NEWEST, REQUESTED, OPERATIONS)
WATCHED_BYTES = 256_000_000  # of the frames of all other keepers
MOST_PUBLISHED = 1024  # more than are kept of all cameras
CLOCK_TOLERANCE_S = 0.005  # what a stamp may lie in the future: rounding, and a driver that estimates
DARK_GREY = 8  # an image whose brightest hundredth is below this shows nothing to correlate with
SATURATED_GREY = 250  # nor does one whose darkest hundredth is above this


@dataclass(frozen=True, eq=False)
class StampedFrame(FrameFacts):
    """One image and its facts; it is uint8 (h, w) or (h, w, 3) BGR, read-only.

    ``jpeg`` is the camera's own that it was made of; empty where there is none.
    """

    image: Image
    jpeg: bytes = field(default=b"", kw_only=True, repr=False)

    @property
    def facts(self) -> FrameFacts:
        """The facts without the image."""
        return FrameFacts(**{one.name: getattr(self, one.name) for one in fields(FrameFacts)})

    @property
    def exposure_began_s(self) -> float:
        """When the exposure began, seconds of CLOCK_MONOTONIC."""
        return self.mid_exposure_s - self.exposure_s / 2


def check_known(camera: str, configured: Iterable[str]) -> None:
    """Pass the name of a configured camera. Raises NotKnown ``unknown_camera``."""
    known = sorted(configured)
    if camera not in known:
        message = f"camera {camera[:80]} is not configured; configured are {', '.join(known) or 'none'}"
        raise NotKnown("unknown_camera", message)


def check_size(camera: str, size_px: tuple[int, int], wanted_px: tuple[int, int]) -> None:
    """Raise BadFrame if a camera's images, (width, height), are not of the mast file's size."""
    if size_px != wanted_px:
        message = "the image is {}x{} px where the mast file has {}x{} px".format(*size_px, *wanted_px)
        remedy = "for a crop or binning of the calibrated picture 'mastctl camera mode' writes a mast file"
        raise BadFrame(f"{message}; {remedy}", device=camera)


def check_mode(camera: str, now: SensorMode, then: SensorMode) -> None:
    """Raise BadFrame if a camera's images are not of the sensor mode that the mast file was calibrated in.

    A crop that either lacks is not compared, and their sizes have to be equal.
    """
    if now.crop_px is None or then.crop_px is None:
        check_size(camera, now.size_px, then.size_px)
    try:
        change = mode_between(then, now)
    except BadMode as error:
        remedy = f"{error}: set the camera as it was, or calibrate it as it is"
    else:
        if not str(change):
            return
        given = ((" --crop {} {} {} {}", change.crop_px), (" --bin {} {}", change.binning))
        options = "".join(option.format(*value) for option, value in given if value not in (None, (1, 1)))
        options += f" --flip {flip_name(change.flip)}" if any(change.flip) else ""
        remedy = (
            f"'mastctl camera mode MAST.yaml --camera {camera}{options} --out NEW.yaml' writes its mast file"
        )
        if change.binning != (1, 1):
            remedy += "; a camera that skips pixels and does not bin them has to be calibrated as it is"
    message = f"its pictures show {now} where cameras.{camera}.sensor_mode of the mast file has"
    raise BadFrame(f"{message} {then}; {remedy}", device=camera)


def checked(
    answer: object, camera: str, size_px: tuple[int, int] | None, exposed_after_s: float, now_s: float
) -> Frame:
    """Return a driver's answer to ``next_frame`` if it can be true and was exposed after a moment.

    ``size_px`` is (width, height) by the mast file, None if not known. Raises BadFrame if it is no frame, of
    another size, dark, saturated, or stamped in the future; NoFreshFrame if its exposure began too early.
    """
    try:
        image = answer.image  # type: ignore[attr-defined]
        sequence = _whole(answer.sequence)  # type: ignore[attr-defined]
        mid_s = number(answer.mid_exposure_s, "mid_exposure_s")  # type: ignore[attr-defined]
        exposure_s = number(answer.exposure_s, "exposure_s")  # type: ignore[attr-defined]
        began_s, ended_s = mid_s - exposure_s / 2, mid_s + exposure_s / 2
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
            kind = image.dtype if isinstance(image, np.ndarray) else type(image).__name__
            raise TypeError(f"the image is {kind} where an array of uint8 is expected")
        if not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)) or image.size == 0:
            raise ValueError(f"the image has shape {image.shape} where (h, w) or (h, w, 3) is expected")
        if sequence < 0 or exposure_s < 0.0:
            raise ValueError(f"sequence {sequence} and exposure {exposure_s} s where neither may be below 0")
        if ended_s > now_s + CLOCK_TOLERANCE_S:
            raise ValueError(f"the exposure is stamped to end {ended_s - now_s:.3f} s in the future")
    except (AttributeError, TypeError, ValueError) as reason:
        message = f"next_frame returned {type(answer).__name__} that is not a frame: {reason}"
        raise BadFrame(message, device=camera) from None
    if size_px is not None:
        check_size(camera, (image.shape[1], image.shape[0]), size_px)
    if began_s <= exposed_after_s:
        early = (
            f"the frame that came was exposed {exposed_after_s - began_s:.3f} s before the requested moment"
        )
        raise NoFreshFrame(early, device=camera)
    darkest, brightest = np.percentile(image[::8, ::8], (1, 99))
    if brightest < DARK_GREY:
        message = f"the picture is dark: its brightest hundredth is at {brightest:.0f} of 255"
        raise BadFrame(message, device=camera, detail={"light": "dark"})
    if darkest >= SATURATED_GREY:
        message = f"the picture is saturated: its darkest hundredth is at {darkest:.0f} of 255"
        raise BadFrame(f"{message}; expose it for less time", device=camera, detail={"light": "saturated"})
    if image.flags.writeable or not image.flags.c_contiguous:
        # The driver may use its buffer again; one that hands over a read-only array is spared the copy.
        image = image.copy()
        image.setflags(write=False)
    jpeg = getattr(answer, "jpeg", b"")
    jpeg = jpeg if isinstance(jpeg, bytes) else b""
    return Frame(image, sequence, mid_s, exposure_s, jpeg=jpeg, settings=_settings(answer))


def checked_setting(one: object, camera: str) -> CameraSetting:
    """Return what a driver states of a setting, its numbers as Python's own. Raises BadReply."""
    if not isinstance(one, CameraSetting) or one.name not in SETTINGS:
        name = getattr(one, "name", type(one).__name__)
        expected = f"where one of {', '.join(SETTINGS)} is expected"
        raise BadReply(f"settings returned {name!r} {expected}", device=camera)
    try:
        low, high, step = map(number, (one.minimum, one.maximum, one.step))
        value = None if one.value is None else number(one.value)
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


def check_order(frame: Frame, newest: StampedFrame) -> None:
    """Refuse a frame whose count and time do not go forward together."""
    ahead = frame.sequence - newest.sequence
    later_s = frame.mid_exposure_s - newest.mid_exposure_s
    if (ahead > 0) != (later_s > 0) or (ahead < 0) != (later_s < 0) or ahead < 0:
        raise BadFrame(
            f"frame {frame.sequence} is {later_s:.3f} s after frame {newest.sequence}: "
            "count and time must grow together",
            device=newest.camera,
        )


def random_run() -> str:
    """Return four hexadecimal digits that tell a run from those before it."""
    return secrets.token_hex(2)


class FrameStore:
    """The newest frames of each camera, and those that are kept longer, by id. Safe to use from any thread.

    ``new_run`` makes the last part of ids, four hexadecimal digits. ``on_new`` gets each frame that is
    published, once; must return at once.
    """

    def __init__(
        self,
        mast_digest: str,
        new_run: Callable[[], str] = random_run,
        on_new: Callable[[StampedFrame], None] = lambda frame: None,
    ) -> None:
        self._digest = mast_digest
        self._on_new = on_new
        self._new_run = new_run
        self._runs: dict[str, str] = {}
        self._kept: dict[tuple[str, str], dict[str, StampedFrame]] = {}  # by (keeper, camera), oldest first
        self._newest: Mapping[str, StampedFrame] = {}  # replaced, never edited: read without a lock
        self._published: deque[str] = deque(maxlen=MOST_PUBLISHED)
        self._lock = threading.Lock()

    def name(self, camera: str, sequence: int) -> tuple[str, str]:
        """Return the id of a camera's frame in this run, and the digest of the mast file that is in it."""
        with self._lock:
            if camera not in self._runs:
                self._runs[camera] = self._new_run()
            run, digest = self._runs[camera], self._digest
        return f"{camera}-{sequence:06d}-{digest[:8]}-{run}", digest

    def change_mast(self, mast_digest: str) -> None:
        """Forget every frame and name the coming ones by another mast file, and as a new run.

        A frame from before must not be found again after a change and back.
        """
        with self._lock:
            self._digest = mast_digest
            self._kept.clear()
            self._newest = {}
            self._runs.clear()

    def begin_again(self, camera: str) -> None:
        """Forget a camera's frames, because its count went back: one number must not name two images."""
        with self._lock:
            self._kept = {place: frames for place, frames in self._kept.items() if place[1] != camera}
            self._newest = {name: frame for name, frame in self._newest.items() if name != camera}
            self._runs[camera] = self._new_run()

    def add(self, frame: StampedFrame) -> StampedFrame:
        """Keep a frame as its camera's newest; return it, or the one of that id that is kept already."""
        with self._lock:
            known = self._kept.get((NEWEST, frame.camera), {}).get(frame.frame_id)
            if known is None and self._put(frame, NEWEST, KEPT_FRAMES):
                self._newest = {**self._newest, frame.camera: frame}
            return known or frame

    def publish(self, frame: StampedFrame) -> None:
        """Publish a frame that is used, unless it was, and keep it as one that was requested."""
        with self._lock:
            if not self._put(frame, REQUESTED, KEPT_FRAMES) or frame.frame_id in self._published:
                return
            self._published.append(frame.frame_id)
        self._on_new(frame)

    def keep(self, frame: StampedFrame, keeper: str, most: int) -> None:
        """Keep a frame for a keeper, however many come after it: it may be clicked yet.

        Each has the newest that it was given of every camera, ``most`` at most. Of all keepers that only
        watch the oldest give way beyond `WATCHED_BYTES`, each frame counted once.
        """
        with self._lock:
            self._put(frame, keeper, most)
            watching = [frames for (one, _), frames in self._kept.items() if one not in NOT_WATCHING]
            watched = {one.frame_id: one for frames in watching for one in frames.values()}
            excess = sum(one.image.nbytes for one in watched.values()) - WATCHED_BYTES
            for one in sorted(watched.values(), key=lambda one: one.mid_exposure_s):
                if excess <= 0:
                    break
                excess -= one.image.nbytes
                for frames in watching:
                    frames.pop(one.frame_id, None)

    def release(self, keeper: str) -> None:
        """Keep nothing more for a keeper."""
        with self._lock:
            self._kept = {place: frames for place, frames in self._kept.items() if place[0] != keeper}

    def newest(self, camera: str) -> StampedFrame | None:
        """Return a camera's newest frame, None before the first; takes no lock."""
        return self._newest.get(camera)

    def by_id(self, frame_id: str) -> StampedFrame:
        """Return a frame by its id.

        Raises NoLonger, NotNow, NotKnown ``frame_too_old`` if it was taken in this run but is no longer kept,
        ``other_mast_file`` if it was taken with another mast file, ``frame_unknown`` otherwise.
        """
        named = _FRAME_ID.fullmatch(frame_id)
        with self._lock:
            for frames in self._kept.values():
                if frame_id in frames:
                    return frames[frame_id]
            in_use = self._digest[:8]
            known_run = named is not None and self._runs.get(named[1]) == named[4]
        if named is not None:
            camera, sequence, mast, _ = named.groups()
            if mast != in_use:
                raise NotNow(
                    "other_mast_file",
                    f"frame {frame_id} was taken with mast file {mast}..., the one in use is {in_use}...",
                )
            newest = self.newest(camera)
            if known_run and newest is not None and int(sequence) <= newest.sequence:
                raise NoLonger(
                    "frame_too_old",
                    f"frame {frame_id} is no longer kept (the newest {KEPT_FRAMES} of a camera are)",
                )
        raise NotKnown("frame_unknown", f"frame {frame_id[:120]} was not taken by this run of the service")

    def _put(self, frame: StampedFrame, keeper: str, most: int) -> bool:
        """Keep a frame, the lock is held; False if the mast file changed while it was on its way."""
        if frame.mast_digest != self._digest:
            return False
        frames = self._kept.setdefault((keeper, frame.camera), {})
        frames.pop(frame.frame_id, None)
        frames[frame.frame_id] = frame
        while len(frames) > most:
            del frames[next(iter(frames))]
        return True


def camera_and_sequence(frame_id: str) -> tuple[str, int]:
    """Return the camera and the sequence number that a frame's id names.

    Raises ValueError if it is no frame id.
    """
    named = _FRAME_ID.fullmatch(frame_id)
    if named is None:
        raise ValueError(f"'{frame_id[:120]}' is no frame id")
    return named[1], int(named[2])


def _settings(answer: object) -> dict[str, float | None]:
    """What a driver says that a frame was taken with; None for what is no number."""
    stated = getattr(answer, "settings", None)
    known: dict[str, float | None] = {}
    for name in SETTINGS:
        if isinstance(stated, Mapping) and name in stated:
            try:
                known[name] = number(stated[name])
            except (TypeError, ValueError):
                known[name] = None
    return known


def number(value: object, name: str = "it") -> float:
    """Return a finite float, refusing what only looks like one by its name. Raises TypeError, ValueError."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError(f"{name} is {type(value).__name__} where a number is expected")
    try:
        number = float(value)
    except OverflowError:  # an integer
        raise ValueError(f"{name} is beyond any float where a finite number is expected") from None
    if not np.isfinite(number):
        raise ValueError(f"{name} is {number} where a finite number is expected")
    return number


def _whole(value: object) -> int:
    """Return an int, refusing what only looks like one."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"{type(value).__name__} where a whole number is expected")
    return int(value)

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
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields

import numpy as np

from calib.geometry.mode import BadMode, SensorMode, flip_name, mode_between
from drivers.errors import BadFrame, NoFreshFrame
from drivers.interfaces import SETTINGS, Frame, Image
from mastctl.errors import NoLonger, NotKnown, NotNow
from mastctl.frame_facts import FrameFacts

_FRAME_ID = re.compile(r"(.{1,100})-([0-9]{6,20})-([0-9a-f]{8})-([0-9a-f]{4})", re.ASCII)
KEPT_FRAMES = 16  # per camera; six cameras of 1024x768 grey are 75 MB
REQUESTED = "requested"  # the holder of frames that were given by name: to a snapshot, a click
OPERATIONS = "operations"  # the holder of the images that pointings end with
WATCHED_BYTES = 256_000_000  # of the frames of all other holders, which only watch, each frame counted once
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
        mid_s = number(answer.mid_exposure_s)  # type: ignore[attr-defined]
        exposure_s = number(answer.exposure_s)  # type: ignore[attr-defined]
    except (AttributeError, TypeError, ValueError) as reason:
        message = f"next_frame returned {type(answer).__name__} that is not a frame: {reason}"
        raise BadFrame(message, device=camera) from None
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        kind = image.dtype if isinstance(image, np.ndarray) else type(image).__name__
        raise BadFrame(f"the image is {kind} where an array of uint8 is expected", device=camera)
    if not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)) or image.size == 0:
        message = f"the image has shape {image.shape} where (h, w) or (h, w, 3) is expected"
        raise BadFrame(message, device=camera)
    if size_px is not None:
        check_size(camera, (image.shape[1], image.shape[0]), size_px)
    if sequence < 0 or exposure_s < 0.0:
        message = f"sequence {sequence} and exposure {exposure_s} s where neither may be below 0"
        raise BadFrame(message, device=camera)
    ended_s = mid_s + exposure_s / 2
    if ended_s > now_s + CLOCK_TOLERANCE_S:
        message = f"the exposure is stamped to end {ended_s - now_s:.3f} s in the future"
        raise BadFrame(message, device=camera)
    began_s = mid_s - exposure_s / 2
    if began_s <= exposed_after_s:
        message = (
            f"the frame that came was exposed {exposed_after_s - began_s:.3f} s before the requested moment"
        )
        raise NoFreshFrame(message, device=camera)
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


def random_run() -> str:
    """Return four hexadecimal digits that tell a run from those before it."""
    return secrets.token_hex(2)


class _Kept:
    """The frames that holders keep, the newest of each camera, by (holder, camera).

    Of holders that only watch the oldest give way beyond ``WATCHED_BYTES`` in all, each frame counted once.
    """

    def __init__(self) -> None:
        self._frames: dict[tuple[str, str], dict[str, StampedFrame]] = {}
        self._watched: dict[tuple[tuple[str, str], str], int] = {}  # bytes of (place, frame), oldest first

    def add(self, by: str, frame: StampedFrame, most: int) -> None:
        """Keep a frame as the newest of its camera, of which a holder has so many."""
        place, name = (by, frame.camera), frame.frame_id
        self._remove(place, name)
        frames = self._frames.setdefault(place, {})
        frames[name] = frame
        if by not in (REQUESTED, OPERATIONS):
            self._watched[place, name] = frame.image.nbytes
        while len(frames) > most:
            self._remove(place, next(iter(frames)))
        while len(self._watched) > 1 and self._bytes() > WATCHED_BYTES:
            self._remove(*next(iter(self._watched)))

    def get(self, frame_id: str) -> StampedFrame | None:
        """Return a kept frame by its id."""
        return next((frames[frame_id] for frames in self._frames.values() if frame_id in frames), None)

    def drop(self, by: str | None = None, camera: str | None = None) -> None:
        """Keep nothing more for a holder, or of a camera."""
        for place in [one for one in self._frames if by == one[0] or camera == one[1]]:
            for frame_id in list(self._frames[place]):
                self._remove(place, frame_id)

    def _remove(self, place: tuple[str, str], frame_id: str) -> None:
        self._watched.pop((place, frame_id), None)
        frames = self._frames.get(place, {})
        frames.pop(frame_id, None)
        if not frames:
            self._frames.pop(place, None)

    def _bytes(self) -> int:
        return sum({name: size for (_, name), size in self._watched.items()}.values())


class FrameStore:
    """The newest frames of each camera, found again by id. Safe to use from any thread.

    ``new_run`` makes the last part of ids, four hexadecimal digits; `random_run` by default. ``on_new`` gets
    each frame that is published, once; must return at once.
    """

    def __init__(
        self,
        mast_digest: str,
        new_run: Callable[[], str] | None = None,
        on_new: Callable[[StampedFrame], None] = lambda frame: None,
    ) -> None:
        self._digest = mast_digest
        self._on_new = on_new
        self._new_run = new_run or random_run
        self._runs: dict[str, str] = {}
        self._frames: dict[str, deque[StampedFrame]] = {}
        self._kept = _Kept()
        self._newest: Mapping[str, StampedFrame] = {}  # replaced, never edited
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
            self._frames.clear()
            self._kept = _Kept()
            self._newest = {}
            self._runs.clear()

    def begin_again(self, camera: str) -> None:
        """Forget a camera's frames, because its count went back: one number must not name two images."""
        with self._lock:
            self._frames.pop(camera, None)
            self._kept.drop(camera=camera)
            self._newest = {name: frame for name, frame in self._newest.items() if name != camera}
            self._runs[camera] = self._new_run()

    def add(
        self,
        frame: StampedFrame,
        published: bool = True,
        check: Callable[[StampedFrame], None] = lambda frame: None,
    ) -> StampedFrame:
        """Keep a frame that passes a ``check`` and return it, or the one of that id that is kept already.

        One that is only watched is not ``published``, and so not recorded.
        """
        with self._lock:
            check(frame)
            if frame.mast_digest == self._digest:  # else the mast file changed while it was on its way
                frames = self._frames.setdefault(frame.camera, deque(maxlen=KEPT_FRAMES))
                known = next((one for one in frames if one.frame_id == frame.frame_id), None)
                if known is None:
                    frames.append(frame)
                    self._newest = {**self._newest, frame.camera: frame}
                frame = known or frame
        if published:
            self.publish(frame)
        return frame

    def publish(self, frame: StampedFrame) -> None:
        """Publish a frame that is used, unless it was, and keep it as one that was requested."""
        with self._lock:
            if frame.mast_digest != self._digest:
                return
            self._kept.add(REQUESTED, frame, KEPT_FRAMES)
            if frame.frame_id in self._published:
                return
            self._published.append(frame.frame_id)
        self._on_new(frame)

    def newest(self, camera: str) -> StampedFrame | None:
        """Return a camera's newest frame, None before the first; takes no lock."""
        return self._newest.get(camera)

    def hold(self, frame: StampedFrame, by: str = REQUESTED, kept: int = KEPT_FRAMES) -> None:
        """Keep a frame for a holder, however many come after it: it may be clicked yet.

        Each holder keeps the newest it was given of every camera, ``kept`` at most.
        """
        if by == REQUESTED:
            self.publish(frame)
            return
        with self._lock:
            if frame.mast_digest == self._digest:
                self._kept.add(by, frame, kept)

    def let_go(self, by: str) -> None:
        """Keep nothing more for a holder."""
        with self._lock:
            self._kept.drop(by=by)

    def by_id(self, frame_id: str) -> StampedFrame:
        """Return a frame by its id.

        Raises NoLonger, NotNow, NotKnown ``frame_too_old`` if it was taken in this run but is no longer kept,
        ``other_mast_file`` if it was taken with another mast file, ``frame_unknown`` otherwise.
        """
        with self._lock:
            for frames in self._frames.values():
                for frame in frames:
                    if frame.frame_id == frame_id:
                        return frame
            if (kept := self._kept.get(frame_id)) is not None:
                return kept
            newest = {camera: frames[-1].sequence for camera, frames in self._frames.items() if frames}
            runs = dict(self._runs)
            in_use = self._digest[:8]
        named = _FRAME_ID.fullmatch(frame_id)
        if named is not None:
            camera, sequence, mast, run = named.groups()
            if mast != in_use:
                raise NotNow(
                    "other_mast_file",
                    f"frame {frame_id} was taken with mast file {mast}..., the one in use is {in_use}...",
                )
            if run == runs.get(camera) and int(sequence) <= newest.get(camera, -1):
                raise NoLonger(
                    "frame_too_old",
                    f"frame {frame_id} is no longer kept (the newest {KEPT_FRAMES} of a camera are)",
                )
        raise NotKnown("frame_unknown", f"frame {frame_id[:120]} was not taken by this run of the service")


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


def number(value: object) -> float:
    """Return a finite float, refusing what only looks like one."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError(f"{type(value).__name__} where a number is expected")
    try:
        number = float(value)
    except OverflowError:  # an integer
        raise ValueError("a number beyond any float where a finite one is expected") from None
    if not np.isfinite(number):
        raise ValueError(f"{number} where a finite number is expected")
    return number


def _whole(value: object) -> int:
    """Return an int, refusing what only looks like one."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"{type(value).__name__} where a whole number is expected")
    return int(value)

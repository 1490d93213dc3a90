"""Replay: recorded frames with joint angles, served through the same PanTilt and Camera as live ones.

The head is always at one of the recorded pointings. A move goes at once to the recorded pointing nearest to
the requested angles, if that is within the tolerance. Else it is refused and the message names the nearest.
The reading is the recorded, *measured* angle, not the requested one. Cameras deliver the frame recorded at
the pointing with fresh time stamps, at a fixed frame rate.

Replay has no motion in between, no blur, and no frame where none was recorded.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from calib.errors import BadFile
from calib.files.records import Text, problem
from drivers.clock import Clock
from drivers.errors import BadOptions, DriverError, NoFreshFrame
from drivers.faults import PAN_TILT, nearest
from drivers.interfaces import Camera, CameraInfo, Frame, Image, PanTilt, Reading
from drivers.options import Ascending, DriverOptions, read_options
from drivers.recordings.frames import RecordedPointing, read_folder, read_products, read_recording
from drivers.registry import Context, Driver

TOLERANCE_RAD = 0.002
"""How far from a recorded pointing a move may be, unless the options say otherwise: two Navcam pixels."""

PERIOD_S = 0.1
EXPOSURE_S = 0.001


class NoRecording(DriverError):
    """Nothing was recorded where the head is to go."""

    code = "no_recording"


@dataclass(frozen=True)
class Replay:
    """The devices of one recording."""

    pan_tilt: PanTilt
    cameras: Mapping[str, Camera]
    pointings: Sequence[RecordedPointing]


class ReplayOptions(DriverOptions):
    """A recording."""

    recording: Text = ""
    """An MCAP file that mastctl recorded, or a folder of them; or"""
    products: Text | list[Text] = ""
    """PDS3 files, or a pattern like ``opportunity/1N*.IMG``, sorted by name; or"""
    frames: Text = ""
    """A CSV of frames (`drivers.recordings.frames`)."""
    camera: Text = ""
    """The name that the products' frames go by."""
    tolerance_rad: Annotated[float, Field(ge=1e-9, le=1000.0)] = TOLERANCE_RAD
    """How far from a recorded pointing a move may be."""
    grey_range_dn: Annotated[tuple[float, float], Ascending()] | None = None
    """What becomes black and white in frames of more than 8 bits."""

    @model_validator(mode="after")
    def _check_source(self) -> Self:
        if sum(map(bool, (self.recording, self.products, self.frames))) != 1:
            raise problem("", "one of recording, products and frames is expected")
        if self.products and not self.camera:
            raise problem("camera", "the key is missing: the name that the products' frames go by")
        if self.camera and not self.products:
            raise problem("camera", "it goes with products; recordings and the table 'frames' name their own")
        if self.recording and self.grey_range_dn is not None:
            raise problem("grey_range_dn", "it goes with products and frames; a recording has 8 bits")
        return self


def open_replay(options: Mapping[str, Any], folder: Path, clock: Clock) -> Replay:
    """Open a recording; relative paths start at ``folder``.

    Raises BadOptions for options that cannot be and recordings that cannot be read.
    """
    read = read_options(ReplayOptions, options, "replay")
    try:
        if read.products:
            pointings = read_products(_files(read.products, folder), read.camera, read.grey_range_dn)
        elif read.recording:
            pointings = read_recording(folder / read.recording)
        else:
            pointings = read_folder(folder / read.frames, read.grey_range_dn)
    except BadFile as error:
        raise BadOptions(str(error), device="replay") from None
    if not pointings:
        raise BadOptions("the recording is empty", device="replay")
    head = ReplayedHead(pointings, read.tolerance_rad, clock)
    names = dict.fromkeys(name for pointing in pointings for name in pointing.frames)
    cameras = {name: ReplayedCamera(name, head, clock) for name in names}
    return Replay(head, MappingProxyType(cameras), tuple(pointings))


class ReplayedHead(PanTilt):
    """A head that stands at recorded pointings only; safe from any thread."""

    def __init__(self, pointings: Sequence[RecordedPointing], tolerance_rad: float, clock: Clock) -> None:
        self._pointings = pointings
        self._tolerance_rad = tolerance_rad
        self._clock = clock
        self._lock = threading.Lock()
        self._stood: deque[tuple[float, RecordedPointing]] = deque([(-math.inf, pointings[0])], maxlen=1000)

    def read(self) -> Reading:
        """Return the measured angles that were recorded where the head stands."""
        now_s = self._clock.now_s()
        here = self.at(now_s)
        return Reading(here.pan_rad, here.tilt_rad, False, now_s)

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        """Go to the recorded pointing nearest to the angles, at once, whatever the speed.

        Raises NoRecording if the nearest one is farther away than the tolerance, in either joint.
        """
        apart = [max(abs(p.pan_rad - pan_rad), abs(p.tilt_rad - tilt_rad)) for p in self._pointings]
        best = min(range(len(apart)), key=apart.__getitem__)
        target = self._pointings[best]
        if not apart[best] <= self._tolerance_rad:
            raise NoRecording(
                f"nothing was recorded at pan {pan_rad:.6g}, tilt {tilt_rad:.6g} rad; the nearest "
                f"recording is at pan {target.pan_rad:.6g}, tilt {target.tilt_rad:.6g} rad, "
                f"{apart[best]:.3g} rad away; at most {self._tolerance_rad:g} rad is taken",
                device=PAN_TILT,
            )
        with self._lock:
            self._stood.append((self._clock.now_s(), target))

    def stop(self) -> None:
        """Nothing moves in between, so there is nothing to stop."""

    def close(self) -> None:
        """Nothing is open."""

    def at(self, time_s: float) -> RecordedPointing:
        """Return where the head stood at a moment, seconds of the clock."""
        with self._lock:
            for since_s, pointing in reversed(self._stood):
                if since_s <= time_s:
                    return pointing
            return self._stood[0][1]


class ReplayedCamera(Camera):
    """A camera that delivers the frame recorded where the head stands; safe from any thread.

    Frame n is exposed at a fixed instant, so its sequence number is a function of time; a frame that was not
    fetched is a gap.
    """

    def __init__(self, name: str, head: ReplayedHead, clock: Clock) -> None:
        self._name = name
        self._head = head
        self._clock = clock
        self._start_s = clock.now_s()
        self._closed = threading.Event()
        self._lock = threading.Lock()
        self._shown: tuple[RecordedPointing, Image] | None = None

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        """Return the newest frame, or wait for the first whose exposure begins after ``exposed_after_s``.

        Raises NoFreshFrame if it does not end its exposure within ``timeout_s``, or the camera took nothing
        at this pointing; BadFrame if the recorded file cannot be read any more.
        """
        deadline_s = self._clock.now_s() + max(0.0, timeout_s)
        while not self._closed.is_set():
            now_s = self._clock.now_s()
            newest = math.floor((now_s - EXPOSURE_S - self._start_s) / PERIOD_S)
            wanted = max(math.floor((exposed_after_s - self._start_s) / PERIOD_S) + 1, newest, 0)
            ready_s = self._begin_s(wanted) + EXPOSURE_S
            if ready_s <= now_s:
                return self._frame(wanted)
            if ready_s > deadline_s and now_s >= deadline_s:
                raise NoFreshFrame(
                    f"no frame exposed after the requested moment came within {timeout_s:.3g} s; "
                    f"the next one ends {ready_s - now_s:.3f} s from now",
                    device=self._name,
                )
            # A little longer, so that rounding does not leave the frame a hair unfinished.
            self._clock.sleep(min(min(ready_s, deadline_s) - now_s + 1e-6, 0.5))
        raise NoFreshFrame("it is closed", device=self._name)

    @property
    def info(self) -> CameraInfo:
        """Its period; each camera's instants are its own."""
        return CameraInfo(period_s=PERIOD_S)

    def close(self) -> None:
        """Let go; a waiting call ends with NoFreshFrame within half a second."""
        self._closed.set()

    def _begin_s(self, sequence: int) -> float:
        """When a frame's exposure begins."""
        return self._start_s + sequence * PERIOD_S

    def _frame(self, sequence: int) -> Frame:
        """The frame of a sequence number, from the pointing at which its exposure began."""
        begin_s = self._begin_s(sequence)
        pointing = self._head.at(begin_s)
        recorded = pointing.frames.get(self._name)
        if recorded is None:
            raise NoFreshFrame(
                f"it took nothing at pan {pointing.pan_rad:.6g}, tilt {pointing.tilt_rad:.6g} rad",
                device=self._name,
            )
        with self._lock:
            if self._shown is None or self._shown[0] is not pointing:
                self._shown = (pointing, recorded.image())
            image = self._shown[1]
        return Frame(image, sequence, begin_s + EXPOSURE_S / 2, EXPOSURE_S)


def _files(products: str | list[str], folder: Path) -> list[Path]:
    """The files of the option ``products``: those of a list, or those that match a pattern, by name."""
    if isinstance(products, list):
        return [folder / name for name in products]
    pattern = folder / products
    found = sorted(one for one in pattern.parent.glob(pattern.name) if one.is_file())
    if not found:
        message = f"options.products: no file matches the pattern {str(pattern)!r}"
        raise BadOptions(message, device="replay")
    return found


def _device(options: Mapping[str, Any], context: Context) -> PanTilt | Camera:
    """The head or a camera of a recording; devices with the same options share one."""
    key = f"replay {sorted(options.items())!r}"
    if key not in context.shared:
        context.shared[key] = open_replay(options, context.folder, context.clock)
    replay: Replay = context.shared[key]
    if context.name == PAN_TILT:
        return replay.pan_tilt
    if context.name not in replay.cameras:
        message = f"the recording has no such camera{nearest(context.name, replay.cameras)}"
        raise BadOptions(message, device=context.name)
    return replay.cameras[context.name]


DRIVER = Driver(_device, hardware="replayed", any_clock=True)

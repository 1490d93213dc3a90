"""The classes of devices (docs/drivers.md) and the records that travel through them.

Times are seconds of CLOCK_MONOTONIC. Calls may block; the service gives each device a thread of its own.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from calib.geometry.mode import SensorMode
from drivers.errors import BadSetting

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Reading:
    """Joint state as *measured*, not as commanded: angles in radians, positive pan right, positive tilt up.

    ``moving``: an axis is under way or not yet in position. ``time_s``: when it was measured,
    CLOCK_MONOTONIC.
    """

    pan_rad: float
    tilt_rad: float
    moving: bool
    time_s: float
    faults: Sequence[str] = ()


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture.

    Attributes
    ----------
    image
        uint8, (h, w) grey or (h, w, 3) BGR; read-only by agreement.
    sequence
        Counts the camera's frames; a gap is a dropped frame.
    mid_exposure_s
        Middle of the exposure, seconds of CLOCK_MONOTONIC.
    exposure_s
        Exposure time, seconds: it began at ``mid_exposure_s - exposure_s / 2``.
    jpeg
        The camera's own JPEG that the image was made of; empty where it gave none.
    settings
        Exposure, gain, ... of this frame, by the names of `SETTINGS`; None for one that is not known of it,
        as while it is being changed.
    """

    image: Image
    sequence: int
    mid_exposure_s: float
    exposure_s: float
    jpeg: bytes = field(default=b"", kw_only=True, repr=False)
    settings: Mapping[str, float | None] = field(default_factory=dict, kw_only=True)

    @property
    def exposure_began_s(self) -> float:
        """When the exposure began, seconds of CLOCK_MONOTONIC."""
        return self.mid_exposure_s - self.exposure_s / 2


Side = Literal["positive", "negative", "unknown"]


@dataclass(frozen=True)
class AxisReport:
    """Where an axis was sent and where it stands, in the device's own counts.

    Attributes
    ----------
    commanded_rad
        The angle that was requested; None before the first move, and after a stop.
    goal_counts, measured_counts
        The nearest count to it, and what the servo measures.
    side
        From which side the axis came last: on which flank the gears rest.
    backlash_rad
        Of the gears, as their maker states it; None where nothing is stated.
    count_rad
        One count; None where it is not known.
    """

    commanded_rad: float | None
    goal_counts: int
    goal_rad: float
    measured_counts: int
    measured_rad: float
    side: Side
    backlash_rad: float | None
    temperature_C: float | None
    count_rad: float | None = None

    @property
    def left_rad(self) -> float | None:
        """The angle that the counts leave: measured minus commanded."""
        return None if self.commanded_rad is None else self.measured_rad - self.commanded_rad


COARSE_COUNT_RAD = math.tau / 4096
"""The counts assumed of a head that does not state its own: those of a 12-bit servo, the coarsest."""


@dataclass(frozen=True)
class AxisMotion:
    """How an axis moves.

    Attributes
    ----------
    acceleration_rad_per_s2
        With which it speeds up and brakes.
    beyond_goal_rad
        How far past a goal it may go on purpose, to come to it from one side.
    rising_below_rad
        It approaches a goal below this angle in the positive direction, and one above it in the negative
        direction. Infinite for a head that always turns the same way at last. None: it comes the shortest
        way.
    count_rad
        One count of its encoder, or one step; None where it is not known.
    """

    acceleration_rad_per_s2: float
    beyond_goal_rad: float = 0.0
    rising_below_rad: float | None = None
    count_rad: float | None = None

    def turn_to(self, goal_rad: float) -> int:
        """Return 1 if it comes to a goal from smaller angles by itself, -1 from larger, 0 for neither."""
        if self.rising_below_rad is None:
            return 0
        return 1 if goal_rad < self.rising_below_rad else -1


@dataclass(frozen=True)
class HeadInfo:
    """What a head states of itself; whatever it does not know keeps its default.

    ``stops_beside``: its ``stop`` is confirmed sooner beside a call under way than after it, so a stop does
    not wait for the call. ``settles_within_counts``: how many counts from its goal a settled axis may stand.
    """

    simulated: bool = False
    stops_beside: bool = False
    motion: Mapping[str, AxisMotion] = field(default_factory=dict)
    settles_within_counts: int = 1


class PanTilt(ABC):
    """A two-axis head. Derive a driver from it and write the four abstract methods."""

    @abstractmethod
    def read(self) -> Reading:
        """Return the measured joint state; moves nothing. Raises DriverError."""

    @abstractmethod
    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        """Start towards the angles and return at once. Raises DriverError."""

    @abstractmethod
    def stop(self) -> None:
        """Halt both axes where they are and hold. Raises DriverError."""

    @abstractmethod
    def close(self) -> None:
        """Make safe and let go of the device; never raises for a device that is already gone."""

    @property
    def info(self) -> HeadInfo:
        """What it states of itself. Queries no device, never fails."""
        return HeadInfo()

    def report(self) -> Mapping[str, AxisReport]:
        """Return the counts of ``pan`` and ``tilt`` as last read; empty for a head that has none. Queries no
        device, never fails.
        """
        return {}


class FrameCounts(Protocol):
    """Counts of a camera's frames since it was opened: good ones, damaged ones, and those that never came."""

    @property
    def good(self) -> int: ...
    @property
    def damaged(self) -> int: ...
    @property
    def dropped(self) -> int: ...


SETTINGS: Mapping[str, str] = MappingProxyType(
    {"exposure_s": "s", "gain": "", "white_balance_k": "K", "focus": ""}
)
"""The settings that may change while a camera runs, with their units; empty for the device's own."""


@dataclass(frozen=True)
class CameraSetting:
    """One setting of a camera as it is now; of an unknown value (its automatic is on) ``value`` is None.

    A step of 0: any value between the bounds. ``refusal``: why it cannot be changed, as the end of a sentence
    that begins with its name; empty if it can.
    """

    name: str
    value: float | None
    minimum: float
    maximum: float
    step: float = 0.0
    automatic: bool = False
    refusal: str = ""


class FrameTime(NamedTuple):
    """A frame's count, as `Frame` has it, and when its exposure began, seconds of CLOCK_MONOTONIC."""

    sequence: int
    exposure_began_s: float


@dataclass(frozen=True)
class CameraInfo:
    """What a camera states of itself; whatever it does not know keeps its default.

    Attributes
    ----------
    size_px
        (width, height) of every picture that it gives.
    sensor_mode
        Which pixels of its sensor its pictures show, as it was when the camera was opened; no picture of
        another mode is given.
    period_s
        From frame to frame, seconds, of a camera that takes frames at a steady rate, requested or not.
    trigger
        The name of what exposes its frames; cameras of one trigger expose together. Empty: free-running.
    """

    simulated: bool = False
    size_px: tuple[int, int] | None = None
    sensor_mode: SensorMode | None = None
    period_s: float | None = None
    trigger: str = ""


class Camera(ABC):
    """A source of frames. Derive a driver from it and write the two abstract methods."""

    @abstractmethod
    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        """Return a frame whose exposure began after ``exposed_after_s``, within ``timeout_s`` seconds.

        Raises NoFreshFrame if none came in time; the message says what came instead.
        """

    @abstractmethod
    def close(self) -> None:
        """Let go of the device."""

    @property
    def info(self) -> CameraInfo:
        """What it states of itself now."""
        return CameraInfo()

    @property
    def counters(self) -> FrameCounts | None:
        """The counts of all its frames, requested or not, so far; None for a camera that does not count."""
        return None

    def recent_times(self) -> Sequence[FrameTime]:
        """Return the times of the frames that came last, all of one count, oldest first; empty where it does
        not keep them.
        """
        return ()

    def exposure_held(self) -> AbstractContextManager[None]:
        """Return a context in which the exposure does not change: a measurement compares its pictures."""
        return nullcontext()

    def settings(self) -> Sequence[CameraSetting]:
        """Return the settings that it has. Raises DriverError."""
        return ()

    def adjust(self, wanted: Mapping[str, float]) -> Sequence[str]:
        """Change some, each with its automatic turned off; return a sentence for each that became another.

        They are within their bounds. Frames exposed from the return on have them, or None for them.
        A camera that went away and came back has them still.

        Raises BadSetting, DriverError if the camera refuses one; those before it have changed.
        """
        raise BadSetting(f"this camera has no {min(wanted)} that can be changed while it runs")

"""A head in memory: both axes turn at constant speed, and remember where they were during the last move."""

import math
import threading
from collections.abc import Mapping
from typing import Any

from drivers.errors import BadOptions, NoReply, OutOfRange
from drivers.interfaces import PanTilt, Reading
from drivers.registry import Context, Driver


class BenchHead(PanTilt):
    def __init__(self, options: Mapping[str, Any], context: Context) -> None:
        self._speed, self._clock = options.get("speed_rad_per_s", 1.0), context.clock
        if not (math.isfinite(self._speed) and self._speed > 0):
            raise BadOptions(f"speed_rad_per_s is {self._speed}, expected above 0", device="bench head")
        self._lock = threading.Lock()
        self._move = (0.0, (0.0, 0.0), (0.0, 0.0), self._speed)  # since when, from, to, how fast
        self._closed = False
        context.shared["bench head"] = self  # for the cameras

    def at(self, time_s: float) -> tuple[float, float]:
        """Where the axes are at a moment: what the camera of this package looks from."""
        since_s, start, goal, speed = self._move
        way = speed * max(0.0, time_s - since_s)
        ends = zip(start, goal, strict=True)
        pan, tilt = (g if abs(g - s) <= way else s + math.copysign(way, g - s) for s, g in ends)
        return pan, tilt

    def read(self) -> Reading:
        with self._lock:
            if self._closed:
                raise NoReply("it is closed", device="bench head")
            now_s = self._clock.now_s()
            pan, tilt = self.at(now_s)
            return Reading(pan, tilt, (pan, tilt) != self._move[2], now_s)

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        speed = self._speed if speed_rad_per_s is None else min(speed_rad_per_s, self._speed)
        if not (math.isfinite(pan_rad + tilt_rad) and speed > 0):
            raise OutOfRange(f"{pan_rad}, {tilt_rad} rad at {speed} rad/s", device="bench head")
        with self._lock:
            now_s = self._clock.now_s()
            self._move = (now_s, self.at(now_s), (pan_rad, tilt_rad), speed)

    def stop(self) -> None:
        self.move(*self.at(self._clock.now_s()))

    def close(self) -> None:
        self.stop()
        self._closed = True


DRIVER = Driver(BenchHead, any_clock=True, halt=lambda options: ["it is in memory: nothing turns"])

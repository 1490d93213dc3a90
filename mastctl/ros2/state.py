"""What the node knows of its daemon, the names it has in ROS, and ROS time of the daemon's times.

A stamp is the daemon's CLOCK_MONOTONIC time plus an offset, in whole nanoseconds. On the daemon's own machine
the offset is that of two clocks of this machine, and no message is part of it. Elsewhere it comes from the
quickest of the newest exchanges, in the middle of its round trip.
"""

from __future__ import annotations

import logging
import re
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from calib.files.any_camera import nearest_lens
from calib.files.twin import TwinError
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid
from mastctl.ros2.tf_tree import NS, TfTree

log = logging.getLogger(__name__)

STEP_S = 1e-3
"""A smaller change of the offset is not reported; on one machine only a set clock is larger."""
SAME_S = 1e-4
EXCHANGES = 30
CALM = 60
"""Exchanges without a step after which the offset is steady again."""

FRAMES = 64
"""Images of a camera whose stamps still name them; the daemon itself keeps some 32."""


class RosNames:
    """The names of joints and frames; ``prefix`` stands before each but the ``base``'s, which has ROS's
    axes."""

    def __init__(self, prefix: str = "", base: str = "base_link") -> None:
        self.base = base
        self.pan, self.tilt = f"{prefix}pan", f"{prefix}tilt"
        self.rover, self.mast = f"{prefix}rover", f"{prefix}mast"
        self.pan_link, self.head = f"{prefix}pan_link", f"{prefix}head"
        self._prefix = prefix

    def topic(self, camera: str) -> str:
        """Return a camera's name as a topic has it: letters, digits and _, no digit first."""
        name = re.sub(r"[^A-Za-z0-9_]", "_", camera)
        return f"camera_{name}" if name[:1].isdigit() else name

    def optical(self, camera: str) -> str:
        """Return the frame of a camera: x right, y down, z ahead."""
        return f"{self._prefix}{self.topic(camera)}_optical_frame"

    def camera_of(self, frame: str, rig: Rig) -> str | None:
        """Return the camera whose optical frame this is."""
        return next((name for name in rig.cameras if self.optical(name) == frame), None)


@dataclass(frozen=True)
class ClockExchange:
    """One query of the daemon's time ``now_s``, between ``sent_s`` and ``got_s`` of this machine's monotonic
    clock; ``real_ns`` is to be added to that for its real time."""

    sent_s: float
    now_s: float
    got_s: float
    real_ns: int

    @property
    def one_clock(self) -> bool:
        """Whether both clocks are one."""
        return self.sent_s - SAME_S <= self.now_s <= self.got_s + SAME_S

    @property
    def half_s(self) -> float:
        """How far the offset may be off, seconds."""
        return 0.0 if self.one_clock else 0.5 * (self.got_s - self.sent_s)

    @property
    def offset_ns(self) -> int:
        """What is to be added to the daemon's monotonic nanoseconds for this machine's real time."""
        if self.one_clock:
            return self.real_ns
        return self.real_ns + round((0.5 * (self.sent_s + self.got_s) - self.now_s) * NS)


def real_from_monotonic_ns() -> int:
    """Return this machine's real time less its monotonic one, nanoseconds: the closest of five."""
    found = []
    for _ in range(5):
        before, real, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        found.append((after - before, real - (before + after) // 2))
    return min(found)[1]


class RosTime:
    """Stamps of the daemon's times, by one exchange a second; read from any thread.

    ``exchange`` is the one in use, None before the first; ``steps`` counts how often the offset has changed
    by more than its uncertainty: a clock was set, or the daemon's runs otherwise than real time.
    """

    def __init__(self) -> None:
        self.exchange: ClockExchange | None = None
        self.steps = 0
        self._since_step = CALM
        self._kept: deque[ClockExchange] = deque(maxlen=EXCHANGES)

    def update(self, new: ClockExchange) -> bool:
        """Take one more exchange; return whether the offset is another one than before."""
        old = self.exchange
        self._since_step += 1
        if old is not None:
            off_s = abs(new.offset_ns - old.offset_ns) / NS
            if off_s > STEP_S + new.half_s + old.half_s:
                if self.steady:  # a clock that runs otherwise than real time is reported once
                    log.warning("the offset of ROS time from the daemon's clock changed by %.6f s", off_s)
                self.steps += 1
                self._since_step = 0
                self._kept.clear()
        self._kept.append(new)
        self.exchange = new if new.one_clock else min(self._kept, key=lambda one: one.half_s)
        return old is None or old.offset_ns != self.exchange.offset_ns

    def stamp_ns(self, monotonic_s: float) -> int | None:
        """Return the ROS time of one of the daemon's times, nanoseconds; None before the first exchange."""
        return None if self.exchange is None else round(monotonic_s * NS) + self.exchange.offset_ns

    @property
    def steady(self) -> bool:
        """Whether the offset is known and has not changed for the last `CALM` exchanges."""
        return self.exchange is not None and self._since_step >= CALM


class DaemonState:
    """The daemon as the node knows it: the node's threads fill it, all others read it.

    ``rig``: by the mast file in use, None before it was read; ``lenses``: by camera the nearest of ROS's
    lenses, the camera with it, and how far that is; ``joints``: the daemon's last report; ``tree``: the
    frames of tf, the node's own among them; ``clock``: ROS time.
    """

    def __init__(self) -> None:
        self.rig: Rig | None = None
        self.lenses: Mapping[str, tuple[str, CameraModel, TwinError]] = {}
        self.joints: dict[str, Any] | None = None
        self.tree = TfTree()
        self.clock = RosTime()
        self._frames: dict[str, deque[tuple[int, str]]] = {}

    def use_rig(self, rig: Rig) -> None:
        """Take the rig of a mast file, and the nearest lens of each camera that has one."""
        lenses = {}
        for name, camera in rig.cameras.items():
            try:
                lenses[name] = nearest_lens(camera.model, "ros")
            except ValueError as error:
                log.warning("no camera_info of %s: %s", name, error)
        self.lenses, self.rig = lenses, rig

    def carrier_from_optical(self, rig: Rig, camera: str) -> Rigid:
        """Return the optical frame that a camera's K and D are in, in the frame of what carries it."""
        twin = self.lenses[camera][1] if camera in self.lenses else rig.cameras[camera].model
        return twin.pose

    def put_image(self, camera: str, at_ns: int, frame_id: str) -> None:
        """Keep the stamp with which an image was published."""
        self._frames.setdefault(camera, deque(maxlen=FRAMES)).append((at_ns, frame_id))

    def frame_at(self, camera: str, at_ns: int) -> str | None:
        """Return the id of the frame that was published with a stamp, None for none of the last."""
        known = tuple(self._frames.get(camera, ()))
        return next((frame_id for stamped_ns, frame_id in known if stamped_ns == at_ns), None)

"""What the node knows: its daemon, the names it has in ROS, ROS time of the daemon's times, and tf.

A stamp is the daemon's CLOCK_MONOTONIC time plus an offset, in whole nanoseconds. On the daemon's own machine
the offset is that of two clocks of this machine, and no message is part of it. Elsewhere it comes from the
quickest of the newest exchanges, in the middle of its round trip.
"""

from __future__ import annotations

import logging
import re
import threading
import time
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.files.any_camera import nearest_lens
from calib.files.twin import TwinError
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid

log = logging.getLogger(__name__)

NS = 1_000_000_000
STEP_S = 1e-3  # a smaller change of the offset is not reported; on one machine only a set clock is larger
SAME_S = 1e-4
EXCHANGES = 30
FRAMES = 64  # images of a camera whose stamps still name them; the daemon itself keeps some 32
KEPT_NS = 10 * NS
MOST_FRAMES = 100


class RosNames:
    """The names of joints and frames; ``prefix`` stands before each but the ``base``'s, which has ROS's
    axes. ``joints``: by their names the keys of the daemon's."""

    def __init__(self, prefix: str = "", base: str = "base_link") -> None:
        self.base = base
        self.joints = {f"{prefix}pan": "pan_rad", f"{prefix}tilt": "tilt_rad"}
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

    ``exchange`` is the one in use, None before the first. ``steady``: whether the last one changed the offset
    by no more than its uncertainty; else a clock was set, or the daemon's runs otherwise than real time.
    """

    def __init__(self) -> None:
        self.exchange: ClockExchange | None = None
        self.steady = True
        self._kept: deque[ClockExchange] = deque(maxlen=EXCHANGES)

    def update(self, new: ClockExchange) -> bool:
        """Take one more exchange; return whether the offset is another one than before."""
        old, was_steady = self.exchange, self.steady
        if old is not None:
            off_s = abs(new.offset_ns - old.offset_ns) / NS
            self.steady = off_s <= STEP_S + new.half_s + old.half_s
            if not self.steady:
                self._kept.clear()
                if was_steady:  # a clock that runs otherwise than real time is reported once
                    log.warning("the offset of ROS time from the daemon's clock changed by %.6f s", off_s)
        self._kept.append(new)
        self.exchange = new if new.one_clock else min(self._kept, key=lambda one: one.half_s)
        return old is None or old.offset_ns != self.exchange.offset_ns

    def stamp_ns(self, monotonic_s: float) -> int | None:
        """Return the ROS time of one of the daemon's times, nanoseconds; None before the first exchange."""
        return None if self.exchange is None else round(monotonic_s * NS) + self.exchange.offset_ns


class NoTransform(Exception):
    """Why a point of one frame has no place in another, in one sentence."""


@dataclass
class _Edge:
    """The transforms of one child, (stamp, parent_from_child), oldest first; a static one has one."""

    parent: str
    static: bool
    known: list[tuple[int, Rigid]] = field(default_factory=list)


class TfTree:
    """The newest seconds of each transform that was received; safe to use from any thread.

    tf2 keeps the same, but comes with ROS only, in C++. Between two stamps the translation is linear and the
    rotation about one axis.
    """

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}
        self._changed = threading.Condition()

    def put(self, parent: str, child: str, at_ns: int, parent_from_child: Rigid, static: bool) -> None:
        """Take a transform; one that is older than the newest takes its place among the others."""
        with self._changed:
            edge = self._edges.get(child)
            if edge is None or (edge.parent, edge.static) != (parent, static):
                edge = self._edges[child] = _Edge(parent, static)
            known = edge.known
            if static or (known and at_ns < known[-1][0] - KEPT_NS):  # or the clock was set back
                known.clear()
            if all(at_ns != one for one, _ in known):
                insort(known, (at_ns, parent_from_child), key=lambda one: one[0])
            del known[: bisect_left(known, known[-1][0] - KEPT_NS, key=lambda one: one[0])]
            self._changed.notify_all()

    def transform(self, target: str, source: str, at_ns: int, timeout_s: float = 0.0) -> Rigid:
        """Return target_from_source at a time, 0 for the newest that all transforms between them know.

        Waits up to ``timeout_s`` seconds of this machine for what is not known yet. Raises NoTransform: which
        frame, or which time, is not known.
        """
        until_s = time.monotonic() + timeout_s
        with self._changed:
            while True:
                try:
                    return self._transform(target, source, at_ns)
                except NoTransform:
                    left_s = until_s - time.monotonic()
                    if left_s <= 0.0:
                        raise
                    self._changed.wait(left_s)

    def _transform(self, target: str, source: str, at_ns: int) -> Rigid:
        up, down = self._to_root(source), self._to_root(target)
        if up[-1] != down[-1]:
            for frame in (source, target):
                if frame not in self._edges and all(frame != edge.parent for edge in self._edges.values()):
                    raise NoTransform(f"tf does not know the frame '{frame}'")
            raise NoTransform(f"tf knows '{source}' and '{target}', but no way from one to the other")
        while len(up) > 1 and len(down) > 1 and up[-2] == down[-2]:
            up, down = up[:-1], down[:-1]
        if not at_ns:
            edges = [self._edges[child] for child in (*up[:-1], *down[:-1])]
            at_ns = min((edge.known[-1][0] for edge in edges if not edge.static), default=0)
        return self._along(down, at_ns).inverse @ self._along(up, at_ns)

    def _to_root(self, frame: str) -> list[str]:
        """A frame, its parent, and so on to the root."""
        frames = [frame]
        while (edge := self._edges.get(frames[-1])) is not None:
            if len(frames) > MOST_FRAMES:
                raise NoTransform(f"the frames of tf above '{frame}' go in a circle")
            frames.append(edge.parent)
        return frames

    def _along(self, frames: list[str], at_ns: int) -> Rigid:
        """last_from_first of frames, each the parent of the one before."""
        found = Rigid.identity()
        for child in frames[:-1]:
            found = self._at(child, at_ns) @ found
        return found

    def _at(self, child: str, at_ns: int) -> Rigid:
        edge = self._edges[child]
        if edge.static:
            return edge.known[0][1]
        stamps = [one for one, _ in edge.known]
        at = bisect_left(stamps, at_ns)
        if at < len(stamps) and stamps[at] == at_ns:
            return edge.known[at][1]
        if at == 0 or at == len(stamps):
            off_s = (stamps[0] - at_ns if at == 0 else at_ns - stamps[-1]) / NS
            side = "before the oldest" if at == 0 else "after the newest"
            raise NoTransform(f"the stamp is {off_s:.3f} s {side} transform of '{child}' that is known")
        (before_ns, before), (after_ns, after) = edge.known[at - 1], edge.known[at]
        part = (at_ns - before_ns) / (after_ns - before_ns)
        turn = Rotation.from_matrix(before.rotation.T @ after.rotation).as_rotvec()
        moved = before.translation_m + part * (after.translation_m - before.translation_m)
        return Rigid(before.rotation @ np.asarray(Rotation.from_rotvec(part * turn).as_matrix()), moved)


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

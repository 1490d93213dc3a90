"""Frames that tf knows: the newest seconds of each transform, and the transform from one frame to another.

tf2 keeps the same, but comes with ROS only, in C++; a client that turns one point at a time needs these
lines of it. Between two stamps the translation is linear and the rotation about one axis.
"""

from __future__ import annotations

import threading
import time
from bisect import bisect_left, insort
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.rigid import Rigid

NS = 1_000_000_000
KEPT_NS = 10 * NS
MOST_FRAMES = 100


class NoTransform(Exception):
    """Why a point of one frame has no place in another, in one sentence."""


def stamp_ns(time: Any) -> int:
    """Return a ``builtin_interfaces/Time`` as nanoseconds."""
    return int(time.sec) * NS + int(time.nanosec)


@dataclass
class _Edge:
    """The transforms of one child, (stamp, parent_from_child), oldest first; a static one has one."""

    parent: str
    static: bool
    known: list[tuple[int, Rigid]] = field(default_factory=list)


class TfTree:
    """The transforms that were received; safe to use from any thread."""

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

"""Frames that tf knows: the newest seconds of each transform, and the way from one frame to another.

tf2 keeps the same, but comes with ROS only, in C++; a client that turns one point at a time needs these
lines of it. Between two stamps the translation goes straight and the rotation along its shortest way.
"""

from __future__ import annotations

import threading
import time
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from calib.geometry.rigid import Rigid
from mastctl.ros2.times import NS

KEPT_NS = 10 * NS
LONGEST_WAY = 100


class NoTransform(Exception):
    """Why a point of one frame cannot be told in another, in one sentence."""


@dataclass
class _Edge:
    """The transforms of one child, parent_from_child, oldest first; a static one has one of no stamp."""

    parent: str
    static: bool
    known: deque[tuple[int, Rigid]] = field(default_factory=deque)


class TfTree:
    """The transforms that were heard; safe to use from any thread."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}
        self._changed = threading.Condition()

    def put(self, parent: str, child: str, stamp_ns: int, parent_from_child: Rigid, static: bool) -> None:
        """Take a transform; one that is older than the newest takes its place among the others."""
        with self._changed:
            edge = self._edges.get(child)
            if edge is None or edge.parent != parent or edge.static != static:
                edge = self._edges[child] = _Edge(parent, static)
            known = edge.known
            if static:
                known.clear()
            if known and stamp_ns < known[-1][0] - KEPT_NS:
                known.clear()  # the clock was set back
            if not known or stamp_ns > known[-1][0]:
                known.append((stamp_ns, parent_from_child))
            elif all(stamp_ns != one for one, _ in known):
                known.insert(bisect_left([one for one, _ in known], stamp_ns), (stamp_ns, parent_from_child))
            while known[0][0] < known[-1][0] - KEPT_NS:
                known.popleft()
            self._changed.notify_all()

    def transform(self, target: str, source: str, stamp_ns: int, timeout_s: float = 0.0) -> Rigid:
        """Return target_from_source at a time, 0 for the newest that all of the way know.

        Waits up to ``timeout_s`` seconds of this machine for what is not known yet.

        Raises
        ------
        NoTransform
            Which frame, or which time, is not known.
        """
        until_s = time.monotonic() + timeout_s
        with self._changed:
            while True:
                try:
                    return self._transform(target, source, stamp_ns)
                except NoTransform:
                    left_s = until_s - time.monotonic()
                    if left_s <= 0.0:
                        raise
                    self._changed.wait(left_s)

    def _transform(self, target: str, source: str, stamp_ns: int) -> Rigid:
        up, down = self._way(source), self._way(target)
        if up[-1] != down[-1]:
            for frame in (source, target):
                if frame not in self._edges and all(frame != edge.parent for edge in self._edges.values()):
                    raise NoTransform(f"tf does not know the frame '{frame}'")
            raise NoTransform(f"tf knows '{source}' and '{target}', but no way from one to the other")
        while len(up) > 1 and len(down) > 1 and up[-2] == down[-2]:
            up, down = up[:-1], down[:-1]
        if not stamp_ns:
            moving = [self._edges[child].known[-1][0] for child in (*up[:-1], *down[:-1])
                      if not self._edges[child].static]  # fmt: skip
            stamp_ns = min(moving, default=0)
        return self._along(down, stamp_ns).inverse @ self._along(up, stamp_ns)

    def _way(self, frame: str) -> list[str]:
        """A frame, its parent, and so on to the root."""
        way = [frame]
        while (edge := self._edges.get(way[-1])) is not None:
            if len(way) > LONGEST_WAY:
                raise NoTransform(f"the frames of tf above '{frame}' go in a circle")
            way.append(edge.parent)
        return way

    def _along(self, way: list[str], stamp_ns: int) -> Rigid:
        """last_from_first of a way up."""
        found = Rigid.identity()
        for child in way[:-1]:
            found = self._at(child, stamp_ns) @ found
        return found

    def _at(self, child: str, stamp_ns: int) -> Rigid:
        edge = self._edges[child]
        stamps = [one for one, _ in edge.known]
        if edge.static:
            return edge.known[0][1]
        at = bisect_left(stamps, stamp_ns)
        if at < len(stamps) and stamps[at] == stamp_ns:
            return edge.known[at][1]
        if at == 0 or at == len(stamps):
            off_s = (stamps[0] - stamp_ns if at == 0 else stamp_ns - stamps[-1]) / NS
            side = "before the oldest" if at == 0 else "after the newest"
            raise NoTransform(f"the stamp is {off_s:.3f} s {side} transform of '{child}' that is known")
        (before_ns, before), (after_ns, after) = edge.known[at - 1], edge.known[at]
        return between(before, after, (stamp_ns - before_ns) / (after_ns - before_ns))


def between(before: Rigid, after: Rigid, part: float) -> Rigid:
    """Return the transform a part (0 to 1) of the way from one to another."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(before.rotation.T @ after.rotation).as_rotvec()
    moved = before.translation_m + part * (after.translation_m - before.translation_m)
    return Rigid(before.rotation @ np.asarray(Rotation.from_rotvec(part * turn).as_matrix()), moved)

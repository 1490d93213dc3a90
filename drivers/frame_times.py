"""Times of frames: stamps corrected by what was measured of them, and which frames of several cameras belong
together: those of one trigger, or those nearest in time.

Free-running cameras expose up to half a period apart, by an offset that stays nearly the same for a while. It
is learned from the times of the frames that came last, so that the same partner is taken each time even where
the offset is near half a period. Cameras with one hardware trigger are paired by their counts instead.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from drivers.interfaces import Camera, CameraInfo, CameraSetting, Frame, FrameCounts, FrameTime

MOST_OFFSET_S = 1.0
"""No camera's stamps are further off than a fault of its driver."""

SLOP_S = 0.002
"""How much more than half a period two frames of a pair may be apart: jitter of the stamps."""

LEAST_TO_LEARN = 5
COUNTED_FROM = 5
"""From so many of the last frames the difference of two triggered cameras' counts is learned."""


def corrected(camera: Camera, offset_s: float) -> Camera:
    """Return a camera whose frames' ``mid_exposure_s`` are later by ``offset_s``; itself for 0."""
    return camera if offset_s == 0.0 else CorrectedCamera(camera, offset_s)


class CorrectedCamera(Camera):
    """Made by `corrected`. What is requested beside pictures and their times goes to the camera."""

    def __init__(self, camera: Camera, offset_s: float) -> None:
        self._camera = camera
        self._offset_s = offset_s
        self._narrower_s = 0.0  # by how much a frame's span was narrowed at either end

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        """Return the camera's next frame that by the corrected time began after ``exposed_after_s``.

        A driver that states how uncertain its times are (``mid_uncertainty_s``) gives a span longer than the
        exposure. That mid-exposure is known by measurement takes as much off either end: the exposure lay
        in the driver's own span, and nothing becomes later than the frame's arrival.
        """
        frame: Frame = self._camera.next_frame(exposed_after_s - self._offset_s, timeout_s)
        try:
            uncertainty_s = float(getattr(frame, "mid_uncertainty_s", 0.0))
            widest_s = max(0.0, min(uncertainty_s, frame.exposure_s / 2))
            self._narrower_s = min(abs(self._offset_s), widest_s)
            changes: dict[str, Any] = {
                "mid_exposure_s": frame.mid_exposure_s + self._offset_s,
                "exposure_s": frame.exposure_s - 2 * self._narrower_s,
            }
            if isinstance(frame, Frame):
                if uncertainty_s > 0.0:
                    changes["mid_uncertainty_s"] = uncertainty_s - self._narrower_s
                return dataclasses.replace(frame, **changes)
            return Frame(frame.image, frame.sequence, **changes)
        except (AttributeError, TypeError, ValueError):
            return frame  # no frame at all: the service refuses it itself

    def close(self) -> None:
        """Let go of the camera."""
        self._camera.close()

    @property
    def info(self) -> CameraInfo:
        """What the camera states of itself."""
        return self._camera.info

    @property
    def counters(self) -> FrameCounts | None:
        """The camera's counts of its frames."""
        return self._camera.counters

    def recent_times(self) -> list[FrameTime]:
        """Return the corrected times of the frames that came last."""
        later_s = self._offset_s + self._narrower_s
        return [FrameTime(sequence, began_s + later_s) for sequence, began_s in self._camera.recent_times()]

    def exposure_held(self) -> AbstractContextManager[None]:
        """Return the camera's context in which the exposure does not change."""
        return self._camera.exposure_held()

    def settings(self) -> Sequence[CameraSetting]:
        """Return the camera's settings."""
        return self._camera.settings()

    def adjust(self, wanted: Mapping[str, float]) -> Sequence[str]:
        """Change some of them."""
        return self._camera.adjust(wanted)


class Stamped(Protocol):
    """What pairing looks at: every frame has it."""

    @property
    def sequence(self) -> int: ...
    @property
    def exposure_began_s(self) -> float: ...


@dataclass(frozen=True)
class Offset:
    """What is known of two cameras before frames of them are taken.

    ``period_s``: from frame to frame, of the slower one; infinite where it is not known. ``usual_s``: how
    much later the other one exposes; None before it is learned and where it is not constant. ``began_s``:
    when an exposure of the first one began, the others are whole periods away. ``counts_apart``: by how much
    the other one's count is higher for the same trigger; None for free-running cameras.
    """

    period_s: float = math.inf
    usual_s: float | None = None
    counts_apart: int | None = None
    began_s: float | None = None


@dataclass(frozen=True)
class Pace:
    """What a camera's driver says of its frames' times."""

    period_s: float
    trigger: str
    recent: Sequence[FrameTime]


def learned(one: Pace | None, other: Pace | None, before: Offset | None = None) -> Offset:
    """Return what two cameras' last frames say; nothing where one has no pace (None).

    ``before`` is what was learned the last time: near half a period, where two partners are equally good, the
    choice stays the same.
    """
    if one is None or other is None:
        return Offset()
    ones, others = one.recent, other.recent
    if min(len(ones), len(others)) < LEAST_TO_LEARN:
        return Offset(max(one.period_s, other.period_s))
    period_s = max(_measured_period_s(one.period_s, ones), _measured_period_s(other.period_s, others))
    triggered = one.trigger != "" and one.trigger == other.trigger
    times_s = np.array([frame.exposure_began_s for frame in ones])
    theirs_s = np.array([frame.exposure_began_s for frame in others])
    nearest = np.abs(theirs_s[:, None] - times_s[None, :]).argmin(axis=1)
    apart_s = theirs_s - times_s[nearest]
    # By whole periods nearer to the last one: a frame may have lost its partner, or wait for it.
    apart_s -= period_s * np.round((apart_s - apart_s[-1]) / period_s)
    usual_s = float(np.median(apart_s))
    spread_s = float(np.median(np.abs(apart_s - usual_s)))
    usual_s -= period_s * round(usual_s / period_s)
    same_s, was_s = usual_s, None if before is None else before.usual_s
    if was_s is not None:
        same_s -= period_s * round((usual_s - was_s) / period_s)
    if abs(same_s) <= period_s / 2 + SLOP_S:
        usual_s = same_s
    counts_apart = None
    if triggered:
        counts_apart = statistics.median_low(
            frame.sequence - ones[index].sequence
            for frame, index in list(zip(others, nearest, strict=True))[-COUNTED_FROM:]
        )
    return Offset(period_s, usual_s if spread_s <= period_s / 4 else None, counts_apart, float(times_s[-1]))


def _measured_period_s(nominal_s: float, times: Sequence[FrameTime]) -> float:
    """The period by the frames themselves: an automatic exposure may have made it longer."""
    first, last = times[0], times[-1]
    counted = last.sequence - first.sequence
    span_s = last.exposure_began_s - first.exposure_began_s
    return span_s / counted if counted > 0 and span_s > 0 else nominal_s


class Pairing:
    """Decides, while frames of several cameras are taken, which camera's next one is still needed."""

    def __init__(self, first: str, offsets: Mapping[str, Offset]) -> None:
        self._first = first
        self._offsets = dict(offsets)

    def moments(self, exposed_after_s: float) -> dict[str, float]:
        """Return after which moment to query each camera, so that the first frames to come belong together.

        Each moment is no earlier than requested, and where the cameras' rhythm is known half a period before
        an expected frame.
        """
        rhythm = self._rhythm()
        if rhythm is None or rhythm.began_s is None:
            return dict.fromkeys((self._first, *self._offsets), exposed_after_s)
        earliest_s = exposed_after_s - min(0.0, *(offset.usual_s or 0.0 for offset in self._offsets.values()))
        between_s = rhythm.began_s - rhythm.period_s / 2
        first_s = between_s + rhythm.period_s * math.ceil((earliest_s - between_s) / rhythm.period_s)
        return {self._first: first_s} | {n: first_s + (o.usual_s or 0.0) for n, o in self._offsets.items()}

    def _rhythm(self) -> Offset | None:
        """An offset that shows when frames are to be expected; None unless it is known of all cameras."""
        known = [offset for offset in self._offsets.values() if offset.usual_s is not None]
        return known[0] if known and len(known) == len(self._offsets) else None

    def again(self, frames: Mapping[str, Stamped]) -> dict[str, float]:
        """Return after which moment to query which cameras again; none if all frames belong together.

        Where the rhythm is known all are queried anew, since those whose frame is newer do not wait. But
        counts that stamps contradict show only in frames that stand still.
        """
        behind = self.behind(frames)
        counted = any(offset.counts_apart is not None for offset in self._offsets.values())
        if behind and self._rhythm() is not None and not counted:
            return self.moments(max(frame.exposure_began_s for frame in frames.values()))
        return {name: frames[name].exposure_began_s + by_s for name, by_s in behind.items()}

    def behind(self, frames: Mapping[str, Stamped]) -> dict[str, float]:
        """Return the cameras whose frame is too old for the others'; empty if all belong together.

        With each camera comes how many seconds later, at least, its next frame must be.
        """
        one = frames[self._first]
        found: dict[str, float] = {}
        for name, offset in self._offsets.items():
            late_s = _late_s(one, frames[name], offset)
            if late_s is None:  # the stamps contradict the counts: one of the two missed a trigger
                self._offsets[name] = offset = replace(offset, counts_apart=None)
                late_s = _late_s(one, frames[name], offset) or 0.0
            if late_s:
                behind = name if late_s < 0 else self._first
                found[behind] = max(found.get(behind, 0.0), abs(late_s) - offset.period_s / 2)
        return found


def _late_s(one: Stamped, other: Stamped, offset: Offset) -> float | None:
    """How much later the other frame is than the one's partner: 0 if it is the partner, None if that is not
    known."""
    dt_s = other.exposure_began_s - one.exposure_began_s
    apart = abs(dt_s) > offset.period_s / 2 + SLOP_S
    if offset.counts_apart is not None:
        ahead = other.sequence - one.sequence - offset.counts_apart
        return None if ahead == 0 and apart else ahead * offset.period_s if ahead else 0.0
    if offset.usual_s is not None:
        late_s = dt_s - offset.usual_s
        return late_s if abs(late_s) > offset.period_s / 2 else 0.0
    return dt_s if apart else 0.0

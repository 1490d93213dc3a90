"""What the head and the daemon did lately, for who comes later: joints, temperatures, events.

It is kept in memory, is bounded, and ends with the daemon; a recording (`mastctl.recorder`) keeps everything.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from drivers.clock import Clock
from mastctl.control.publisher import Published, Publisher
from mastctl.devices.joint_history import HeadReading

log = logging.getLogger(__name__)

SAMPLES, EVENTS = 1200, 300
APART_S = 2.0  # between two samples of a head that moves: 40 minutes of motion
REST_S = 30.0  # of one at rest: 10 hours
MOVED_RAD = 1e-3
QUIET = frozenset({"lease.renew", "jog"})
"""Commands that come again and again and tell nothing new where they are carried out."""


class PastSample(NamedTuple):
    """The head at a moment, seconds of the daemon's clock; degrees Celsius where the driver knows them."""

    time_s: float
    pan_rad: float
    tilt_rad: float
    temperatures_c: Mapping[str, float]


class PastEvent(NamedTuple):
    """Something that happened: ``state``, ``fault`` or ``command``, in words, and whether it is well."""

    time_s: float
    kind: str
    words: str
    well: bool


class History:
    """The newest samples and events of one daemon; told from any thread.

    Parameters
    ----------
    publisher
        Whose news are kept.
    temperatures_c
        Returns what the head's axes have now; takes no lock.
    clock
        The daemon's.
    """

    def __init__(
        self, publisher: Publisher, temperatures_c: Callable[[], Mapping[str, float]], clock: Clock
    ) -> None:
        self._temperatures_c = temperatures_c
        self._clock = clock
        self._samples: deque[PastSample] = deque(maxlen=SAMPLES)
        self._events: deque[PastEvent] = deque(maxlen=EVENTS)
        self._before: HeadReading | None = None
        self._word = ""
        self._standing: dict[str, frozenset[str]] = {}
        self._news = publisher.subscribe("joints", "state", "fault", "command", known=False, every=True)
        self._thread = threading.Thread(target=self._listen, name="history", daemon=True)
        self._thread.start()

    def told(self) -> dict[str, Any]:
        """Return it as ``GET /history`` tells it: oldest first, ages instead of times."""
        now_s, samples, events = self._clock.now_s(), list(self._samples), tuple(self._events)
        newest = self._before
        if newest is not None and (not samples or newest.time_s > samples[-1].time_s):
            samples.append(self._sample(newest))
        axes = sorted({axis for one in samples for axis in one.temperatures_c})
        return {
            "age_s": [round(max(0.0, now_s - one.time_s), 1) for one in samples],
            "pan_rad": [round(one.pan_rad, 4) for one in samples],
            "tilt_rad": [round(one.tilt_rad, 4) for one in samples],
            "temperatures_c": {axis: [one.temperatures_c.get(axis) for one in samples] for axis in axes},
            "events": [
                {
                    "age_s": round(max(0.0, now_s - one.time_s), 1),
                    "kind": one.kind,
                    "words": one.words,
                    "well": one.well,
                }
                for one in events
            ],
        }

    def close(self) -> None:
        """Hear no more."""
        self._news.close()

    # In the listener's thread

    def _listen(self) -> None:
        while not self._news.closed:
            for one in self._news.wait():
                try:
                    if one.topic == "joints":
                        self._joints(one.value)
                    else:
                        self._events.extend(self._told_of(one))
                except Exception:  # a value that nobody foresaw must not end the history
                    log.exception("a message published under %s could not be kept", one.topic)

    def _joints(self, reading: HeadReading) -> None:
        before, self._before = self._before, reading
        last = self._samples[-1] if self._samples else None
        if last is not None:
            apart_s = reading.time_s - last.time_s
            moved = _moved(reading, last)
            if apart_s < (APART_S if moved else REST_S):
                return
            if moved and before is not None and before.time_s > last.time_s and not _moved(before, last):
                self._keep(before)  # until then it stood
        self._keep(reading)

    def _keep(self, reading: HeadReading) -> None:
        self._samples.append(self._sample(reading))

    def _sample(self, reading: HeadReading) -> PastSample:
        return PastSample(reading.time_s, reading.pan_rad, reading.tilt_rad, self._temperatures_c())

    def _told_of(self, one: Published) -> Iterator[PastEvent]:
        """What happened by a value that was published, if anything did."""
        now_s, value = self._clock.now_s(), one.value
        if one.topic == "state" and value.word != self._word:
            self._word = value.word
            well = value.word not in ("fault", "stopped")
            yield PastEvent(now_s, "state", _joined(value.word, value.reason), well)
        elif one.topic == "fault":
            before = self._standing.get(one.key, frozenset())
            self._standing[one.key] = frozenset(fault.code for fault in value)
            for fault in value:
                if fault.code not in before:
                    yield PastEvent(now_s, "fault", _joined(one.key, fault.message), False)
            if before and not value:
                yield PastEvent(now_s, "fault", f"{one.key}: nothing is wrong any more", True)
        elif one.topic == "command":
            yield from _command(now_s, value)


def _moved(one: HeadReading, last: PastSample) -> bool:
    return max(abs(one.pan_rad - last.pan_rad), abs(one.tilt_rad - last.tilt_rad)) > MOVED_RAD


def _command(now_s: float, record: Mapping[str, Any]) -> Iterator[PastEvent]:
    """What a command's record, or that of its operation's end, tells."""
    if "result" in record:
        well = record["result"] == "ok"
        if not (well and record["command"] in QUIET):
            words = f"{record['who']}: {record['command']}"
            yield PastEvent(now_s, "command", words if well else _joined(words, record.get("message")), well)
    elif "ended" in record:
        words = f"{record['ended']}: {record['state']}"
        yield PastEvent(now_s, "command", _joined(words, record.get("message")), record["state"] == "done")


def _joined(words: str, more: str | None) -> str:
    return f"{words}: {more}" if more else words

"""The recorder: what the daemon publishes, written down without anybody waiting for it.

Whoever tells it something leaves it in a queue that is bounded by its bytes; what does not fit is dropped,
counted and told, in the recording too. A thread of its own does everything that touches the disk, which may
be slow, full or gone: then there is a standing fault, and the daemon goes on.

One file is written at a time: the ring's newest segment, or a run. Each begins with mast file, configuration,
cameras and what was known last, so that it can be read alone.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from calib.geometry.rig import Rig
from drivers.clock import Clock
from mastctl.answers import RecorderTold, RecordingDeleted, RecordingEnded, RecordingListed
from mastctl.as_json import readable
from mastctl.control.standing import StandingFault
from mastctl.devices.frames import StampedFrame
from mastctl.errors import MastctlError, NotKnown, NotNow, Unable
from mastctl.recorder.entries import Entries
from mastctl.recorder.settings import RecordSettings
from mastctl.recorder.shelf import MB, Recorded, Shelf
from mastctl.recorder.writer import Attached, Clocks, RecordFile

log = logging.getLogger(__name__)
T = TypeVar("T")

NAME = "recorder"
QUEUE_BYTES = 64 << 20
QUEUE_LENGTH = 20_000
SEGMENTS = 6
AFTER_FAULT_S = 10.0
SAME_FAULT_S = 600.0
AGAIN_S = 5.0
ROOM_AGAIN = 1.1
SLOW_S = 5.0
ANSWER_S = 5.0
CLOSE_S = 3.0
SMALL_BYTES = 1000
WAIT_S = 0.25
ANOTHER_RUN = "another run begins"


@dataclass(frozen=True)
class RecordedNews:
    """One thing that was published, on its way to the file."""

    topic: str
    key: str
    value: Any
    time_s: float

    @property
    def bytes(self) -> int:
        """About how much memory it holds."""
        if isinstance(self.value, StampedFrame):
            return len(self.value.jpeg) or self.value.image.nbytes
        return SMALL_BYTES


@dataclass(frozen=True)
class AttachedMast:
    """A mast file in use: its rig, and its bytes for the recording."""

    rig: Rig
    file: Attached


@dataclass
class _Now:
    """What the writing thread is at; its own, read by others."""

    file: RecordFile | None = None
    run: str | None = None
    begun_s: float = 0.0
    words: StandingFault | None = None
    retry_s: float = 0.0
    keep_at_s: float | None = None
    keep_why: str = ""
    judged_bytes: int = -1


class Recorder:
    """Writes down what it is told; safe to use from any thread.

    Parameters
    ----------
    settings, folder
        How much, and where; ``settings.ring_s`` must be resolved.
    mast
        The mast file in use.
    others
        What else is attached: the configuration.
    facts
        Words for each file: hardware, version.
    clock
        The daemon's, which stamps what is recorded. The disk's own times go by the machine's.
    """

    def __init__(
        self,
        settings: RecordSettings,
        folder: Path,
        mast: AttachedMast,
        others: list[Attached],
        facts: dict[str, str],
        clock: Clock,
    ) -> None:
        self.settings = settings
        self._ring_s = settings.ring_s or 0.0
        self._shelf = Shelf(folder)
        self._mast = mast
        self._others = others
        self._facts = facts
        self._clock = clock
        self._entries = Entries(mast.rig, mast.file.digest)
        self._lock = threading.Condition()  # held for an append or a hand-over, never for longer
        self._queue: deque[RecordedNews] = deque()
        self._acts: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._queued_bytes = 0
        self._dropped: Counter[str] = Counter()
        self._kept_before: dict[tuple[str, str], float] = {}
        self._standing: set[tuple[str, str]] = set()
        self._now = _Now()
        self._busy_since_s: tuple[float, float] | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._work, name=NAME, daemon=True)
        self._thread.start()

    # For everybody: nothing here waits for the disk, but `start_run` and `stop_run`

    def tell(self, topic: str, key: str, value: Any, time_s: float | None = None) -> None:
        """Leave something to be written down; never waits, never raises."""
        now = self._now
        mast = isinstance(value, AttachedMast)  # never left out: all later pictures are measured by it
        if not (self._ring_s or now.run or self._acts or mast or topic in Entries.STICKY):
            return  # nothing is recorded
        one = RecordedNews(topic, key, value, self._clock.now_s() if time_s is None else time_s)
        with self._lock:
            full = self._queued_bytes + one.bytes > QUEUE_BYTES or len(self._queue) >= QUEUE_LENGTH
            if (full and not mast) or self._closing:
                self._dropped[topic] += 1
                return
            self._queue.append(one)
            self._queued_bytes += one.bytes
            self._lock.notify()

    def missed(self, topic: str, count: int) -> None:
        """Count what never came to be told: newer values took its place."""
        with self._lock:
            self._dropped[topic] += count

    def use_mast(self, mast: AttachedMast) -> None:
        """Put another mast file into the recording, for what comes from now on."""
        self.tell("mast_file", "in_use", mast)

    def use_settings(self, settings: RecordSettings, others: list[Attached]) -> None:
        """Keep as much as this, in the same folder; attach something else from the next file on."""
        with self._lock:
            self.settings, self._ring_s, self._others = settings, settings.ring_s or 0.0, others

    def told(self) -> RecorderTold:
        """Return what is recorded now, as JSON: the run's name, sizes in 10⁶ bytes, what was dropped."""
        now = self._now
        file = now.file
        return {
            "recording": file is not None,
            "ring_s": self._ring_s,
            "run": now.run,
            "file": None if file is None else file.path.name,
            "size_mb": 0.0 if file is None else file.size_mb,
            "dropped": self._dropped_so_far(),
            "fault": None if now.words is None else now.words.message,
            "folder": str(self._shelf.folder),
        }

    def free_mb(self) -> float | None:
        """Return how much the disk has free, 10⁶ bytes; None if it does not say. Asks the disk."""
        try:
            return self._shelf.free_bytes() / MB
        except OSError:
            return None

    def faults(self) -> tuple[StandingFault, ...]:
        """Return what keeps it from recording."""
        found = [one for one in (self._now.words,) if one is not None]
        busy, file = self._busy_since_s, self._now.file
        waits_s = 0.0 if file is None else file.disk_waits_s
        if busy is None and waits_s > SLOW_S:
            busy = time.monotonic() - waits_s, self._clock.now_s() - waits_s
        if busy is not None and time.monotonic() - busy[0] > SLOW_S:
            words = f"{self._shelf.folder} does not answer; the record may lack events of this time"
            found.append(StandingFault(NAME, "slow", words, busy[1], "the disk answers"))
        return tuple(found)

    def recordings(self) -> list[RecordingListed]:
        """Return what lies in the folder, as JSON. Raises Unable ``unreadable``."""
        try:
            return [one.told() for one in self._shelf.all()]
        except OSError as error:
            words = f"{self._shelf.folder} cannot be read: {error.strerror or error}"
            raise Unable("unreadable", words) from None

    def file(self, name: str, file: str) -> Path:
        """Return a file of a recording, by the names that `recordings` tells.

        Raises
        ------
        NotKnown
            ``recording_unknown``.
        NotNow
            ``recording`` while it is written.
        Unable
            ``unreadable``.
        """
        found = next((path for path in self._found(name).files if readable(path.name) == file), None)
        if found is None:
            raise NotKnown("recording_unknown", f"the recording {name[:80]} has no file {file[:80]}")
        now = self._now.file
        if now is not None and now.path == found:
            raise NotNow("recording", f"{file} is being written; it can be read when that has ended")
        return found

    def delete(self, name: str) -> RecordingDeleted:
        """Delete a run, or what a fault kept; return what is left, as `recordings`.

        Raises
        ------
        NotKnown
            ``recording_unknown``.
        NotNow
            ``recording`` for a run that is recorded, and for the ring.
        Unable
            ``unwritable`` if the disk refuses, ``unreadable``; ``slow`` if it does not answer in time.
        """
        return self._asked(lambda: self._delete(name))

    def _found(self, name: str) -> Recorded:
        try:
            found = next((one for one in self._shelf.all() if one.name == name), None)
        except OSError as error:
            words = f"{self._shelf.folder} cannot be read: {error.strerror or error}"
            raise Unable("unreadable", words) from None
        if found is None:
            raise NotKnown("recording_unknown", f"there is no recording {name[:80]}")
        return found

    def start_run(self, name: str) -> RecorderTold:
        """Begin a run and return `told`.

        Raises
        ------
        NotNow
            ``recording`` if one is recorded already.
        Unable
            ``unwritable``, ``disk_low``; ``slow`` if the disk does not answer in time.
        """
        return self._asked(lambda: self._start_run(name))

    def stop_run(self) -> RecordingEnded:
        """End the run and return its name and size; what is recorded then is the ring again.

        Raises
        ------
        NotNow
            ``not_recording``.
        Unable
            ``run_gone`` if its file is there no longer; ``slow`` if the disk does not answer in time.
        """
        return self._asked(self._stop_run)

    def close(self) -> None:
        """Write down what waits and end the file; bounded. Does nothing the second time."""
        with self._lock:
            self._closing = True
            self._lock.notify()
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            log.error("%s does not answer; the newest second is not written down", self._shelf.folder)

    def _dropped_so_far(self) -> dict[str, int]:
        with self._lock:
            return dict(self._dropped)

    def _asked(self, act: Callable[[], T]) -> T:
        """Have the writing thread do something, and wait for it."""
        answer: Future[T] = Future()
        with self._lock:
            if self._closing:
                raise Unable("closing", "the service is closing")
            self._acts.append((act, answer))
            self._lock.notify()
        try:
            return answer.result(ANSWER_S)
        except TimeoutError:
            words = f"{self._shelf.folder} did not answer within {ANSWER_S:g} s; the recorder goes on trying"
            raise Unable("slow", words) from None

    # In the writing thread

    def _work(self) -> None:
        while True:
            with self._lock:
                if not self._queue and not self._acts and not self._closing:
                    self._lock.wait(WAIT_S if self._awake else None)
                batch, self._queue, self._queued_bytes = self._queue, deque(), 0
                acts, self._acts = self._acts, deque()
                closing = self._closing
            self._busy_since_s = time.monotonic(), self._clock.now_s()
            self._guarded(lambda batch=batch: self._write(batch))  # type: ignore[misc]
            for act, answer in acts:
                self._answer(act, answer)
            self._guarded(self._look_after)
            self._busy_since_s = None
            if closing:
                self._guarded(self._end_file)
                return

    @property
    def _awake(self) -> bool:
        """Whether there is something to look after without being told anything."""
        return self._now.file is not None or self._now.keep_at_s is not None

    def _answer(self, act: Callable[[], Any], answer: Future[Any]) -> None:
        try:
            answer.set_result(act())
        except OSError as error:
            self._failed(error)
            answer.set_exception(Unable("unwritable", self._now.words.message if self._now.words else ""))
        except MastctlError as error:
            answer.set_exception(error)
        except Exception as error:  # a defect must not end the thread
            log.exception("the recorder met a defect of the program")
            answer.set_exception(error)

    def _guarded(self, work: Callable[[], None]) -> None:
        """Whatever the disk does, the thread goes on."""
        try:
            work()
        except OSError as error:
            self._failed(error)
        except Exception:
            log.exception("the recorder met a defect of the program")

    def _failed(self, error: OSError) -> None:
        """Give the file up, as a killed daemon leaves it, and try another one in a while."""
        words = f"{self._shelf.folder} cannot be written: {error.strerror or error}; nothing is recorded"
        if self._now.run is not None:
            words += f", and the run {self._now.run} has ended"
        self._stands("unwritable", words, "it can be written again")
        if self._now.file is not None:
            with contextlib.suppress(OSError):
                self._now.file.abandon()
        self._now.file, self._now.run = None, None
        self._now.retry_s = time.monotonic() + AGAIN_S

    def _stands(self, code: str, words: str, until: str) -> None:
        before = self._now.words
        since_s = self._clock.now_s() if before is None or before.code != code else before.since_s
        self._now.words = StandingFault(NAME, code, words, since_s, until)
        if before is None or before.code != code:
            log.error("%s", words)

    def _write(self, batch: deque[RecordedNews]) -> None:
        """Put what was told into the file, if there is one to be written."""
        dropped = self._dropped_so_far()
        for at, one in enumerate(batch):
            try:
                self._notice(one)
                if self._now.file is None and not self._open_ring():
                    self._remember(one)
                    continue
                assert self._now.file is not None
                self._entries.write(self._now.file, one, time.monotonic())
            except OSError:
                for rest in list(batch)[at:]:
                    self.missed(rest.topic, 1)
                    self._remember(rest)
                raise
            except Exception:  # a value of a kind that nobody expected must not end the recording
                self.missed(one.topic, 1)
                log.exception("the message %s %s cannot be recorded", one.topic, one.key)
        if dropped and self._now.file is not None:
            self._entries.tell_dropped(self._now.file, dropped, self._clock.now_s(), time.monotonic())

    def _remember(self, one: RecordedNews) -> None:
        """Keep what the next file must begin with."""
        self._entries.remember(one)
        if isinstance(one.value, AttachedMast):
            self._mast = one.value
            self._entries.use_mast(one.value.rig, one.value.file.digest)

    def _notice(self, one: RecordedNews) -> None:
        """See what changes the recording itself: another mast file, a fault."""
        if isinstance(one.value, AttachedMast):
            self._remember(one)
            if self._now.file is not None:
                self._now.file.attach(one.value.file, self._now.file.clocks.ns(one.time_s))
                self._entries.tell_cameras(self._now.file, one.time_s, time.monotonic())
        if one.topic != "fault" or one.key == NAME:  # a disk that is full is not told to keep more
            return
        now_s = time.monotonic()
        standing = {(one.key, fault.code) for fault in one.value}
        new = standing - self._standing
        self._standing = {entry for entry in self._standing if entry[0] != one.key} | standing
        new = {entry for entry in new if now_s - self._kept_before.get(entry, -SAME_FAULT_S) >= SAME_FAULT_S}
        if new and self._ring_s and self._now.keep_at_s is None:
            self._now.keep_at_s = now_s + AFTER_FAULT_S
            self._now.keep_why = "-".join(sorted(new)[0])
        self._kept_before |= dict.fromkeys(new, now_s)

    def _look_after(self) -> None:
        """Flush, go on to the next file, keep what a fault wants kept, stay within the bounds."""
        now, now_s = self._now, time.monotonic()
        if now.keep_at_s is not None and (now_s >= now.keep_at_s or self._closing):
            self._keep()
        file = now.file
        if file is None or self._gone(file):
            return
        file.flush_if_due(now_s)
        if file.size == now.judged_bytes or self._room_is_low():
            return
        now.judged_bytes = file.size
        if now.run is not None:
            if file.size > self.settings.run_mb * MB:
                name, mb = now.run, self.settings.run_mb
                self._end_file()
                self._stands("run_full", f"the run {name} has ended: it has {mb:g} MB", ANOTHER_RUN)
        elif (
            now_s - now.begun_s > self._ring_s / SEGMENTS or file.size > self.settings.ring_mb * MB / SEGMENTS
        ):
            self._end_file(wait=False)
            self._shelf.trim_ring(self._ring_s, self.settings.ring_mb)

    def _gone(self, file: RecordFile) -> bool:
        """End a file that somebody took away, so that it is not written on where nobody finds it."""
        if file.in_place:
            return False
        run, how = self._now.run, f"its file {file.path} was deleted or moved while it was recorded"
        self._end_file(wait=False)
        if run is None:
            log.warning("another segment of the ring begins: %s", how)
        else:
            self._stands("run_gone", f"the run {run} has ended: {how}", ANOTHER_RUN)
        return True

    def _room_is_low(self) -> bool:
        """End the recording before the disk is full, the ring's oldest first; whether it was ended."""
        least = self.settings.free_mb * MB
        while self._shelf.free_bytes() < least:
            if self._shelf.drop_oldest_segment():
                continue
            free_mb = self._shelf.free_bytes() / MB
            run = "" if self._now.run is None else f", and the run {self._now.run} has ended"
            words = (
                f"the disk of {self._shelf.folder} has {free_mb:.0f} MB free where "
                f"{self.settings.free_mb:g} MB are left to others; nothing is recorded{run}"
            )
            self._end_file()
            self._stands("disk_low", words, "there is more room")
            self._now.retry_s = time.monotonic() + AGAIN_S
            return True
        return False

    def _keep(self) -> None:
        """Move the ring's segments out of its way, the newest too."""
        now = self._now
        now.keep_at_s = None
        if now.run is None:
            self._end_file()
        if name := self._shelf.keep_ring(now.keep_why, self.settings.kept_mb):
            log.warning("the recording around a fault is kept: %s", name)

    def _open_ring(self) -> bool:
        """Open the ring's next segment, if there is to be one now."""
        if not self._ring_s or time.monotonic() < self._now.retry_s:
            return False
        return self._open(lambda: self._shelf.next_segment(), None)

    def _open(self, path: Callable[[], Path], run: str | None) -> bool:
        """Open a file, tell it what was known last; False if there is no room."""
        self._shelf.prepare()
        room = ROOM_AGAIN if self._now.words is not None and self._now.words.code == "disk_low" else 1.0
        if self._shelf.free_bytes() < room * self.settings.free_mb * MB:
            self._room_is_low()
            self._now.retry_s = time.monotonic() + AGAIN_S
            if self._shelf.free_bytes() < room * self.settings.free_mb * MB:
                return False
        clocks = Clocks(self._clock.now_s(), time.time_ns())
        facts = self._facts | ({} if run is None else {"run": run})
        self._now.file = RecordFile(path(), [self._mast.file, *self._others], facts, clocks)
        self._now.begun_s, self._now.run = time.monotonic(), run
        if run is not None or (self._now.words is not None and self._now.words.until != ANOTHER_RUN):
            self._now.words = None
        self._entries.begin(self._now.file, self._clock.now_s(), time.monotonic())
        return True

    def _end_file(self, *, wait: bool = True) -> None:
        """End the file that is written, if there is one; no run is recorded then."""
        file, self._now.file, self._now.run = self._now.file, None, None
        if file is not None:
            file.finish(wait=wait)

    def _start_run(self, name: str) -> RecorderTold:
        if self._now.run is not None:
            raise NotNow("recording", f"the run {self._now.run} is recorded already; end it first")
        self._end_file()
        self._shelf.prepare()
        path = self._shelf.next_run(name)
        if not self._open(lambda: path, path.stem):
            words = self._now.words
            raise Unable("disk_low", "there is no room" if words is None else words.message)
        log.info("run %s is recorded", path.stem)
        return self.told()

    def _delete(self, name: str) -> RecordingDeleted:
        one = self._found(name)
        if one.kind == "ring":
            words = "the ring is written over and over; record.ring_s in the configuration says how long"
            raise NotNow("recording", words)
        if name == self._now.run:
            raise NotNow("recording", f"the run {name} is recorded; end it first")
        try:
            self._shelf.delete(one)
        except OSError as error:
            raise Unable("unwritable", f"{name} cannot be deleted: {error.strerror or error}") from None
        log.info("the recording %s was deleted", name)
        return {"recordings": self.recordings()}

    def _stop_run(self) -> RecordingEnded:
        file, run = self._now.file, self._now.run
        if file is None or run is None:
            raise NotNow("not_recording", "no run is recorded; 'record start' begins one")
        if self._gone(file):
            assert self._now.words is not None
            raise Unable("run_gone", self._now.words.message)
        self._end_file()
        log.info("run %s has ended", run)
        dropped = self._dropped_so_far()
        size_mb = file.path.stat().st_size / MB
        return {"run": run, "file": str(file.path), "size_mb": size_mb, "dropped": dropped}

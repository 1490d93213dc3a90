"""The recorder: what the daemon publishes, written to MCAP files without delaying the daemon.

One thread reads what is published and does everything that touches the disk, which may be slow, full or
gone: then there is a standing fault, and the daemon goes on. The publisher keeps what the thread has not read
yet, up to a bound beyond which the oldest values are dropped and counted, in the recording too.

One file is written at a time: the ring's newest segment, or a run. Each begins with mast file, configuration,
cameras and the newest of what was known, so that it can be read alone.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any, TypeVar

from drivers.clock import Clock
from mastctl.answers import RecorderState, RecordingDeleted, RecordingEnded, Recordings
from mastctl.as_json import readable
from mastctl.control.machine import StandingFault
from mastctl.control.publisher import TOPICS, Published, Publisher, Topic
from mastctl.devices.frames import StampedFrame
from mastctl.errors import MastctlError, NotKnown, NotNow, Unable
from mastctl.recorder.entries import AttachedMast, Entries, Entry
from mastctl.recorder.folder import MB, Recorded, RecordFolder, RecordSettings
from mastctl.recorder.writer import Attached, RecordFile

log = logging.getLogger(__name__)
T = TypeVar("T")

NAME = "recorder"
NOT_RECORDED: frozenset[Topic] = frozenset({"bench"})
"""A bench calibration's own folder has all of it."""
SEGMENTS = 6
AFTER_FAULT_S = 10.0
SAME_FAULT_S = 600.0
RETRY_S = 5.0
RESUME_FREE = 1.1
SLOW_S = 5.0
ANSWER_S = 5.0
CLOSE_S = 3.0
WAIT_S = 0.1
NEXT_RUN = "another run begins"


class Recorder:
    """Records what is published, and runs that are begun and ended; safe to use from any thread.

    ``mast`` returns the mast file in use; ``others`` are attached beside it. ``facts`` of each file:
    ``hardware``, its kind; ``version``. ``frame_by_id`` returns a frame with its image, or raises
    MastctlError; ``event_value`` a published value as events have it. ``clock``, the daemon's, stamps what is
    recorded; the disk's own times go by the machine's.
    """

    def __init__(
        self,
        settings: RecordSettings,
        folder: Path,
        mast: Callable[[], AttachedMast],
        others: list[Attached],
        facts: dict[str, str],
        publisher: Publisher,
        frame_by_id: Callable[[str], StampedFrame],
        event_value: Callable[[Topic, Any], Any],
        clock: Clock,
    ) -> None:
        self._facts = facts
        self._ring_s = settings.ring_of(facts["hardware"])
        self._settings, self._others = settings, others
        self._folder = RecordFolder(folder)
        self._mast = mast
        self._clock = clock
        self._frame_by_id = frame_by_id
        self._event_value = event_value
        self._entries = Entries(mast())
        self._requests: SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = SimpleQueue()
        self._closing = False
        self._dropped: Counter[str] = Counter()
        # Of the writing thread, read by others
        self._file: RecordFile | None = None
        self._run: str | None = None
        self._fault: StandingFault | None = None
        self._busy_since_s: float | None = None
        self._begun_s = self._retry_s = 0.0
        self._judged_bytes = -1
        self._keep: tuple[float, str] | None = None  # when the ring is kept, and why
        self._fault_seen_s: dict[tuple[str, str], float] = {}
        self._news = publisher.subscribe(*(TOPICS - NOT_RECORDED))
        self._thread = threading.Thread(target=self._work, name=NAME, daemon=True)
        self._thread.start()

    # For any thread: only requests to the writing thread wait for the disk, and that bounded

    def add_handoff(self, line: dict[str, Any]) -> None:
        """Record a hand-off, a line of the log of hand-offs."""
        entry = Entry("handoff", line["time"], line, self._clock.now_s())
        self._requests.put((lambda: self._write([entry], time.monotonic()), Future()))

    def summary(self) -> RecorderState:
        """Return what is recorded now."""
        file, fault = self._file, self._fault
        return {
            "recording": file is not None,
            "ring_s": self._ring_s,
            "run": self._run,
            "file": None if file is None else file.path.name,
            "size_mb": 0.0 if file is None else file.size / MB,
            "dropped": self._dropped_so_far(),
            "fault": None if fault is None else fault.message,
            "folder": str(self._folder.path),
        }

    def listing(self) -> Recordings:
        """Return every recording, and what is recorded now. Raises Unable ``unreadable``."""
        try:
            free_mb = self._folder.free_bytes() / MB
        except OSError:
            free_mb = None
        recordings = [one.as_json() for one in self._all()]
        return {"recordings": recordings, "recorder": self.summary(), "free_mb": free_mb}

    def faults(self) -> tuple[StandingFault, ...]:
        """Return what keeps it from recording."""
        fault, busy_s, file = self._fault, self._busy_since_s, self._file
        found = () if fault is None else (fault,)
        waits_s = 0.0 if busy_s is None else time.monotonic() - busy_s
        waits_s = max(waits_s, 0.0 if file is None else file.disk_waits_s)
        if waits_s <= SLOW_S:
            return found
        message = f"{self._folder.path} does not answer; the record may lack events of this time"
        since_s = self._clock.now_s() - waits_s
        return (*found, StandingFault(NAME, "slow", message, since_s, "the disk answers"))

    def file(self, name: str, file: str) -> Path:
        """Return a file of a recording, by the names that `listing` has. Raises NotKnown, Unable, and NotNow
        while it is written.
        """
        found = next((path for path in self._found(name).files if readable(path.name) == file), None)
        if found is None:
            raise NotKnown("recording_unknown", f"the recording {name[:80]} has no file {file[:80]}")
        now = self._file
        if now is not None and now.path == found:
            raise NotNow("recording", f"{file} is being written; it can be read when that has ended")
        return found

    def delete(self, name: str) -> RecordingDeleted:
        """Delete a run, or what a fault kept; return the recordings that are left. The run that is recorded,
        and the ring, are refused. Raises NotKnown, NotNow, Unable.
        """
        return self._result(lambda: self._delete(name))

    def start_run(self, name: str) -> RecorderState:
        """Begin a run and return `summary`. Raises NotNow if one is recorded already, Unable."""
        return self._result(lambda: self._start_run(name))

    def stop_run(self) -> RecordingEnded:
        """End the run and return its name and size; the ring goes on. Raises NotNow, Unable."""
        return self._result(self._stop_run)

    def close(self) -> None:
        """Write what was published so far and end the file; bounded. Does nothing the second time."""
        self._closing = True
        self._news.close()
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            log.error("%s does not answer; the newest second is not recorded", self._folder.path)

    def _result(self, act: Callable[[], T]) -> T:
        """Have the writing thread do something, and wait for its result."""
        if self._closing:
            raise Unable("closing", "the service is closing")
        answer: Future[T] = Future()
        self._requests.put((act, answer))
        try:
            return answer.result(ANSWER_S)
        except TimeoutError:
            message = f"{self._folder.path} did not answer within {ANSWER_S:g} s; the recorder goes on trying"
            raise Unable("slow", message) from None

    def _all(self) -> list[Recorded]:
        try:
            return self._folder.all()
        except OSError as error:
            message = f"{self._folder.path} cannot be read: {error.strerror or error}"
            raise Unable("unreadable", message) from None

    def _found(self, name: str) -> Recorded:
        found = next((one for one in self._all() if one.name == name), None)
        if found is None:
            raise NotKnown("recording_unknown", f"there is no recording {name[:80]}")
        return found

    def _dropped_so_far(self) -> dict[str, int]:
        """How many values were not recorded, by topic; ``overtaken``: that the publisher did not keep."""
        lost = self._news.lost
        return dict(self._dropped) | ({"overtaken": lost} if lost else {})

    # In the writing thread

    def _work(self) -> None:
        taken_s = time.monotonic()
        while True:
            closing = self._closing
            news = self._news.wait(WAIT_S if self._requests.empty() else 0.0)
            since_s, taken_s = taken_s, time.monotonic()  # these values were published between the two
            self._busy_since_s = time.monotonic()
            self._do(lambda: self._write(news, since_s), Future())  # noqa: B023
            while not self._requests.empty():
                self._do(*self._requests.get())
            self._do(self._look_after, Future())
            self._busy_since_s = None
            if closing and not news:
                self._do(self._end_file, Future())
                return
            if self._news.closed and not news:
                time.sleep(WAIT_S)  # the publisher was closed first

    def _do(self, act: Callable[[], Any], answer: Future[Any]) -> None:
        """Do something; whatever the disk does, the thread goes on, with another file after a while."""
        try:
            answer.set_result(act())
        except OSError as error:  # the file is left as by a daemon that was killed
            reason = f"{self._folder.path} cannot be written: {error.strerror or error}"
            file = self._stop_writing("unwritable", reason, "it can be written again")
            if file is not None:
                with contextlib.suppress(OSError):
                    file.abandon()
            answer.set_exception(Unable("unwritable", self._fault.message if self._fault else reason))
        except MastctlError as error:
            answer.set_exception(error)
        except Exception as error:
            log.exception("the recorder met a defect of the program")
            answer.set_exception(error)

    def _stop_writing(self, code: str, reason: str, until: str = NEXT_RUN) -> RecordFile | None:
        """End the run; record nothing for some seconds if a disk may recover; report the fault, and return
        the file that is to be closed.
        """
        ended = "nothing is recorded" if self._run is None else f"the run {self._run} has ended"
        before, message = self._fault, f"{reason}; {ended}"
        same = before is not None and before.code == code
        since_s = before.since_s if before is not None and same else self._clock.now_s()
        self._fault = StandingFault(NAME, code, message, since_s, until)
        file, self._file, self._run = self._file, None, None
        self._retry_s = 0.0 if until == NEXT_RUN else time.monotonic() + RETRY_S
        if not same:
            log.error("%s", message)
        return file

    def _write(self, news: Sequence[Published | Entry], since_s: float) -> None:
        """Write what was published since a moment into the file, if there is one to be written."""
        refused: OSError | None = None
        for one in news:
            try:
                entry = one if isinstance(one, Entry) else self._entry_of(one)
                if entry.topic == "mast":
                    self._use_mast()
                self._notice_fault(entry)
                file = None if refused else self._file or self._open()
                if file is not None:
                    file.published_s = since_s
                    if entry.topic == "frame" and not isinstance(entry.value, StampedFrame):
                        entry = replace(entry, value=self._frame_by_id(entry.value.frame_id))
                    self._entries.write(file, entry)
                    continue
                self._entries.remember(entry)
                if refused:
                    self._dropped[one.topic] += 1
            except OSError as error:
                refused = error
                self._entries.remember(entry)
                self._dropped[one.topic] += 1
            except MastctlError:  # the frame is gone
                self._dropped[one.topic] += 1
            except Exception:  # a value of an unexpected kind must not end the recording
                self._dropped[one.topic] += 1
                log.exception("the message %s %s cannot be recorded", one.topic, one.key)
        if refused:
            raise refused
        if (dropped := self._dropped_so_far()) and self._file is not None:
            self._entries.write_dropped(self._file, dropped, self._clock.now_s())

    def _entry_of(self, one: Published) -> Entry:
        """What is recorded of a published value."""
        value = one.value if one.topic == "frame" else self._event_value(one.topic, one.value)
        return Entry(one.topic, one.key, value, self._clock.now_s())

    def _use_mast(self) -> None:
        """Attach the mast file in use and write its cameras, if it is another one."""
        mast, file = self._mast(), self._file
        if self._entries.use_mast(mast) and file is not None:
            time_s, file.published_s = self._clock.now_s(), time.monotonic()
            file.attach(mast.file, time_s)
            self._entries.write_cameras(file, time_s)

    def _notice_fault(self, one: Entry) -> None:
        """Have the ring kept soon after a fault that is new, or was not seen for a while."""
        if one.topic != "fault" or one.key == NAME:  # a full disk is not made to keep more
            return
        now_s, never_s = time.monotonic(), -SAME_FAULT_S
        faults = [(one.key, fault["code"]) for fault in one.value]
        new = [one for one in faults if now_s - self._fault_seen_s.get(one, never_s) >= SAME_FAULT_S]
        if new and self._ring_s and self._keep is None:
            self._keep = now_s + AFTER_FAULT_S, "-".join(min(new))
        self._fault_seen_s |= dict.fromkeys(faults, now_s)

    def _look_after(self) -> None:
        """Flush, go on to the next file, keep the ring after a fault, stay within the bounds."""
        now_s = time.monotonic()
        if self._keep is not None and (now_s >= self._keep[0] or self._closing):
            reason, self._keep = self._keep[1], None
            if self._run is None:
                self._end_file()  # the newest segment is kept too
            if name := self._folder.keep_ring(reason, self._settings.kept_mb):
                log.warning("the recording around a fault is kept: %s", name)
        file = self._file
        if file is None:
            return
        file.flush_if_due(now_s)
        if file.size == self._judged_bytes or self._disk_is_low():
            return
        self._judged_bytes = file.size
        if self._run is not None:
            if file.size > self._settings.run_mb * MB:
                self._stop_writing("run_full", f"the file has {self._settings.run_mb:g} MB")
                file.finish()
        elif (
            now_s - self._begun_s > self._ring_s / SEGMENTS
            or file.size > self._settings.ring_mb * MB / SEGMENTS
        ):
            self._end_file(wait=False)
            self._folder.trim_ring(self._ring_s, self._settings.ring_mb)

    def _disk_is_low(self, factor: float = 1.0) -> bool:
        """End the recording before the disk is full, the ring's oldest first; return whether it was ended."""
        while (free := self._folder.free_bytes()) < factor * self._settings.free_mb * MB:
            if self._folder.drop_oldest_segment():
                continue
            reason = (
                f"the disk of {self._folder.path} has {free / MB:.0f} MB free where "
                f"{self._settings.free_mb:g} MB are left to others"
            )
            if file := self._stop_writing("disk_low", reason, "the disk has more space"):
                file.finish()
            return True
        return False

    def _open(self, run: str | None = None) -> RecordFile | None:
        """Open a run, or the ring's next segment if there is to be one now, and write what was known last;
        None if the disk is low.
        """
        if run is None and (not self._ring_s or time.monotonic() < self._retry_s):
            return None
        self._folder.prepare()
        before = self._fault
        if self._disk_is_low(RESUME_FREE if before is not None and before.code == "disk_low" else 1.0):
            return None
        path = self._folder.next_segment() if run is None else self._folder.next_run(run)
        facts = self._facts | ({} if run is None else {"run": path.stem})
        attached, now_s = [self._entries.mast.file, *self._others], self._clock.now_s()
        file = self._file = RecordFile(path, attached, facts, now_s, time.time_ns())
        self._begun_s, self._run = time.monotonic(), None if run is None else path.stem
        if run is not None or (before is not None and before.until != NEXT_RUN):
            self._fault = None
        file.published_s = time.monotonic()
        self._entries.begin(file, self._clock.now_s())
        return file

    def _end_file(self, *, wait: bool = True) -> None:
        """End the file that is written, if there is one; no run is recorded then."""
        file, self._file, self._run = self._file, None, None
        if file is not None:
            file.finish(wait=wait)

    def _start_run(self, name: str) -> RecorderState:
        if self._run is not None:
            raise NotNow("recording", f"the run {self._run} is recorded already; end it first")
        self._end_file()
        if not self._open(name):
            raise Unable("disk_low", "the disk is full" if self._fault is None else self._fault.message)
        log.info("run %s is recorded", self._run)
        return self.summary()

    def _delete(self, name: str) -> RecordingDeleted:
        one = self._found(name)
        if one.kind == "ring":
            message = "the ring is overwritten by itself; record.ring_s in the configuration says when"
            raise NotNow("recording", message)
        if name == self._run:
            raise NotNow("recording", f"the run {name} is recorded; end it first")
        try:
            self._folder.delete(one)
        except OSError as error:
            raise Unable("unwritable", f"{name} cannot be deleted: {error.strerror or error}") from None
        log.info("the recording %s was deleted", name)
        return {"recordings": [one.as_json() for one in self._all()]}

    def _stop_run(self) -> RecordingEnded:
        file, run = self._file, self._run
        if file is None or run is None:
            raise NotNow("not_recording", "no run is recorded; 'record start' begins one")
        self._end_file()
        log.info("run %s has ended", run)
        try:
            size_mb = file.path.stat().st_size / MB
        except FileNotFoundError:
            raise Unable("run_gone", f"{file.path} was deleted or moved while it was recorded") from None
        return {"run": run, "file": str(file.path), "size_mb": size_mb, "dropped": self._dropped_so_far()}

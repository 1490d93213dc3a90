"""The thread of one camera: always dequeues, checks, keeps the newest good frame, reopens what went away.

The newest frame stays in the kernel's buffer until the next one is there, and is copied only if somebody asks
for it; nobody's slowness holds more than that one buffer up.
"""

from __future__ import annotations

import logging
import math
import os
import select
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from drivers.clock import Clock
from drivers.errors import DriverError
from drivers.v4l2 import abi, pixels
from drivers.v4l2.errors import StreamFailed
from drivers.v4l2.frames import Arrived, Counters, RawFrame
from drivers.v4l2.node import Dequeued
from drivers.v4l2.options import CameraOptions
from drivers.v4l2.stamps import StampCheck
from drivers.v4l2.stream import Stream
from drivers.v4l2.uevents import UeventSocket

log = logging.getLogger(__name__)

SILENT_PERIODS = 3
STALLED_S = 5.0  # a camera that is there but gives nothing for so long is opened again
LATE_S = 0.005  # a frame is late if it comes more than a period and this after its stamp
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.05, 1.0


@dataclass(eq=False)
class _Shared:
    """What the thread and its callers share, under one lock."""

    changed: threading.Condition = field(default_factory=threading.Condition)
    newest: Arrived | None = None
    copied: RawFrame | None = None  # the newest in memory of its own, once somebody asked
    good: int = 0
    damaged: int = 0
    dropped: int = 0
    late: int = 0
    reopened: int = 0
    last_damage: str = ""
    lost: str = ""
    closed: bool = False


class Capture:
    """Streams from one camera until it is closed; safe from any thread.

    Parameters
    ----------
    options, name, clock
        How the camera is opened, its name, and the clock that its stamps are judged by.
    between
        Called in the capture thread after each good frame, with the stream: the automatic exposure. What
        it takes delays the next frame. The frame's bytes are the kernel's: good until it returns.

    Raises
    ------
    DriverError
        If the camera cannot be opened now. Once it was, it is opened again whenever it comes back.
    """

    def __init__(
        self,
        options: CameraOptions,
        name: str,
        clock: Clock,
        between: Callable[[Stream, RawFrame], None] | None = None,
        exposure_s: Callable[[], float] | None = None,
    ) -> None:
        self._options = options
        self._name = name
        self._clock = clock
        self._between = between
        self._exposure_s = exposure_s
        self._shared = _Shared()
        self._pause_s = FIRST_PAUSE_S
        self._streams = 0
        self._offset: int | None = 0  # from the driver's count to ours; None until a new stream's first frame
        self._last_sequence = -1
        self._held: int | None = None  # the buffer of the newest good frame
        self._check = StampCheck()
        stream = self._open()
        self.format = stream.format
        self.period_s = stream.period_s
        self.problems = tuple(stream.problems)
        self.identity = stream.node.identity
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._uevents = UeventSocket()
        self._thread = threading.Thread(target=self._run, args=(stream,), name=f"capture {name}", daemon=True)
        self._thread.start()

    @property
    def counters(self) -> Counters:
        """What happened to the frames so far."""
        with (shared := self._shared).changed:
            return Counters(
                shared.good, shared.damaged, shared.dropped, shared.late, shared.reopened, shared.last_damage
            )

    @property
    def lost(self) -> str:
        """Why there are no frames now: the camera is gone or its stream failed; empty while it streams."""
        with self._shared.changed:
            return self._shared.lost

    @property
    def newest(self) -> RawFrame | None:
        """The newest good frame, however old; None if there is none."""
        return self.wait(-math.inf, 0.0)

    def wait(self, exposed_after_s: float, timeout_s: float) -> RawFrame | None:
        """Return the newest frame once it began after that; None after ``timeout_s``, when lost or closed."""
        shared = self._shared

        def there() -> bool:
            return shared.newest is not None and shared.newest.window().begin_s > exposed_after_s

        with shared.changed:
            if not there():
                shared.changed.wait_for(
                    lambda: there() or shared.closed or bool(shared.lost), max(0.0, timeout_s)
                )
            if shared.newest is None or not there():
                return None
            if shared.copied is None:  # copied under the lock: its buffer does not go back meanwhile
                shared.copied = shared.newest.frame(copy=True)
            return shared.copied

    def refuse(self, frame: RawFrame, why: str) -> None:
        """Take a frame back that turned out damaged when it was decoded."""
        with (shared := self._shared).changed:
            if frame is shared.copied:
                shared.newest = shared.copied = None
                shared.good -= 1
                shared.damaged += 1
                shared.last_damage = why

    def close(self) -> None:
        """End the thread and let go of the camera."""
        with self._shared.changed:
            if self._shared.closed:
                return
            self._shared.closed = True
            self._shared.changed.notify_all()
        os.eventfd_write(self._wake, 1)
        self._thread.join()
        self._uevents.close()
        os.close(self._wake)

    # In the capture thread

    def _run(self, stream: Stream | None) -> None:
        """Stream, and open again after every failure, until closed."""
        while True:
            if stream is not None:
                try:
                    self._stream(stream)
                    return
                except DriverError as error:
                    self._lose(str(error))
                except Exception as error:  # a defect here must not end in a thread that is silently gone
                    log.exception("%s: the capture failed", self._name)
                    self._lose(f"{self._name}: the capture failed: {type(error).__name__}: {error}")
                finally:
                    self._let_go()
                    stream.close()
            if self._closing_after(self._pause_s):
                return
            self._pause_s = min(2 * self._pause_s, LONGEST_PAUSE_S)
            stream = self._reopened()

    def _stream(self, stream: Stream) -> None:
        """Take frames until closed. Raises DriverError when the camera fails."""
        poll = select.poll()
        poll.register(stream.node.fileno(), select.POLLIN)
        poll.register(self._wake, select.POLLIN)
        timeout_ms = max(1.0, 1e3 * SILENT_PERIODS * stream.period_s)
        silent_since_s: float | None = None
        while True:
            events = dict(poll.poll(timeout_ms))
            if self._wake in events:
                return
            # One frame a round: asking for another that is not there costs as much as the poll that tells it.
            if events and (buffer := stream.node.dequeue()) is not None:
                self._take(stream, buffer)
                silent_since_s = None
            elif events.get(stream.node.fileno(), 0) & ~select.POLLIN:
                raise StreamFailed("its driver reports an error and gives no frame", device=self._name)
            else:
                stream.node.check_there()
                now_s = time.monotonic()
                silent_since_s = now_s if silent_since_s is None else silent_since_s
                if now_s - silent_since_s > max(STALLED_S, 2 * SILENT_PERIODS * stream.period_s):
                    raise StreamFailed(f"gave no frame for {now_s - silent_since_s:.1f} s", device=self._name)

    def _take(self, stream: Stream, buffer: Dequeued) -> None:
        """Check one buffer; publish it if it is good, and give the last one back, else itself."""
        received_s = self._clock.now_s()
        dropped = self._check.dropped_before(buffer.sequence)
        wrong = self._check.wrong_stamp(buffer.flags, buffer.stamp_s, received_s)
        if buffer.flags & abi.BUF_FLAG_ERROR:
            wrong = "its driver marks it as damaged"
        data = stream.node.bytes_of(buffer)
        wrong = wrong or pixels.wrong_length(stream.format, data)
        if self._offset is None:
            self._offset = self._last_sequence + 1 - buffer.sequence
        sequence = self._offset + buffer.sequence
        if sequence <= self._last_sequence:  # the driver's count wrapped or began again
            self._offset += self._last_sequence + 1 - sequence
            sequence = self._last_sequence + 1
        self._last_sequence = sequence
        arrived = None
        if not wrong:
            arrived = Arrived(data, buffer, stream.format, stream.rule, sequence, self._streams, received_s)
        self._publish(stream, arrived, dropped, wrong)
        if arrived is None:
            stream.node.queue(buffer.number)
            return
        if self._held is not None:
            stream.node.queue(self._held)
        self._held = buffer.number
        self._pause_s = FIRST_PAUSE_S
        if self._between is not None:
            self._between(stream, arrived.frame(copy=False))

    def _publish(self, stream: Stream, arrived: Arrived | None, dropped: int, wrong: str) -> None:
        with (shared := self._shared).changed:
            shared.dropped += dropped
            if arrived is None:
                shared.damaged += 1
                shared.last_damage = wrong
                return
            shared.good += 1
            shared.late += arrived.received_s - arrived.buffer.stamp_s > stream.period_s + LATE_S
            shared.newest, shared.copied = arrived, None
            shared.changed.notify_all()

    def _lose(self, why: str) -> None:
        """Say that there are no frames for now."""
        with self._shared.changed:
            if not self._shared.lost:
                log.warning("%s; it is opened again when it is back", why)
            self._shared.lost = why
            self._shared.newest = self._shared.copied = None
            self._shared.changed.notify_all()

    def _let_go(self) -> None:
        """Forget the frame that lies in the memory of a stream that ends."""
        with self._shared.changed:
            self._shared.newest = self._shared.copied = None
        self._held = None

    def _closing_after(self, pause_s: float) -> bool:
        """Wait before the next try, shorter if the kernel says that a node came; True when closed."""
        poll = select.poll()
        poll.register(self._wake, select.POLLIN)
        if self._uevents.available:
            poll.register(self._uevents, select.POLLIN)
        until_s = time.monotonic() + pause_s
        while (left_s := until_s - time.monotonic()) > 0:
            events = dict(poll.poll(1e3 * left_s))
            if self._wake in events:
                return True
            if any(event.action == "add" for event in self._uevents.read()):
                self._pause_s = FIRST_PAUSE_S
                until_s = min(until_s, time.monotonic() + FIRST_PAUSE_S / 5)  # for udev to make its links
        return False

    def _reopened(self) -> Stream | None:
        """Try to open the camera again; None if it is not back."""
        try:
            stream = self._open()
        except Exception as error:
            if not isinstance(error, DriverError):  # a defect: the thread goes on trying, and says so
                log.exception("%s: opening again failed", self._name)
            with self._shared.changed:
                self._shared.lost = str(error) or type(error).__name__
            return None
        with self._shared.changed:
            self._shared.lost = ""
            self._shared.reopened += 1
            self._shared.changed.notify_all()
        log.warning("%s is back at %s", self._name, stream.node.path)
        return stream

    def _open(self) -> Stream:
        exposure_s = None if self._exposure_s is None else self._exposure_s()
        stream = Stream(self._options, self._name, exposure_s)
        self._check = StampCheck()
        self._streams += 1
        if self._streams > 1:
            self._offset = None
        return stream

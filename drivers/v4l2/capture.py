"""The thread of one camera: always dequeues, checks, keeps the newest good frame, reopens what went away.

The newest frame stays in the kernel's buffer until the next one is there (`drivers.newest`); a slow caller
holds up no more than that one buffer. One that nobody asks for costs little more than its system calls.
"""

from __future__ import annotations

import logging
import os
import select
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial

import numpy as np
from numpy.typing import NDArray

from drivers import pixels
from drivers.clock import Clock
from drivers.errors import DriverError, NoCamera, StreamFailed
from drivers.interfaces import CameraSetting, Image
from drivers.newest import Newest
from drivers.pixels import PictureFormat
from drivers.v4l2 import abi, find
from drivers.v4l2.node import Dequeued, Node
from drivers.v4l2.options import CameraOptions
from drivers.v4l2.settings import EXPOSURE, change, settings_of, with_settings
from drivers.v4l2.stamps import Arrived, Spacing, StampCheck, Timing, exposure_window
from drivers.v4l2.stream import Stream
from drivers.values_set import ValuesSet

log = logging.getLogger(__name__)

Bytes = NDArray[np.uint8]

SILENT_PERIODS = 3
STALLED_S = 5.0  # a camera that is there but gives nothing for so long is opened again
LATE_S = 0.005  # a frame is late if it comes more than a period and this after its stamp
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.05, 1.0  # between tries to open a camera that is there and fails
GONE_PAUSE_S = 0.1  # between looks for one that is not: they disturb nobody
CLOSE_PATIENCE_S = 2.0  # for the thread to end: a device that died may hold it in the kernel


class Capture:
    """Streams from one camera until it is closed; safe from any thread.

    Parameters
    ----------
    options, name, clock
        How the camera is opened, its name, and the clock that its stamps are judged by.
    convert
        Makes a picture in memory of its own from a format and bytes in the kernel's memory; BadFrame from it
        means a damaged frame.
    between
        Called in the capture thread after each good frame with the stream, the frame and its bytes, which are
        the kernel's: the automatic exposure. What it takes delays the next frame.
    exposure_s
        Tells the exposure time to open with; without it that is the options'.

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
        convert: Callable[[PictureFormat, Bytes], Image],
        between: Callable[[Stream, Arrived, Bytes], None] | None = None,
        exposure_s: Callable[[], float] | None = None,
    ) -> None:
        self._options = options
        self._convert = convert
        self._name = name
        self._clock = clock
        self._between = between
        self._exposure_s = exposure_s
        self.newest: Newest[Arrived] = Newest()
        self._ended = self._left_behind = False  # whether the thread is through, and nobody waits for it
        self._ending = threading.Lock()
        self._opening = threading.Lock()
        self._in_force: Mapping[str, ValuesSet] = {}  # of the stream that was opened last
        self._pause_s = FIRST_PAUSE_S
        self._streams = 0
        self._offset: int | None = 0  # from the driver's count to ours; None until a new stream's first frame
        self._last_sequence = -1
        self._kept_buffer: int | None = None  # the buffer of the newest good frame
        self._lengths: tuple[int, ...] = ()
        self._check, self._spacing = StampCheck(), Spacing(None, 0.0)  # of the stream that is open
        with ExitStack() as opened:  # what is open when a later step fails is closed again
            stream = self._open()
            opened.callback(stream.close)
            self.format, self.sensor_mode = stream.format, stream.sensor_mode
            self.period_s = stream.period_s
            self._rate_told = stream.rate_told
            self.problems = tuple(stream.problems)
            self.identity = stream.node.identity
            self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
            opened.callback(os.close, self._wake)
            self._thread = threading.Thread(
                target=self._run, args=(stream,), name=f"capture {name}", daemon=True
            )
            self._thread.start()
            opened.pop_all()

    @property
    def lost(self) -> str:
        """Why there are no frames now: the camera is gone or its stream failed; empty while it streams."""
        return self.newest.lost

    def take(self, exposed_after_s: float, timeout_s: float) -> tuple[Arrived, Image, bytes] | None:
        """Return the newest frame, once its exposure began after that moment, as `Newest.take`.

        A frame that was there before is given only while its stamp is at most a period and 5 ms old: when the
        computer stood still for longer, a newer one is on its way.
        """
        return self.newest.take(exposed_after_s, timeout_s, self._is_young)

    def _is_young(self, frame: Arrived) -> bool:
        return self._clock.now_s() - frame.buffer.stamp_s <= self.period_s + LATE_S

    def _made(self, node: Node, frame: Arrived) -> tuple[Image, bytes]:
        """A frame's picture, with the JPEG that it was made of."""
        data = np.frombuffer(node.bytes_of(frame.buffer), np.uint8)
        return self._convert(frame.format, data), pixels.jpeg_of(frame.format, data)

    def adjust(self, wanted: Mapping[str, float]) -> Sequence[str]:
        """Change settings; a stream that is opened later has them too. Raises BadSetting, DriverError."""
        with self._opening, find.open_node(self._options.address, self._name) as node:
            became, notes, refused = change(node, wanted, self._in_force, self._clock, self._name)
            self._options = with_settings(self._options, became)
        if refused is not None:
            raise refused
        return notes

    def settings(self) -> list[CameraSetting]:
        """Return what may be changed, as the camera has it now. Raises DriverError."""
        with find.open_node(self._options.address, self._name) as node:
            return settings_of(node, self._options, self.period_s if self._rate_told else None)

    def await_settled(self, timeout_s: float) -> None:
        """Wait until a frame came that shows no setting of before, or none will, for so long at most."""
        self.newest.wait_until(lambda: all(values.settled for values in self._in_force.values()), timeout_s)

    def close(self) -> None:
        """End the thread and let go of the camera.

        A driver that hangs in the kernel is left behind after 2 s; its thread lets go when it comes back.
        """
        if not self.newest.close():
            return
        os.eventfd_write(self._wake, 1)
        self._thread.join(CLOSE_PATIENCE_S)
        with self._ending:
            self._left_behind = self._thread.is_alive() and not self._ended
            left_behind = self._left_behind
        if left_behind:
            log.warning("%s: its driver hangs; it is closed when the driver comes back", self._name)
        else:
            os.close(self._wake)

    # In the capture thread

    def _run(self, stream: Stream | None) -> None:
        """Stream until closed; then, if `close` did not wait for it, give everything back."""
        try:
            self._serve(stream)
        finally:
            with self._ending:
                self._ended = True
                left_behind = self._left_behind
            if left_behind:
                os.close(self._wake)

    def _serve(self, stream: Stream | None) -> None:
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
                    self.newest.forget()
                    self._kept_buffer = None
                    stream.close()
            if self._closing_after(self._pause_s):
                return
            self._pause_s = min(2 * self._pause_s, LONGEST_PAUSE_S)
            stream = self._reopened()

    def _stream(self, stream: Stream) -> None:
        """Take frames until closed. Raises DriverError when the camera fails."""
        node = stream.node
        poll = select.poll()
        poll.register(node.fileno(), select.POLLIN)
        poll.register(self._wake, select.POLLIN)
        silent_since_s: float | None = None
        while True:
            found = dict(poll.poll(max(1.0, 1e3 * SILENT_PERIODS * stream.period_s)))
            if self._wake in found:
                return
            events = found.get(node.fileno(), 0)
            # One frame a round: asking for another that is not there costs as much as the poll that tells it.
            if events and (buffer := node.dequeue()) is not None:
                self._take(stream, buffer)
                silent_since_s = None
            elif events & ~select.POLLIN:
                raise StreamFailed("its driver reports an error and gives no frame", device=self._name)
            else:
                node.check_there()
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
        elif not wrong and buffer.used_bytes not in self._lengths:
            wrong = pixels.wrong_length(stream.format, stream.node.bytes_of(buffer))
        if self._offset is None:
            self._offset = self._last_sequence + 1 - buffer.sequence
        sequence = self._offset + buffer.sequence
        if sequence <= self._last_sequence:  # the driver's count wrapped or began again
            self._offset += self._last_sequence + 1 - sequence
            sequence = self._last_sequence + 1
        self._last_sequence = sequence
        window = None
        if not wrong:
            reported = {name: values.of(sequence, buffer.stamp_s) for name, values in stream.in_force.items()}
            timing = Timing(*reported[EXPOSURE.name], *self._spacing.see(sequence, buffer.stamp_s))
            window = exposure_window(stream.rule, timing, buffer.flags, buffer.stamp_s, received_s)
        if window is None:
            self.newest.refuse(dropped, wrong)
            stream.node.queue(buffer.number)
            return
        settings = {name: value for name, (value, _) in reported.items()}
        arrived = Arrived(
            buffer, stream.format, timing, window, sequence, self._streams, received_s, settings
        )
        late = received_s - buffer.stamp_s > stream.period_s + LATE_S
        self.newest.publish(arrived, partial(self._made, stream.node, arrived), dropped=dropped, late=late)
        previous, self._kept_buffer = self._kept_buffer, buffer.number
        if previous is not None:
            stream.node.queue(previous)
        self._pause_s = FIRST_PAUSE_S
        if self._between is not None:
            self._between(stream, arrived, np.frombuffer(stream.node.bytes_of(buffer), np.uint8))

    def _lose(self, why: str) -> None:
        """Say that there are no frames for now."""
        if self.newest.lose(why):
            log.warning("%s; it is opened again when it is back", why)

    def _closing_after(self, pause_s: float) -> bool:
        """Wait before the next try; True when closed."""
        poll = select.poll()
        poll.register(self._wake, select.POLLIN)
        return bool(poll.poll(1e3 * pause_s))

    def _reopened(self) -> Stream | None:
        """Try to open the camera again; None if it is not back."""
        try:
            stream = self._open()
        except Exception as error:
            if isinstance(error, NoCamera):
                self._pause_s = GONE_PAUSE_S
            elif not isinstance(error, DriverError):  # a defect: the thread goes on trying, and says so
                log.exception("%s: opening again failed", self._name)
            self.newest.lose(str(error) or type(error).__name__)
            return None
        self.newest.come_back()
        log.warning("%s is back at %s", self._name, stream.node.path)
        return stream

    def _open(self) -> Stream:
        with self._opening:
            exposure_s = None if self._exposure_s is None else self._exposure_s()
            stream = Stream(self._options, self._name, self._clock, exposure_s)
            if self._streams and stream.sensor_mode != self.sensor_mode:
                stream.close()
                words = f"it came back with {stream.sensor_mode} where it had {self.sensor_mode}"
                raise StreamFailed(words, device=self._name)
            self._in_force = stream.in_force
        self._check = StampCheck()
        self._spacing = Spacing(stream.period_s if stream.rate_told else None, stream.rule.margin_s)
        self._lengths = pixels.whole_lengths(stream.format)
        self._streams += 1
        if self._streams > 1:
            self._offset = None
        return stream

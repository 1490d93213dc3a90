"""The driver ``v4l2``: a camera whose frames are never older than requested (`drivers.interfaces.Camera`).

Its thread always dequeues, and checks. The newest good frame stays in the kernel's buffer until the next one
is there (`drivers.newest`); a slow caller holds up no more than that one buffer. One without a request costs
little more than its system calls.
"""

from __future__ import annotations

import select
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers import pixels
from drivers.clock import Clock, SystemClock
from drivers.errors import StreamFailed, UnsupportedFormat
from drivers.interfaces import CameraInfo, CameraSetting, Image
from drivers.newest import FIRST_PAUSE_S, LATE_S, CapturedCamera, TimedFrame
from drivers.registry import CameraBench, Driver
from drivers.v4l2 import abi, find
from drivers.v4l2.controls import get_value, list_controls
from drivers.v4l2.exposure import GROUPS, ExposureControl
from drivers.v4l2.node import Dequeued, Node
from drivers.v4l2.settings import EXPOSURE, CameraOptions, change, parse_options, settings_of, with_settings
from drivers.v4l2.stamps import Arrived, Spacing, StampCheck, Timing, exposure_window
from drivers.v4l2.stream import Stream, sizes_text

JUDGE_EVERY_S = 0.25  # how often the automatic exposure looks at a frame
HOLD_PERIODS = 8  # so long a hold waits for a change under way to show: it takes three frames once it is made
HOLD_MOST_S = 1.0
Bytes = NDArray[np.uint8]

SILENT_PERIODS = 3
STALLED_S = 5.0  # a camera that is there but gives nothing for so long is opened again
WAIT_S = 0.1  # for a frame: so long after the last one a loss or the end is seen


def open_camera(options: Mapping[str, Any], clock: Clock | None = None, name: str = "v4l2") -> V4l2Camera:
    """Open a camera by a configuration's options (docs/how-to/cameras.md).

    Raises BadOptions for options that it refuses; UnsupportedFormat and NotACamera are of this kind;
    DriverError if the camera is not connected, busy, or not to be opened by this user.
    """
    return V4l2Camera(parse_options(options, name), name, clock or SystemClock())


class V4l2Camera(CapturedCamera[Arrived]):
    """One camera, as `CapturedCamera`."""

    gone_pause_s = 0.1

    def __init__(self, options: CameraOptions, name: str, clock: Clock) -> None:
        super().__init__(name)
        self._options = options
        self._convert = pixels.colour if options.colour else pixels.grey
        self._clock = clock
        self._streams = 0
        self._offset: int | None = 0  # from the driver's count to ours; None until a new stream's first frame
        self._last_sequence = -1
        self._kept_buffer: int | None = None  # the buffer of the newest good frame
        self._lengths: tuple[int, ...] = ()
        self._check, self._spacing = StampCheck(), Spacing(None, 0.0)  # of the stream that is open
        self._exposure: ExposureControl | None = None
        self._judge_after_s = 0.0
        self._exposed = threading.Condition()  # guards what follows
        self._holds = 0
        self._requested_s: float | None = None  # the exposure time that was set last, as it was requested
        self._shows = False  # whether the last frame had it
        self._changing = False
        if options.auto_exposure is not None and options.exposure_s is not None:
            self._exposure = GROUPS.join(name, options.auto_exposure, options.exposure_s)
        try:
            stream = self._open()
            self.format, self.sensor_mode = stream.format, stream.sensor_mode
            self.period_s = stream.period_s
            self._rate_known = stream.rate_known
            self.problems = tuple(stream.problems)
            self.identity = stream.node.identity
            self._begin(stream)
        except BaseException:
            self._leave_group()
            raise

    @property
    def info(self) -> CameraInfo:
        """Size, sensor mode and period as its driver reports them, and the configured trigger."""
        return CameraInfo(
            size_px=self.format.size_px,
            sensor_mode=self.sensor_mode,
            period_s=self.period_s,
            trigger=self._options.trigger,
        )

    def _timed(self, arrived: Arrived, image: Image, jpeg: bytes) -> TimedFrame:
        buffer, window, exposure_s = arrived.buffer, arrived.window, arrived.timing.exposure_s
        return TimedFrame(
            image=image,
            jpeg=jpeg,
            settings=arrived.settings,
            sequence=arrived.sequence,
            mid_exposure_s=window.mid_s,
            exposure_s=window.length_s,
            mid_uncertainty_s=window.mid_uncertainty_s(exposure_s),
            set_exposure_s=exposure_s,
            stamp_s=buffer.stamp_s,
            received_s=arrived.received_s,
            driver_sequence=buffer.sequence,
            stream=arrived.stream,
        )

    def now_s(self) -> float:
        """Return the time by the clock that its stamps are judged by."""
        return self._clock.now_s()

    def abilities(self) -> dict[str, Any]:
        """Return what the camera offers, as JSON: ``formats`` and ``controls`` with their values now."""
        with find.open_node(self._options.address, self.name) as node:
            controls = list_controls(node)
            return {
                "formats": [
                    {"code": code, "readable": code in pixels.FORMATS, "sizes": sizes_text(node, code)}
                    for code in dict.fromkeys(node.formats())
                ],
                "controls": [
                    {
                        "name": c.name, "kind": c.kind, "value": get_value(node, c), "minimum": c.minimum,
                        "maximum": c.maximum, "step": c.step, "default": c.default, "menu": dict(c.menu),
                    }
                    for c in controls
                ],
            }  # fmt: skip

    @contextmanager
    def exposure_held(self) -> Iterator[None]:
        """Keep the exposure as it is inside the block: for a measurement that compares pictures.

        A change that this camera's group decided on before is first made, and waited for until it shows, for
        eight periods (1 s) at most. What was not made by then is made after the block. A change of settings
        that was made before is waited for likewise. Raises StreamFailed if the camera is still at such a
        change after that time: it is unknown when it takes effect.
        """
        control = self._exposure
        if control is None:
            self._await_settings()
            yield
            return
        control.hold()
        try:
            self._await_settings()
            self._await_change(control)
            try:
                yield
            finally:
                with self._exposed:
                    self._holds -= 1
        finally:
            control.release()

    def _await_settings(self) -> None:
        """Wait until what was set before a hold shows."""
        self.await_settled(min(HOLD_MOST_S, HOLD_PERIODS * self.period_s))

    def _await_change(self, control: ExposureControl) -> None:
        """Count a hold in, once the exposure is the group's and shows, or no frame comes to say so."""

        def rests() -> bool:
            return bool(self.lost) or (self._shows and self._requested_s == control.exposure_s)

        with self._exposed:
            if not self._holds:
                self._exposed.wait_for(rests, min(HOLD_MOST_S, HOLD_PERIODS * self.period_s))
            if self._changing:
                raise StreamFailed(
                    "it is still at a change of its exposure time and cannot hold it", device=self.name
                )
            self._holds += 1

    def close(self) -> None:
        """Let go of the camera; a waiting call ends with NoFreshFrame."""
        super().close()
        self._leave_group()

    def _to_open_with_s(self) -> float | None:
        """The group's exposure time to open with; while it is held, that of before; None without a group."""
        control = self._exposure
        if control is None:
            return None
        with self._exposed:
            held_s = self._requested_s if self._holds else None
        return control.exposure_s if held_s is None else held_s

    def _leave_group(self) -> None:
        if self._exposure is not None and self._options.auto_exposure is not None:
            self._exposure = None
            GROUPS.leave(self.name, self._options.auto_exposure)

    def _judge(self, stream: Stream, frame: Arrived, data: Bytes) -> None:
        """In the capture thread: look at a frame now and then, and set the exposure that its group wants."""
        control = self._exposure
        if control is None:
            return
        with self._exposed:
            self._requested_s = stream.requested_exposure_s
            self._shows = frame.timing.exposure_s == stream.exposure_s
            shows = self._shows
            self._exposed.notify_all()
        if stream.exposure_s is None:
            return
        wanted_s = control.exposure_s
        if wanted_s == stream.requested_exposure_s and shows and frame.received_s >= self._judge_after_s:
            self._judge_after_s = frame.received_s + JUDGE_EVERY_S
            if not control.is_fixed:
                wanted_s = control.see(self.name, pixels.grey(frame.format, data), wanted_s)
        if wanted_s != stream.requested_exposure_s:  # also when another camera of the group wanted it
            self._change(stream, wanted_s)

    def _change(self, stream: Stream, exposure_s: float) -> None:
        """Set the exposure, unless it is held; not under the lock, since a camera may take long over it."""
        with self._exposed:
            if self._holds:
                return
            self._changing, self._shows = True, False
        try:
            stream.set_exposure(exposure_s)
        finally:
            with self._exposed:
                self._changing, self._requested_s = False, stream.requested_exposure_s

    def _is_young(self, frame: Arrived) -> bool:
        return self._clock.now_s() - frame.buffer.stamp_s <= self.period_s + LATE_S

    def _made(self, node: Node, frame: Arrived) -> tuple[Image, bytes]:
        """A frame's picture, with the JPEG that it was made of."""
        data = np.frombuffer(node.bytes_of(frame.buffer), np.uint8)
        return self._convert(frame.format, data), pixels.jpeg_of(frame.format, data)

    def adjust(self, wanted: Mapping[str, float]) -> Sequence[str]:
        """Change settings; a stream that is opened later has them too. Raises BadSetting, DriverError."""
        with self._opening, find.open_node(self._options.address, self.name) as node:
            became, notes, refused = change(node, wanted, self._in_force, self._clock, self.name)
            self._options = with_settings(self._options, became)
        if refused is not None:
            raise refused
        return notes

    def settings(self) -> list[CameraSetting]:
        """Return what may be changed, as the camera has it now. Raises DriverError."""
        with find.open_node(self._options.address, self.name) as node:
            return settings_of(node, self._options, self.period_s if self._rate_known else None)

    # In the capture thread

    def _let_go(self, stream: Stream) -> None:
        self._kept_buffer = None
        stream.close()

    def _stream(self, stream: Stream) -> None:
        """Take frames until closed. Raises DriverError when the camera fails."""
        node = stream.node
        poll = select.poll()
        poll.register(node.fileno(), select.POLLIN)
        heard_s = time.monotonic()
        while not self._over.is_set():
            events = sum(found for _, found in poll.poll(1e3 * WAIT_S))
            # One frame a round: requesting another that is not there costs as much as the poll that shows it.
            if events and (buffer := node.dequeue()) is not None:
                self._take(stream, buffer)
                heard_s = time.monotonic()
            elif events & ~select.POLLIN:
                raise StreamFailed("its driver reports an error and gives no frame", device=self.name)
            elif (silent_s := time.monotonic() - heard_s) > SILENT_PERIODS * stream.period_s:
                node.check_there()
                if silent_s > max(STALLED_S, 3 * SILENT_PERIODS * stream.period_s):
                    raise StreamFailed(f"gave no frame for {silent_s:.1f} s", device=self.name)

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
            self._refuse(dropped, wrong)
            stream.node.queue(buffer.number)
            return
        settings = {name: value for name, (value, _) in reported.items()}
        arrived = Arrived(
            buffer, stream.format, timing, window, sequence, self._streams, received_s, settings
        )
        late = received_s - buffer.stamp_s > stream.period_s + LATE_S
        self._publish(arrived, partial(self._made, stream.node, arrived), dropped=dropped, late=late)
        previous, self._kept_buffer = self._kept_buffer, buffer.number
        if previous is not None:
            stream.node.queue(previous)
        self._pause_s = FIRST_PAUSE_S
        if self._exposure is not None:
            self._judge(stream, arrived, np.frombuffer(stream.node.bytes_of(buffer), np.uint8))

    def _open(self) -> Stream:
        with self._opening:
            stream = Stream(self._options, self.name, self._clock, self._to_open_with_s())
            if self._streams and stream.sensor_mode != self.sensor_mode:
                stream.close()
                message = f"it came back with {stream.sensor_mode} where it had {self.sensor_mode}"
                raise StreamFailed(message, device=self.name)
            self._in_force = stream.in_force
        self._check = StampCheck()
        self._spacing = Spacing(stream.period_s if stream.rate_known else None, stream.rule.margin_s)
        self._lengths = pixels.whole_lengths(stream.format)
        self._streams += 1
        if self._streams > 1:
            self._offset = None
        return stream


def present(options: Mapping[str, Any], name: str) -> str:
    """Return which camera a configuration names, as `drivers.registry.CameraBench`. Raises DriverError."""
    wanted = parse_options(options, name)
    with find.open_node(wanted.address, name) as node:
        offered, place = node.formats(), f"{node.identity.card} at {node.identity.bus}"
    if wanted.format not in offered:
        message = (
            f"{place} offers {', '.join(offered)} where {wanted.format} is configured; configure one of these"
        )
        raise UnsupportedFormat(message, device=name)
    return f"{place}, {wanted.format}"


DRIVER = Driver(
    lambda options, context: open_camera(options, context.clock, context.name),
    probe=find.probe, bench=CameraBench("cameras", "cameras", find.table, present, find.options_for),
)  # fmt: skip

"""A rolling-shutter camera that knows when it truly exposed, in place of the kernel's node.

Its rows are exposed one after the other and read out in the same order; no row is exposed before its last
picture has been read, and no readout begins before the last one's end. Nothing here comes from the driver.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.clock import SystemClock
from drivers.errors import DriverError
from drivers.pixels import PictureFormat
from drivers.v4l2 import abi, find, settings, stream
from drivers.v4l2.controls import CameraControl, ControlProblem
from drivers.v4l2.node import Dequeued, Identity

SIZE_PX = (16, 8)


class TurnedClock(SystemClock):
    """A clock that tests set; threads and signals are the machine's."""

    def __init__(self) -> None:
        self.time_s = 100.0

    def now_s(self) -> float:
        return self.time_s

    def sleep(self, duration_s: float) -> None:
        self.time_s += duration_s


EXPOSURE = CameraControl(abi.CID_EXPOSURE_ABSOLUTE, "exposure", "integer", 1, 10000, 1, 100, True, {})
AUTO = CameraControl(
    abi.CID_EXPOSURE_AUTO, "auto_exposure", "menu", 0, 3, 1, 3, True, {1: "Manual", 3: "Auto"}
)


@dataclass(frozen=True)
class Shot:
    """One frame as it truly was: from the first row's begin to the last row's end, and how it is told."""

    sequence: int
    began_s: float
    ended_s: float
    stamp_s: float
    received_s: float


class Sensor:
    """Makes frames one after the other.

    ``kind`` is ``start`` (stamped when the first row's exposure begins), ``uvc`` (when the readout begins,
    though it says start) or ``end`` (when the readout ends). Stamps come up to ``late_s`` late.
    """

    def __init__(self, kind: str, readout_s: float, late_s: float, seed: int) -> None:
        self.kind = kind
        self.readout_s = readout_s
        self.late_s = late_s
        self.random = np.random.default_rng(seed)
        self.read_out_s = 100.0
        self.sequence = -1

    def shoot(self, apart_s: float, exposure_s: float) -> Shot:
        """The next frame, read out so much after the last one (which bounds the exposure)."""
        assert exposure_s <= apart_s + 1e-12 and apart_s >= self.readout_s
        self.sequence += 1
        self.read_out_s += apart_s
        began_s, end_s = self.read_out_s - exposure_s, self.read_out_s + self.readout_s
        told_s = {"start": began_s, "uvc": self.read_out_s, "end": end_s}[self.kind]
        stamp_s = told_s + self.late_s * self.random.random()
        return Shot(self.sequence, began_s, end_s, stamp_s, max(end_s, stamp_s) + 0.0005)


class SensorNode:
    """A node whose frames a test puts in, with an exposure control if ``controls`` has one."""

    path = Path("/dev/video7")
    refused: tuple[int, ...] = ()  # controls that take no value
    failure: DriverError | None = None

    def __init__(
        self, kind: str, rate_hz: float | None = 25.0, controls: tuple[CameraControl, ...] = ()
    ) -> None:
        self.identity = Identity("uvcvideo" if kind == "uvc" else "made_up", "Made up", "nowhere", 0)
        self.kind = kind
        self.rate_hz = rate_hz
        self.controls = controls
        self.selections: dict[int, tuple[int, int, int, int]] = {}  # by target; it tells none of others
        self.values = {AUTO.id: 3, EXPOSURE.id: 100}
        self.sets: list[tuple[int, int]] = []
        self.ready = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_SEMAPHORE)
        self.waiting: deque[Dequeued] = deque()
        self.lock = threading.Lock()
        self.through = 0  # frames that the reader is done with
        self.closed = False

    def fileno(self) -> int:
        return self.ready

    def put(self, shot: Shot, wrong: bool = False) -> None:
        flags = abi.BUF_FLAG_TIMESTAMP_MONOTONIC | (0 if self.kind == "end" else abi.BUF_FLAG_TSTAMP_SRC_SOE)
        flags |= abi.BUF_FLAG_ERROR if wrong else 0
        with self.lock:
            self.waiting.append(Dequeued(shot.sequence % 4, 128, flags, shot.sequence, shot.stamp_s))
        os.eventfd_write(self.ready, 2)  # once more: that it asks again says that it is through

    def fail(self, error: DriverError) -> None:
        """Have the next request for a frame fail."""
        self.failure = error
        os.eventfd_write(self.ready, 1)

    def dequeue(self) -> Dequeued | None:
        with self.lock:
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self.ready)
            if self.failure is not None:
                failure, self.failure = self.failure, None
                raise failure
            if self.waiting:
                return self.waiting.popleft()
            self.through += 1
            return None

    def bytes_of(self, buffer: Dequeued) -> memoryview:
        return memoryview(bytes([50 + buffer.sequence % 100]) * 128)

    def queue(self, index: int) -> None:
        pass

    def start(self, buffers: int) -> None:
        pass

    def check_there(self) -> None:
        pass

    def set_format(self, code: str, size_px: tuple[int, int]) -> PictureFormat:
        return PictureFormat("GREY", SIZE_PX, SIZE_PX[0], SIZE_PX[0] * SIZE_PX[1])

    def selection(self, target: int) -> tuple[int, int, int, int] | None:
        return self.selections.get(target)

    def set_rate(self, rate_hz: float) -> float | None:
        return self.rate_hz

    def current_rate(self) -> float | None:
        return self.rate_hz

    def close(self) -> None:
        self.closed = True

    def __enter__(self) -> SensorNode:
        return self

    def __exit__(self, *ignored: object) -> None:
        """A second opening is let go; the first streams on."""


def use(monkeypatch: object, node: SensorNode) -> None:
    """Have the driver open this node and speak with its controls."""

    def set_value(opened: SensorNode, control: CameraControl, value: int) -> ControlProblem | None:
        if control.id in opened.refused:
            return ControlProblem(control.name, f"{control.name} does not take {value}: Permission denied")
        opened.sets.append((control.id, value))
        opened.values[control.id] = value
        return None

    patch = monkeypatch.setattr  # type: ignore[attr-defined]
    patch(find, "open_node", lambda address, name: node)
    patch(stream, "set_by_name", lambda opened, wanted: [])
    for place in (stream, settings):
        patch(place, "list_controls", lambda opened: list(opened.controls))
        patch(place, "set_value", set_value)
        patch(place, "get_value", lambda opened, control: opened.values[control.id])

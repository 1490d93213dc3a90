"""A Dynamixel head on simulated servos behind a line in memory, and what only the tester knows about it.

The simulator's registers and packets are its own (``drivers/sim/wire``), not the driver's. Everything runs on
a clock that is turned: the test computes in its turn, and time passes only while it waits on that clock.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

from drivers.clock import Clock
from drivers.dynamixel.head import DynamixelHead, open_head
from drivers.errors import DriverError
from drivers.faults import FaultPanel
from drivers.interfaces import PanTilt, Reading
from drivers.sim.axis import AxisSettings, WireAxis
from drivers.sim.wire.carrier import WireDevice
from drivers.sim.wire.dynamixel_bus import DynamixelBus, Instruction, InstructionParser
from drivers.sim.wire.dynamixel_servo import SimulatedServo
from drivers.sim.wire.line import MemoryLine
from drivers.simulation_clock import SimulationClock
from hil_tests.drivers.turned import START_S, HangingHost, Turned

COUNT_RAD = 2 * 3.141592653589793 / 4096
SLOW_TO_BRAKE, QUICK_TO_BRAKE = (AxisSettings(COUNT_RAD, 0.0, -3.0, 3.0, 1.0, a) for a in (4.0, 20.0))
X = "xm430_w350"


class Ear:
    """Hears every instruction of the host, and when it was through (a line's ``observer``)."""

    def __init__(self) -> None:
        self.heard: list[tuple[float, Instruction]] = []
        self._parser = InstructionParser()

    def __call__(self, sender: Literal["host", "device"], data: bytes, time_s: float) -> None:
        if sender == "host":
            self.heard += [(time_s, one) for one in self._parser.feed(data)]


@dataclass
class Rig(Turned):
    """Servos, what turns on them, their line, its faults, and the options of a head that drives them."""

    clock: Clock
    axes: tuple[WireAxis, WireAxis]
    servos: list[SimulatedServo]
    line: MemoryLine
    options: dict[str, Any]
    panel: FaultPanel
    host: HangingHost
    ear: Ear = field(default_factory=Ear)

    def open(self, **changes: Any) -> DynamixelHead:
        return open_head({**self.options, **changes}, self.clock, self.host)

    def angle_rad(self, axis: int) -> float:
        """Where an axis truly stands."""
        return self.axes[axis].angle_rad(self.now_s())

    def speed_rad_per_s(self, axis: int) -> float:
        """How fast an axis truly turns."""
        return self.axes[axis].velocity_rad_per_s(self.now_s())


@contextmanager
def rig(
    models: tuple[str, str] = (X, X),
    starts_rad: tuple[float, float] = (0.0, 0.0),
    pan: dict[str, int] | None = None,
    tilt: dict[str, int] | None = None,
    mechanism: AxisSettings = QUICK_TO_BRAKE,
    waits_for_predecessor: bool = True,
    far_end: Callable[[DynamixelBus], WireDevice] = lambda bus: bus,
) -> Iterator[Rig]:
    """Two servos of a 12-bit or other kind; ``pan`` and ``tilt`` are registers that they begin with."""
    clock = SimulationClock(start_s=START_S)
    now_s = clock.now_s()
    panel, ear = FaultPanel(clock.now_s, ()), Ear()
    axes = (
        WireAxis(mechanism, panel, number=0, start_rad=starts_rad[0], time_s=now_s),
        WireAxis(mechanism, panel, number=1, start_rad=starts_rad[1], time_s=now_s),
    )
    extra = [pan or {}, tilt or {}]
    servos = [
        SimulatedServo(model, i + 1, axis, settings={"baud_rate": 3, **extra[i]}, time_s=now_s)
        for i, (model, axis) in enumerate(zip(models, axes, strict=True))
    ]
    device = far_end(DynamixelBus(servos, waits_for_predecessor=waits_for_predecessor))
    with clock.at_work(), MemoryLine(device, clock, panel, wire_time=False, observer=ear) as line:
        options = {
            "port": line.path,
            "pan": {"id": 1, "model": models[0], "limits_rad": [-2.5, 2.5]},
            "tilt": {"id": 2, "model": models[1], "limits_rad": [-1.2, 1.0]},
            "reply_timeout_s": 0.1,
            "acceleration_rad_per_s2": 15.0,
            "watchdog_s": 0.4,
        }
        yield Rig(clock, axes, servos, line, options, panel, HangingHost(line.open, clock), ear)


@contextmanager
def opened(**how: Any) -> Iterator[tuple[Rig, DynamixelHead]]:
    """A rig and its open head; ``options`` change the head's, everything else is the rig's."""
    options = how.pop("options", {})
    with rig(**how) as it:
        head = it.open(**options)
        try:
            yield it, head
        finally:
            head.close()


def faults_of(it: Rig, head: PanTilt) -> Sequence[str]:
    """The faults of the first reading that has some."""

    def faults() -> Sequence[str]:
        reading = read_or_none(head)
        return reading.faults if reading is not None else ()

    return it.until(faults, "a fault")


def read_or_none(head: PanTilt) -> Reading | None:
    try:
        return head.read()
    except DriverError:
        return None


def failed(head: PanTilt) -> DriverError | None:
    try:
        head.read()
    except DriverError as error:
        return error
    return None

"""Heads to be tried: each pan/tilt driver on a simulated device whose true angles are known.

Backlash and sag are nothing here, so the angle that the mechanism stands at is the angle of the motor, which
a reading has to tell; a reading rounds it to the device's count.

A rig lives on the machine's clock behind a pseudo terminal or TCP, or (``turned``) in memory on a clock that
is turned: whoever has it waits on that clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any
from unittest.mock import patch

from drivers.clock import Clock, SystemClock
from drivers.dynamixel.head import DynamixelHead
from drivers.dynamixel.models import dynamixel_settings
from drivers.faults import FaultPanel
from drivers.feetech.head import FeetechHead, feetech_settings
from drivers.flir_ptu import conversation
from drivers.flir_ptu.head import open_head as open_flir_ptu
from drivers.interfaces import PanTilt
from drivers.serial_line import OpenLine, SerialLine
from drivers.servo_bus.settings import LONGEST_REPLY_S
from drivers.sim.axis import AxisSettings, WireAxis
from drivers.sim.heads import HeadModel
from drivers.sim.pan_tilt import SimulatedPanTilt
from drivers.sim.wire.carrier import WireDevice
from drivers.sim.wire.dynamixel_bus import DynamixelBus
from drivers.sim.wire.dynamixel_servo import SimulatedServo
from drivers.sim.wire.feetech_bus import FeetechBus
from drivers.sim.wire.feetech_servo import SimulatedFeetechServo
from drivers.sim.wire.line import MemoryLine, PtyLine, TcpLine
from drivers.sim.wire.ptu import SimulatedPtu
from drivers.simulation_clock import SimulationClock

LIMITS_RAD = ((-1.0, 1.0), (-0.6, 0.4))
SPEED_RAD_PER_S, ACCELERATION_RAD_PER_S2 = 1.2, 20.0
START_S = 1000.0  # of a turned clock
REPLY_S = 0.2  # of a turned clock
PATIENT_S = 20.0
"""The reply deadline on the machine's clock, longer than any option allows: there a reply passes two threads
and two of the kernel's, each of which a busy machine may run tens of milliseconds late."""
X_COUNT_RAD = math.tau / 4096  # e-manual, X series
D46_STEP_RAD = math.radians(324 / 7 / 3600)  # D46-70, half step of 46.2857"
D48E_STEP_RAD = math.radians(162 / 7 / 3600)  # eighth step of 23.142857"


@dataclass
class HeadRig:
    """A head, and what only the tester knows about it.

    Attributes
    ----------
    name
        What it is.
    head
        The driver under test.
    clock
        What it lives on.
    panel
        Where faults are set.
    true_rad
        Pan and tilt of the motors at a moment of the last minute.
    count_rad
        One count.
    line
        The simulated line, None in memory.
    settle_rad
        How far from its goal a settled head may be, beyond the rounding to counts; nothing when simulated.
    fastest_rad_per_s
        Bound of every move's speed, None where it is not known.
    sent
        Pieces that have passed on the line.
    """

    name: str
    head: PanTilt
    clock: Clock
    panel: FaultPanel
    true_rad: Callable[[float], tuple[float, float]]
    count_rad: float
    line: MemoryLine | PtyLine | TcpLine | None = None
    sent: list[int] = field(default_factory=lambda: [0])
    settle_rad: float = 1e-9
    fastest_rad_per_s: float | None = SPEED_RAD_PER_S


@contextmanager
def in_memory(turned: bool = False) -> Iterator[HeadRig]:
    """The simulated head without any bytes."""
    clock = _clock(turned)
    axes = [
        AxisSettings(X_COUNT_RAD, 0.0, low, high, SPEED_RAD_PER_S, ACCELERATION_RAD_PER_S2)
        for low, high in LIMITS_RAD
    ]
    panel = FaultPanel(clock.now_s, ())
    head = SimulatedPanTilt(HeadModel("in memory", *axes), clock, panel)
    try:
        yield HeadRig("in memory", head, clock, panel, head.true_joints, X_COUNT_RAD)
    finally:
        head.close()


@contextmanager
def dynamixel(
    watchdog_s: float = 0.0, reply_timeout_s: float = REPLY_S, *, turned: bool = False
) -> Iterator[HeadRig]:
    """Two XM430 servos behind a serial line; by default without a watchdog.

    The reply deadline is that of a turned clock; without a watchdog it is ``PATIENT_S`` on the machine's.
    """
    with ExitStack() as stack:
        clock = _clock(turned)
        panel, axes = _axes(clock)
        settings = {"baud_rate": 3, "return_delay_time": 0}  # 1 Mbaud
        servos = [
            SimulatedServo("xm430_w350", number, axis, settings=settings, time_s=clock.now_s())
            for number, axis in enumerate(axes, start=1)
        ]
        sent = [0]
        bus = DynamixelBus(servos)
        line, opens = _serial_line(stack, bus, clock, panel, sent)
        ends = [{"id": n, "model": "XM430-W350", "limits_rad": list(LIMITS_RAD[n - 1])} for n in (1, 2)]
        options: dict[str, Any] = {
            "port": line.path, "baud": 1_000_000, "pan": ends[0], "tilt": ends[1],
            "speed_rad_per_s": SPEED_RAD_PER_S, "acceleration_rad_per_s2": ACCELERATION_RAD_PER_S2,
            "watchdog_s": watchdog_s, "reply_timeout_s": reply_timeout_s,
        }  # fmt: skip
        found = dynamixel_settings(options)
        if not (turned or watchdog_s):
            found = found.model_copy(update={"reply_timeout_s": PATIENT_S})
        head = DynamixelHead(found, clock, opens)
        stack.callback(head.close)
        yield HeadRig("Dynamixel", head, clock, panel, _truth(axes), X_COUNT_RAD, line, sent)


@contextmanager
def feetech(
    model: str = "STS3215",
    reply_timeout_s: float = REPLY_S,
    *,
    lease_s: float = 0.0,
    echoes: bool = False,
    turned: bool = False,
) -> Iterator[HeadRig]:
    """Two Feetech servos behind a serial line; by default without a lease. Deadlines as of `dynamixel`."""
    with ExitStack() as stack:
        clock = _clock(turned)
        panel, axes = _axes(clock)
        settings = {"return_delay": 0}
        servos = [
            SimulatedFeetechServo(model, number, axis, settings=settings, time_s=clock.now_s())
            for number, axis in enumerate(axes, start=1)
        ]
        sent = [0]
        line, opens = _serial_line(stack, FeetechBus(servos, echoes=echoes), clock, panel, sent)
        ends = [{"id": n, "model": model, "limits_rad": list(LIMITS_RAD[n - 1])} for n in (1, 2)]
        options: dict[str, Any] = {
            "port": line.path, "pan": ends[0], "tilt": ends[1], "speed_rad_per_s": SPEED_RAD_PER_S,
            "acceleration_rad_per_s2": ACCELERATION_RAD_PER_S2, "lease_s": lease_s,
            "reply_timeout_s": reply_timeout_s,
        }  # fmt: skip
        found = feetech_settings(options)
        if not (turned or lease_s):
            found = found.model_copy(update={"reply_timeout_s": PATIENT_S})
        head = FeetechHead(found, clock, opens)
        stack.callback(head.close)
        count_rad = head.settings.pan.model.count_rad
        yield HeadRig(f"Feetech {model}", head, clock, panel, _truth(axes), count_rad, line, sent)


@contextmanager
def ptu(*, turned: bool = False) -> Iterator[HeadRig]:
    """A D46-70 behind a serial line."""
    with ExitStack() as stack:
        clock = _clock(turned)
        panel, axes = _axes(clock)
        sent = [0]
        unit = SimulatedPtu("d46_70", *axes)
        line, opens = _serial_line(stack, unit, clock, panel, sent)
        yield _ptu_rig(stack, "PTU", line.path, opens, line, unit, clock, panel, axes, sent)


@contextmanager
def line_alone(driver: str) -> Iterator[tuple[dict[str, Any], Callable[[float], tuple[float, float]]]]:
    """Simulated servos on a pseudo terminal that nobody has opened: a driver's options, and the truth.

    Dynamixel servos stop by their watchdog 0.4 s after the last packet, Feetech ones where their lease ends.
    """
    clock = SystemClock()
    panel, axes = _axes(clock)
    device: DynamixelBus | FeetechBus | SimulatedPtu
    if driver == "dynamixel":
        settings = {"baud_rate": 3, "return_delay_time": 0}
        device = DynamixelBus(
            SimulatedServo("xm430_w350", number, axis, settings=settings, time_s=clock.now_s())
            for number, axis in enumerate(axes, start=1)
        )
        ends = [{"id": n, "model": "XM430-W350", "limits_rad": list(LIMITS_RAD[n - 1])} for n in (1, 2)]
        options: dict[str, Any] = {
            "baud": 1_000_000, "watchdog_s": 0.4, "reply_timeout_s": 0.1,
            "acceleration_rad_per_s2": ACCELERATION_RAD_PER_S2,
        }  # fmt: skip
    elif driver == "feetech":
        device = FeetechBus(
            SimulatedFeetechServo("sts3215", number, axis, time_s=clock.now_s())
            for number, axis in enumerate(axes, start=1)
        )
        ends = [{"id": n, "model": "STS3215", "limits_rad": list(LIMITS_RAD[n - 1])} for n in (1, 2)]
        options = {"reply_timeout_s": LONGEST_REPLY_S, "acceleration_rad_per_s2": ACCELERATION_RAD_PER_S2}
    else:
        device = SimulatedPtu("d46_70", *axes)
        ends, options = [{"limits_rad": list(limits)} for limits in LIMITS_RAD], {}
        ends[0]["sign"] = -1
    with PtyLine(device, clock, panel, wire_time=False) as line:
        yield {"port": line.path, "pan": ends[0], "tilt": ends[1], **options}, _truth(axes)


@contextmanager
def ptu_tcp() -> Iterator[HeadRig]:
    """A D48E, whose answers look otherwise, behind a TCP port."""
    with ExitStack() as stack:
        clock = SystemClock()
        panel, axes = _axes(clock)
        sent = [0]
        unit = SimulatedPtu("d48e", *axes)
        line = stack.enter_context(TcpLine(unit, clock, panel, banner=unit.banner, observer=_counter(sent)))
        port = f"socket://127.0.0.1:{line.port}"
        yield _ptu_rig(stack, "PTU, TCP", port, SerialLine, line, unit, clock, panel, axes, sent)


def _ptu_rig(
    stack: ExitStack,
    name: str,
    port: str,
    opens: OpenLine,
    line: MemoryLine | PtyLine | TcpLine,
    unit: SimulatedPtu,
    clock: Clock,
    panel: FaultPanel,
    axes: tuple[WireAxis, WireAxis],
    sent: list[int],
) -> HeadRig:
    """The driver on a simulated unit; positions of its pan grow to the left."""
    step_rad = D48E_STEP_RAD if name == "PTU, TCP" else D46_STEP_RAD
    acceleration = round(ACCELERATION_RAD_PER_S2 / step_rad)
    for axis in (unit.pan, unit.tilt):  # as somebody left it; setting it by PA would take the unit seconds
        axis.acceleration = acceleration
    options = {
        "port": port,
        "pan": {"limits_rad": list(LIMITS_RAD[0]), "sign": -1},
        "tilt": {"limits_rad": list(LIMITS_RAD[1])},
        "speed_rad_per_s": SPEED_RAD_PER_S,
    }
    if isinstance(clock, SystemClock):
        stack.enter_context(patch.object(conversation, "REPLY_S", PATIENT_S))
    head = open_flir_ptu(options, clock, opens)
    stack.callback(head.close)
    fastest = unit.pan.fastest * step_rad  # its own; the options' speed is for moves that name none
    return HeadRig(name, head, clock, panel, _truth(axes), step_rad, line, sent, fastest_rad_per_s=fastest)


def _clock(turned: bool) -> Clock:
    """What a rig lives on."""
    return SimulationClock(start_s=START_S) if turned else SystemClock()


def _serial_line(
    stack: ExitStack, device: WireDevice, clock: Clock, panel: FaultPanel, sent: list[int]
) -> tuple[MemoryLine | PtyLine, OpenLine]:
    """A line to a device, and how a driver opens it."""
    if isinstance(clock, SystemClock):
        pty = PtyLine(device, clock, panel, wire_time=False, observer=_counter(sent))
        return stack.enter_context(pty), SerialLine
    line = MemoryLine(device, clock, panel, wire_time=False, observer=_counter(sent))
    return stack.enter_context(line), line.open


def _axes(clock: Clock) -> tuple[FaultPanel, tuple[WireAxis, WireAxis]]:
    """The two motors."""
    panel = FaultPanel(clock.now_s, ())
    settings = [
        AxisSettings(X_COUNT_RAD, 0.0, low, high, SPEED_RAD_PER_S, ACCELERATION_RAD_PER_S2)
        for low, high in LIMITS_RAD
    ]
    now_s = clock.now_s()
    pan = WireAxis(settings[0], panel, number=0, time_s=now_s)
    tilt = WireAxis(settings[1], panel, number=1, time_s=now_s)
    return panel, (pan, tilt)


def _truth(axes: tuple[WireAxis, WireAxis]) -> Callable[[float], tuple[float, float]]:
    """The mechanism's angles, which no fault of an encoder or a line touches."""
    return lambda time_s: (axes[0].mechanical_rad(time_s), axes[1].mechanical_rad(time_s))


def _counter(sent: list[int]) -> Callable[..., None]:
    """An observer that counts what the host sends."""

    def count(who: str, data: bytes, time_s: float) -> None:
        sent[0] += who == "host"

    return count


RIGS: dict[str, Callable[[], Any]] = {
    "in_memory": in_memory,
    "dynamixel_pty": dynamixel,
    "feetech_pty": feetech,
    "ptu_pty": ptu,
    "ptu_tcp": ptu_tcp,
}
"""On the machine's clock."""

TURNED: dict[str, Callable[[], Any]] = {
    "in_memory": partial(in_memory, turned=True),
    "dynamixel": partial(dynamixel, turned=True),
    "feetech": partial(feetech, lease_s=0.2, reply_timeout_s=0.1, turned=True),
    "feetech_echo": partial(feetech, reply_timeout_s=0.1, echoes=True, turned=True),
    "ptu": partial(ptu, turned=True),
}
"""On a turned clock."""

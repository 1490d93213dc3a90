"""Every answer is of its question: servos on a line that repeats, holds back or misnames their replies.

A status packet tells who speaks and not what was asked. The lines here are the worst there can be: the
order of the bytes is set by hand.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial

import pytest

from drivers.dynamixel.head import DynamixelHead, open_head
from drivers.errors import DriverError
from drivers.faults import FaultPanel
from drivers.interfaces import Reading
from drivers.sim.axis import AxisSettings
from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.carrier import Reply
from drivers.sim.wire.dynamixel_bus import DynamixelBus
from drivers.sim.wire.dynamixel_packets import unstuffed
from drivers.sim.wire.dynamixel_servo import VOLTAGE, SimulatedServo
from drivers.sim.wire.memory_line import MemoryLine
from drivers.simulation_clock import SimulationClock
from hil_tests.drivers.dynamixel.dynamixel_rig import failed
from hil_tests.drivers.turned import START_S, Turned

COUNT_RAD = 2 * 3.141592653589793 / 4096
MECHANISM = AxisSettings(COUNT_RAD, 0.0, -3.0, 3.0, 1.0, 20.0)
NEW = {"return_delay_time": 250, "min_position_limit": 0, "max_position_limit": 4095}


class Line:
    """A line's far end that passes questions on; what it does to the replies is ``change``."""

    def __init__(self, bus: DynamixelBus) -> None:
        self.bus = bus
        self.host_baud: int | None = None

    @property
    def baud(self) -> int:
        return self.bus.baud

    def receive(self, data: bytes, time_s: float) -> Sequence[Reply]:
        self.bus.host_baud = self.host_baud
        return self.change(list(self.bus.receive(data, time_s)), time_s)

    def poll(self, time_s: float) -> Sequence[Reply]:
        return self.bus.poll(time_s)

    def renamed(self, data: bytes, servo_id: int) -> bytes:
        return self.bus.renamed(data, servo_id)

    def change(self, replies: list[Reply], time_s: float) -> list[Reply]:
        return replies


class Repeating(Line):
    """Each answer comes once more, just before that to the question some questions later."""

    def __init__(self, bus: DynamixelBus, lag: int) -> None:
        super().__init__(bus)
        self._held: deque[list[Reply]] = deque([[] for _ in range(lag)])

    def change(self, replies: list[Reply], time_s: float) -> list[Reply]:
        self._held.append(replies)
        return [*self._held.popleft(), *replies]


class HoldingBack(Repeating):
    """Each answer comes only when the question some questions later was asked."""

    def change(self, replies: list[Reply], time_s: float) -> list[Reply]:
        self._held.append(replies)
        return self._held.popleft()


class Telling(Line):
    """Notes the positions that both servos tell in one transaction; loses pan's answer when told to."""

    def __init__(self, bus: DynamixelBus) -> None:
        super().__init__(bus)
        self.told: set[tuple[int, int]] = set()
        self.lose = 0

    def change(self, replies: list[Reply], time_s: float) -> list[Reply]:
        if len(replies) < 2:
            return replies
        # e-manual: position, two trajectories of 4, voltage, temperature and the checksum at the end
        ends = [unstuffed(reply.data)[-17:-13] for reply in replies]
        self.told.add((int.from_bytes(ends[0], "little"), int.from_bytes(ends[1], "little")))
        if self.lose:
            self.lose -= 1
            return replies[1:]
        return replies


class Servos(Turned):
    """Two servos fresh from the factory, and how often they were rebooted."""

    def __init__(self) -> None:
        self.clock = SimulationClock(start_s=START_S)
        self.panel = FaultPanel(self.clock.now_s, ())
        now_s = self.clock.now_s()
        self.axes = [WireAxis(MECHANISM, number=n, time_s=now_s) for n in (0, 1)]
        self.servos = [
            SimulatedServo("xm430_w350", n, axis, settings={"baud_rate": 3, **NEW}, time_s=now_s)
            for n, axis in enumerate(self.axes, start=1)
        ]
        self.reboots = 0
        for servo in self.servos:
            servo.reboot = partial(self._counted, servo)  # type: ignore[method-assign]
        self.bus = DynamixelBus(self.servos)

    def _counted(self, servo: SimulatedServo, time_s: float) -> None:
        self.reboots += 1
        SimulatedServo.reboot(servo, time_s)

    @contextmanager
    def opened(self, far_end: Line, **changes: object) -> Iterator[DynamixelHead]:
        """A head that has opened over a line with this end."""
        ends = [
            {"id": n, "model": "XM430-W350", "limits_rad": [-1.0, 1.0], "on_hardware_error": "reboot"}
            for n in (1, 2)
        ]
        with (
            self.clock.at_work(),
            MemoryLine(far_end, self.clock, self.panel, wire_time=False) as line,
        ):
            options = {
                "port": line.path, "pan": ends[0], "tilt": ends[1], "reply_timeout_s": 0.1,
                "watchdog_s": 0.4, "acceleration_rad_per_s2": 15.0, **changes,
            }  # fmt: skip
            head = open_head(options, self.clock, line.open)
            try:
                yield head
            finally:
                head.close()


def counts_of(reading: Reading) -> tuple[int, int]:
    """The positions of a reading, e-manual: 0 is 2048."""
    return 2048 + round(reading.pan_rad / COUNT_RAD), 2048 + round(reading.tilt_rad / COUNT_RAD)


def as_configured(servo: SimulatedServo) -> bool:
    """Whether the servo really is as a head that opened has to have left it."""
    table = servo.table
    return (
        [table[name] for name in ("return_delay_time", "operating_mode", "drive_mode")] == [0, 3, 0]
        and [table["min_position_limit"], table["max_position_limit"]] == [1397, 2699]
        and table["torque_enable"] == 1
        and table["bus_watchdog"] == 20
    )


@pytest.mark.parametrize("lag", [1, 2, 3, 4, 5])
def test_a_head_whose_every_answer_is_repeated_later_opens_as_it_should(lag: int) -> None:
    it = Servos()
    with it.opened(Repeating(it.bus, lag)):
        assert all(as_configured(servo) for servo in it.servos)
    assert it.reboots == 0


@pytest.mark.parametrize("lag", [1, 2, 3, 4, 5])
def test_a_head_whose_every_answer_comes_questions_late_is_not_opened(lag: int) -> None:
    it = Servos()
    with pytest.raises(DriverError), it.opened(HoldingBack(it.bus, lag), reply_timeout_s=0.02):
        pass
    assert it.reboots == 0


@pytest.mark.parametrize("lag", [1, 2, 3])
def test_a_servo_that_is_rebooted_for_an_error_is_taken_for_no_other_and_has_no_other(lag: int) -> None:
    it = Servos()
    with it.opened(Repeating(it.bus, lag)) as head:
        told = set()
        it.servos[0].raise_error(VOLTAGE)
        it.until(lambda: failed(head), "the error")
        while (error := failed(head)) is not None:
            told.add(str(error))
            it.clock.sleep(0.002)
    assert all("hardware error 0x01" in words for words in told), told
    assert it.reboots == 1


def test_what_was_lost_is_not_filled_in_from_another_moment() -> None:
    it = Servos()
    it.bus.waits_for_predecessor = False
    far_end = Telling(it.bus)
    with it.opened(far_end, speed_rad_per_s=1.0) as head:
        head.move(0.9, 0.9)
        seen = set()
        while len(seen) < 20:
            far_end.lose = 1
            with suppress(DriverError):
                reading = head.read()
                seen.add(
                    (2048 + round(reading.pan_rad / COUNT_RAD), 2048 + round(reading.tilt_rad / COUNT_RAD))
                )
            if not far_end.lose and reading.moving is False:
                head.move(-reading.pan_rad, -reading.tilt_rad)
    assert seen <= far_end.told


@pytest.mark.parametrize("probability", [0.2, 1.0])
def test_a_reply_of_pan_under_the_id_of_tilt_is_no_reading(probability: float) -> None:
    it = Servos()
    it.bus.waits_for_predecessor = False
    far_end = Telling(it.bus)
    with it.opened(far_end) as head:
        head.move(0.9, -0.9)
        it.panel.set("pan_tilt", "misnamed", replies=1000, probability=probability, seed=3)
        seen, failed = set(), 0
        for _ in range(60):
            try:
                reading = head.read()
            except DriverError:
                failed += 1
            else:
                seen.add(
                    (2048 + round(reading.pan_rad / COUNT_RAD), 2048 + round(reading.tilt_rad / COUNT_RAD))
                )
        it.panel.clear()
    assert seen <= far_end.told
    assert seen if probability < 1 else failed == 60

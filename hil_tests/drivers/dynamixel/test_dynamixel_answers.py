"""Every answer is of its question: servos on a line that repeats, holds back or misnames their replies.

A status packet tells who speaks and not what was asked. The lines here are the worst there can be: the
order of the bytes is set by hand.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import pytest

from drivers.errors import DriverError
from drivers.interfaces import Reading
from drivers.sim.wire.carrier import Reply
from drivers.sim.wire.dynamixel_bus import DynamixelBus, unstuffed
from drivers.sim.wire.dynamixel_servo import VOLTAGE, SimulatedServo
from hil_tests.drivers.dynamixel.dynamixel_rig import COUNT_RAD, Rig, failed, opened, rig

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
        self._kept: deque[list[Reply]] = deque([[] for _ in range(lag)])

    def change(self, replies: list[Reply], time_s: float) -> list[Reply]:
        self._kept.append(replies)
        return [*self._kept.popleft(), *replies]


class HoldingBack(Repeating):
    """Each answer comes only when the question some questions later was asked."""

    def change(self, replies: list[Reply], time_s: float) -> list[Reply]:
        self._kept.append(replies)
        return self._kept.popleft()


class Noting(Line):
    """Notes the positions in the answers of one transaction; loses as many of pan's as ``lose`` says."""

    def __init__(self, bus: DynamixelBus) -> None:
        super().__init__(bus)
        self.positions: set[tuple[int, int]] = set()
        self.lose = 0

    def change(self, replies: list[Reply], time_s: float) -> list[Reply]:
        if len(replies) < 2:
            return replies
        # e-manual: position, two trajectories of 4, voltage, temperature and the checksum at the end
        ends = [unstuffed(reply.data)[-17:-13] for reply in replies]
        self.positions.add((int.from_bytes(ends[0], "little"), int.from_bytes(ends[1], "little")))
        if self.lose:
            self.lose -= 1
            return replies[1:]
        return replies


def opened_on(far_end: Callable[[DynamixelBus], Line], **changes: Any) -> Any:
    """Two servos fresh from the factory on such a line, and a head that has opened."""
    options = {"watchdog_s": 0.4, **changes}
    for axis, servo_id in (("pan", 1), ("tilt", 2)):
        options[axis] = {
            "id": servo_id, "model": "XM430-W350", "limits_rad": [-1.0, 1.0], "on_hardware_error": "reboot",
        }  # fmt: skip
    return opened(pan=NEW, tilt=NEW, waits_for_predecessor=False, far_end=far_end, options=options)


def reboots(it: Rig) -> int:
    """How often a servo was told to restart (e-manual: instruction 8)."""
    return sum(one.code == 8 for _, one in it.ear.heard)


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


@pytest.mark.parametrize("lag", [1, 2, 5])
def test_a_head_whose_answers_are_repeated_opens_as_it_should(lag: int) -> None:
    with opened_on(partial(Repeating, lag=lag)) as (it, _):
        assert all(as_configured(servo) for servo in it.servos)
        assert reboots(it) == 0


@pytest.mark.parametrize("lag", [1, 2, 5])
def test_a_head_whose_answers_come_questions_late_is_not_opened(lag: int) -> None:
    with rig(pan=NEW, tilt=NEW, far_end=partial(HoldingBack, lag=lag)) as it:
        with pytest.raises(DriverError):
            it.open(reply_timeout_s=0.02)
        assert reboots(it) == 0


@pytest.mark.parametrize("lag", [1, 3])
def test_a_servo_rebooted_for_an_error_has_no_other(lag: int) -> None:
    with opened_on(partial(Repeating, lag=lag)) as (it, head):
        messages = set()
        it.servos[0].raise_error(VOLTAGE)
        it.until(lambda: failed(head), "the error")
        while (error := failed(head)) is not None:
            messages.add(str(error))
            it.clock.sleep(0.002)
        assert all("hardware error 0x01" in message for message in messages), messages
        assert reboots(it) == 1


def test_what_was_lost_is_not_filled_in_from_another_moment() -> None:
    with opened_on(Noting, speed_rad_per_s=1.0) as (it, head):
        far_end = it.line.device
        head.move(0.9, 0.9)
        seen: set[tuple[int, int]] = set()
        while len(seen) < 20:
            far_end.lose = 1
            with suppress(DriverError):
                reading = head.read()
                seen.add(counts_of(reading))
            if not far_end.lose and reading.moving is False:
                head.move(-reading.pan_rad, -reading.tilt_rad)
        assert seen <= far_end.positions


@pytest.mark.parametrize("probability", [0.2, 1.0])
def test_a_reply_of_pan_under_the_id_of_tilt_is_no_reading(probability: float) -> None:
    with opened_on(Noting) as (it, head):
        head.move(0.9, -0.9)
        it.panel.set("pan_tilt", "misnamed", replies=1000, probability=probability, seed=3)
        seen: set[tuple[int, int]] = set()
        failures = 0
        for _ in range(60):
            try:
                seen.add(counts_of(head.read()))
            except DriverError:
                failures += 1
        it.panel.clear()
        assert seen <= it.line.device.positions
        assert seen if probability < 1 else failures == 60

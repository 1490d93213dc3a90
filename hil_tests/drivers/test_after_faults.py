"""What docs/how-to/hardware.md says happens after a fault: pointing on simulated bytes, on a turned clock."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calib.geometry.rig import Mast, Rig
from drivers.clock import Clock
from drivers.interfaces import PanTilt
from hil_tests.drivers.dynamixel.dynamixel_rig import failed, opened, read_or_none
from hil_tests.drivers.turned import Gate, Turned
from hil_tests.waiting import NET_S
from mastctl.devices.devices import Devices
from mastctl.devices.limits import Limits
from mastctl.motion.loop import PointingLoop
from mastctl.motion.requests import AnglesTarget, PointRequest
from mastctl.motion.results import PointingError
from tools.campaigns.servo_rigs import dynamixel, ptu

BARE = Rig("bare", Mast(np.zeros(3), np.zeros(3)), {}, {})
LIMITS = Limits((-0.9, 0.9), (-0.5, 0.3), 0.5)


class Pointer(Turned):
    """The service's pointing by joint angles on one head; ``to`` returns how it ended."""

    def __init__(self, head: PanTilt, clock: Clock) -> None:
        self.clock = clock
        self.devices = Devices(SimpleNamespace(pan_tilt=head, cameras={}), LIMITS, "0" * 64, clock)
        self._loop = PointingLoop(BARE, self.devices, LIMITS, clock)

    def to(self, pan_rad: float) -> str:
        try:
            request = PointRequest(AnglesTarget(pan_rad, 0.0))
            self._loop.run(request, lambda step: None, threading.Event())
        except PointingError as error:
            return error.code
        return "done"

    def far(self) -> tuple[Gate, list[str]]:
        """Start a long pointing, and return its end and what it ended by."""
        how: list[str] = []
        ended = self.beside(lambda: how.append(self.to(0.85)))
        self.until(lambda: (r := self.devices.last_reading) and 0.1 < r.pan_rad < 0.6, "motion")
        return ended, how


@contextmanager
def pointing(head: PanTilt, clock: Clock) -> Iterator[Pointer]:
    pointer = Pointer(head, clock)
    try:
        yield pointer
    finally:
        pointer.outside(pointer.devices.close)


def end(running: tuple[Gate, list[str]]) -> str:
    ended, how = running
    ended.wait()
    return how[0]


def test_after_the_watchdog_the_pointing_fails_stops_and_the_next_one_moves() -> None:
    with opened() as (it, head), pointing(head, it.clock) as pointer:
        running = pointer.far()
        free = it.gate()
        stall = it.beside(lambda: head._bus.call("stall", free.wait, NET_S))
        it.until(lambda: it.servos[0].table["bus_watchdog"] == 255, "the watchdog")
        free.set()
        stall.wait()
        assert end(running) in ("head_fault", "no_reply", "watchdog_tripped")
        it.until(lambda: it.speed_rad_per_s(0) == 0, "rest")
        stood_rad = it.angle_rad(0)
        it.clock.sleep(0.3)
        assert it.angle_rad(0) == pytest.approx(stood_rad, abs=0.005), "moved by itself"
        assert it.servos[0].table["bus_watchdog"] == 20, "the stop of the failed pointing has armed it anew"
        assert pointer.to(0.0) == "done"


def test_a_hardware_error_refuses_every_pointing_until_the_servo_starts_anew() -> None:
    with opened() as (it, head), pointing(head, it.clock) as pointer:
        running = pointer.far()
        it.servos[0].raise_error(32)  # overload
        assert end(running) == "head_fault"
        for _ in range(2):
            pointer.devices.stop()
            assert pointer.to(0.1) == "head_fault"
        assert it.servos[1].table["torque_enable"] == 1, "the other axis holds"
        it.servos[0].set_power(False, it.now_s())
        it.until(lambda: failed(head), "the servo's silence")
        it.servos[0].set_power(True, it.now_s())
        it.until(lambda: read_or_none(head), "its return")
        it.until(lambda: not pointer.devices.faults(), "the end of the fault")
        assert pointer.to(0.1) == "done"


@pytest.mark.parametrize("made", [dynamixel, ptu], ids=lambda made: made.__name__)
def test_a_pulled_plug_refuses_until_the_line_is_back_and_then_moves_only_when_asked(made: Any) -> None:
    with made(turned=True) as rig, rig.clock.at_work(), pointing(rig.head, rig.clock) as pointer:
        running = pointer.far()
        rig.line.hang_up()
        assert end(running) in ("line_lost", "no_reply")
        assert pointer.to(0.0) in ("line_lost", "no_reply")
        rig.line.come_back()
        pointer.until(lambda: not pointer.devices.faults(), "the end of the fault")
        pointer.until(lambda: not rig.head.read().moving, "rest")
        stood_rad = rig.true_rad(pointer.now_s())[0]
        pointer.clock.sleep(0.3)
        assert rig.true_rad(pointer.now_s())[0] == pytest.approx(stood_rad, abs=rig.count_rad)
        assert pointer.to(0.0) == "done"

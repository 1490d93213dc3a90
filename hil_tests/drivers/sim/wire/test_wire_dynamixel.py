"""The simulated servo seen through the SDK: access, protection, watchdog, modes, motion, group reads."""

from __future__ import annotations

import math

import pytest

from drivers.sim.axis import WireAxis
from drivers.sim.wire.dynamixel_servo import BOOT_S
from hil_tests.drivers.sim.wire.dynamixel_host import SETTINGS, Host, axis, servo

TIMEOUT = -3001
ALERT = 0x80


class Felt(WireAxis):
    """An axis whose temperature the test sets."""

    celsius = 30.0

    def temperature_c(self, time_s: float) -> float:
        return self.celsius


@pytest.fixture
def host() -> Host:
    """An XM430 with id 1 and a PH42 with id 2."""
    return Host(servo("xm430_w350", 1), servo("ph42_020_s300", 2))


def goal(host: Host, counts: int, velocity: int = 0, acceleration: int = 0) -> None:
    """Torque on and off to a position, on an X with id 1."""
    assert host.write(1, 64, 1, 1) == 0
    assert host.write(1, 108, 4, acceleration) == 0
    assert host.write(1, 112, 4, velocity) == 0
    assert host.write(1, 116, 4, counts) == 0


def test_eeprom_is_locked_while_torque_is_on(host: Host) -> None:
    for servo_id, torque in ((1, 64), (2, 512)):
        assert host.write(servo_id, 31, 1, 70) == 0
        assert host.write(servo_id, torque, 1, 1) == 0
        assert host.write(servo_id, 31, 1, 60) == 7
        assert host.read(servo_id, 31, 1) == 70
        assert host.write(servo_id, torque, 1, 0) == 0
        assert host.write(servo_id, 31, 1, 60) == 0
        assert host.read(servo_id, 31, 1) == 60


@pytest.mark.parametrize(
    ("address", "size", "value", "error"),
    [
        (132, 4, 0, 7),  # read only
        (5000, 1, 0, 7),  # not there
        (116, 2, 100, 5),  # half a register
        (9, 1, 255, 4),  # beyond its range
        (10, 1, 2, 4),  # slave mode, which an XM430 has not
        (116, 4, 4096, 6),  # beyond the position limit
        (116, 4, 1_048_576, 4),  # beyond what the register takes in any mode
        (11, 1, 1, 4),  # velocity control, which is not simulated
        (104, 4, 201, 6),  # beyond the velocity limit
        (102, 2, -1194, 6),
        (116, 4, 4095, 0),
    ],
)
def test_errors_of_a_write(host: Host, address: int, size: int, value: int, error: int) -> None:
    before = host.sdk.readTxRx(host.port, 1, address, size)
    assert host.write(1, address, size, value) == error
    if error:
        assert host.sdk.readTxRx(host.port, 1, address, size) == before


# Group instructions


def test_sync_read_in_the_order_of_the_list() -> None:
    host = Host(*(servo("xm430_w350", i, goal_position=0, led=i % 2) for i in (1, 2, 3)))
    assert host.sync_read(7, 1, 3, 1, 2) == (0, {3: 3, 1: 1, 2: 2})
    assert host.port.senders == [3, 1, 2]


def test_a_dead_first_servo_silences_the_rest(host: Host) -> None:
    assert host.sync_read(0, 2, 9, 1, 2)[0] == TIMEOUT
    assert host.port.senders == []
    assert host.sync_read(0, 2, 1, 9, 2)[0] == TIMEOUT
    assert host.port.senders == [1]
    patient = Host(servo("xm430_w350", 1), servo("xm430_w350", 2), waits_for_predecessor=False)
    patient.sync_read(0, 2, 9, 1, 2)
    assert patient.port.senders == [1, 2]


def test_heat_drops_torque_and_only_a_reboot_gives_it_back() -> None:
    felt = Felt(SETTINGS)
    host = Host(servo("xm430_w350", 1, on=felt))
    goal(host, 4000, velocity=20)
    host.wait(0.2)
    felt.celsius = 81.0
    host.wait(0.02)
    assert host.status(1, 70, 1) == (0, ALERT)
    assert host.sdk.readTxRx(host.port, 1, 64, 1)[0] == [0]
    felt.celsius = 30.0
    assert host.write(1, 64, 1, 1) == ALERT
    assert host.sdk.readTxRx(host.port, 1, 64, 1)[0] == [0]
    assert host.sdk.reboot(host.port, 1) == (0, ALERT)
    host.wait(BOOT_S + 0.01)
    assert host.read(1, 70, 1) == 0
    assert host.write(1, 64, 1, 1) == 0
    assert host.read(1, 64, 1) == 1


# Bus watchdog


def test_watchdog_stops_the_servo_and_locks_its_goals() -> None:
    """As the manual's example: 50 units of velocity, 2 s (here 200 ms) without an instruction."""
    turned = axis()
    host = Host(servo("xm430_w350", 1, on=turned))
    assert host.write(1, 11, 1, 4) == 0  # any number of turns
    goal(host, 100_000, velocity=50)
    assert host.write(1, 98, 1, 10) == 0
    for _ in range(10):
        host.wait(0.15)
        assert host.read(1, 98, 1) == 10  # this feeds it
    assert host.read(1, 128, 4) == 50
    fed_s = host.clock.now_s()
    host.wait(0.3)
    now_s = host.clock.now_s()
    assert turned.velocity_rad_per_s(now_s) == 0.0
    # It was braked from 200 ms after the last packet on, at 50 units of 0.229 rpm.
    speed = 50 * 0.229 * math.tau / 60
    travelled = turned.angle_rad(now_s) - turned.angle_rad(fed_s)
    assert travelled == pytest.approx(0.2 * speed + speed**2 / 200, abs=1e-9)
    assert host.read(1, 98, 1) == 255
    assert host.write(1, 104, 4, 50) == 4
    assert host.write(1, 116, 4, 100) == 4
    assert host.write(1, 98, 1, 10) == 4
    assert host.write(1, 98, 1, 0) == 0
    assert host.write(1, 116, 4, 100_000) == 0
    host.wait(0.1)
    assert host.read(1, 128, 4) == 50


# Motion


def test_trapezoid_as_the_manual_has_it() -> None:
    """100 units of 0.229 rpm, 20 units of 214.577 rev/min²: ramp 64·100/20 = 320 ms, the manual's formula."""
    host = Host(servo("xm430_w350", 1))
    goal(host, 4000, velocity=100, acceleration=20)
    speed = 100 * 0.229 * 4096 / 60  # counts a second
    assert host.read(1, 122, 1) == 1
    assert host.read(1, 123, 1) & 0x32 == 0x32  # trapezoid, under way
    host.wait(0.320)
    assert host.signed(1, 128, 4) == pytest.approx(100, abs=1)
    assert host.signed(1, 132, 4) == pytest.approx(2048 + speed * 0.32 / 2, abs=2)
    total_s = (4000 - 2048) / speed + 0.32
    host.wait(total_s - 0.32 - 0.01)
    assert host.read(1, 122, 1) == 1
    host.wait(0.02)
    assert host.read(1, 122, 1) == 0
    assert host.read(1, 123, 1) == 1
    assert host.signed(1, 132, 4) == 4000
    assert host.signed(1, 140, 4) == 4000


def test_homing_offset(host: Host) -> None:
    """Added to the position; beyond ±1024 position control ignores it, extended position control does not."""
    assert host.write(1, 20, 4, 1000) == 0
    assert host.signed(1, 132, 4) == 3048
    assert host.write(1, 20, 4, -1024) == 0
    assert host.signed(1, 132, 4) == 1024
    assert host.write(1, 20, 4, 1025) == 0
    assert host.signed(1, 132, 4) == 2048
    assert host.write(1, 11, 1, 4) == 0
    assert host.signed(1, 132, 4) == 3073
    assert host.write(1, 20, 4, 1_044_480) == 4
    assert host.write(1, 20, 4, -1_044_479) == 0
    assert host.signed(1, 132, 4) == 2048 - 1_044_479
    assert host.write(2, 20, 4, 5000) == 0  # a P takes any
    assert host.signed(2, 580, 4) == 5000

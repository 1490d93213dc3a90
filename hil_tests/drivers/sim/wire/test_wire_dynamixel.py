"""The simulated servo seen through the SDK: access, protection, watchdog, modes, motion, group reads."""

from __future__ import annotations

import math

import pytest

from drivers.errors import BadOptions
from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.dynamixel_servo import BOOT_S, OVERLOAD_S, SimulatedServo
from hil_tests.drivers.sim.wire.dynamixel_host import SETTINGS, Host, axis, servo

TIMEOUT, CORRUPT = -3001, -3002
ALERT = 0x80


class Felt(WireAxis):
    """An axis whose supply, temperature and load the test sets."""

    volts = 1.0
    celsius = 30.0
    held = False

    def supply(self, time_s: float) -> float:
        return self.volts

    def temperature_c(self, time_s: float) -> float:
        return self.celsius

    def blocked(self, time_s: float) -> bool:
        return self.held


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


# Making one


def test_a_servo_that_cannot_be_is_refused() -> None:
    for model, servo_id, settings, words in (
        ("xm430_w530", 1, {}, "did you mean 'xm430_w350'"),
        ("xm430_w350", 253, {}, "id is 253"),
        ("xm430_w350", 1, {"baud_rate": 8}, "expected 0 to 7"),
        ("mx_28", 1, {"goal_current": 1}, "no register 'goal_current'"),
    ):
        with pytest.raises(BadOptions, match=words):
            servo(model, servo_id, **settings)


@pytest.mark.parametrize("name", ["XM430-W350-T", "xm430_w350", "XM430-W350", "xm430-w350-r"])
def test_spellings_of_a_model(name: str) -> None:
    assert servo(name, 1).model.number == 1020


# Ping, access, errors


def test_ping(host: Host) -> None:
    assert host.sdk.ping(host.port, 1) == (1020, 0, 0)
    assert host.sdk.ping(host.port, 2) == (2000, 0, 0)
    assert host.sdk.ping(host.port, 3)[1] == TIMEOUT


def test_broadcast_ping_in_order_of_the_ids() -> None:
    host = Host(*(servo("xl330_m288", i) for i in (9, 3, 6)))
    assert host.sdk.broadcastPing(host.port) == ({3: [1200, 52], 6: [1200, 52], 9: [1200, 52]}, 0)
    assert host.port.senders == [3, 6, 9]


def test_read_and_write(host: Host) -> None:
    assert host.read(1, 132, 4) == 2048
    assert host.read(2, 580, 4) == 0
    assert host.write(1, 65, 1, 1) == 0
    assert host.read(1, 65, 1) == 1
    assert host.write(2, 112 + 448, 4, 1234) == 0
    assert host.read(2, 560, 4) == 1234


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
        (66, 1, 0, 7),  # a gap
        (116, 2, 100, 5),  # half a register
        (118, 2, 100, 5),  # its other half
        (9, 1, 255, 4),  # beyond its range
        (11, 1, 2, 4),  # no such mode
        (10, 1, 2, 4),  # slave mode, which an XM430 has not
        (116, 4, 4096, 6),  # beyond the position limit
        (116, 4, -1, 6),
        (116, 4, 1_048_576, 4),  # beyond what the register takes in any mode
        (104, 4, 201, 6),  # beyond the velocity limit
        (104, 4, -201, 6),
        (100, 2, 886, 6),
        (102, 2, -1194, 6),
        (98, 1, 128, 4),
        (104, 4, 200, 0),
        (116, 4, 4095, 0),
    ],
)
def test_errors_of_a_write(host: Host, address: int, size: int, value: int, error: int) -> None:
    before = host.sdk.readTxRx(host.port, 1, address, size)
    assert host.write(1, address, size, value) == error
    if error:
        assert host.sdk.readTxRx(host.port, 1, address, size) == before


def test_errors_of_other_instructions(host: Host) -> None:
    assert host.status(1, 5000, 4) == (0, 7)
    assert host.instruct(1, 5) == (0, 2)  # action without reg write
    assert host.instruct(1, 0x77) == (0, 2)  # no such instruction
    assert host.instruct(1, 2, 132) == (0, 5)  # a read without a length
    assert host.instruct(1, 0x20, 1, 1, 2, 3, 4) == (0, 1)  # backup without its key
    # A damaged packet: the servo that seems to be meant says so.
    host.sdk.ping(host.port, 1)
    damaged = host.port.sent[:-1] + bytes((host.port.sent[-1] ^ 1,))
    assert [r.data[8] for r in host.bus.receive(damaged, 0.0)] == [3]


def test_a_refused_write_changes_nothing_of_it(host: Host) -> None:
    """Profile velocity is fine, the goal behind it is not."""
    data = list((50).to_bytes(4, "little") + (5000).to_bytes(4, "little"))
    assert host.sdk.writeTxRx(host.port, 1, 112, 8, data) == (0, 6)
    assert host.read(1, 112, 4) == 0


def test_position_limits_of_the_servo(host: Host) -> None:
    assert host.write(1, 48, 4, 3000) == 0
    assert host.write(1, 52, 4, 1000) == 0
    assert host.write(1, 64, 1, 1) == 0
    assert [host.write(1, 116, 4, v) for v in (999, 1000, 3000, 3001)] == [6, 0, 0, 6]
    assert host.write(1, 64, 1, 0) == 0
    assert host.write(1, 11, 1, 4) == 0  # they do not hold in extended position control
    assert host.write(1, 116, 4, -100_000) == 0


def test_status_return_level_and_delay(host: Host) -> None:
    assert host.write(1, 68, 1, 1) == 0
    assert host.sdk.write1ByteTxRx(host.port, 1, 65, 1)[0] == TIMEOUT
    assert host.read(1, 65, 1) == 1
    assert host.sdk.write1ByteTxRx(host.port, 1, 68, 0)[0] == TIMEOUT
    assert host.sdk.read1ByteTxRx(host.port, 1, 65)[1] == TIMEOUT
    assert host.sdk.ping(host.port, 1)[1] == 0
    assert host.sync_read(132, 4, 1)[0] == TIMEOUT
    assert host.write(2, 9, 1, 250) == 0
    host.sdk.ping(host.port, 2)
    (reply,) = host.bus.receive(host.port.sent, 0.0)
    assert reply.delay_s == pytest.approx(500e-6)


def test_stuffing_both_ways(host: Host) -> None:
    """A value with FF FF FD in it, in an answer and (stuffed by the SDK's own function) in a write."""
    x = Host(servo("xm430_w350", 1, on=axis(start_rad=(-131073 - 2048) * math.tau / 4096)))
    x.write(1, 11, 1, 4)
    assert x.signed(1, 132, 4) == -131073 % 4096  # extended mode starts within a turn
    assert host.write(2, 11, 1, 4) == 0
    body = [3, 564 & 255, 564 >> 8, 0xFF, 0xFF, 0xFD, 0xFF]
    raw = [0xFF, 0xFF, 0xFD, 0, 2, len(body) + 2, 0, *body, 0, 0]
    packet = host.sdk.addStuffing(raw)
    crc = host.sdk.updateCRC(0, packet, len(packet) - 2)
    packet[-2:] = [crc & 255, crc >> 8]
    assert len(host.bus.receive(bytes(packet), 0.0)) == 1
    assert host.signed(2, 564, 4) == -131073
    # The SDK's transmitter does not stuff, so a servo sees the start of another packet and says nothing.
    assert host.sdk.write4ByteTxRx(host.port, 2, 564, -131073)[0] == TIMEOUT


def test_registered_write_waits_for_action(host: Host) -> None:
    for servo_id, address in ((1, 65), (2, 513)):
        assert host.sdk.regWriteTxRx(host.port, servo_id, address, 1, [1]) == (0, 0)
        assert host.read(servo_id, address, 1) == 0
        assert host.read(servo_id, {1: 69, 2: 517}[servo_id], 1) == 1
    host.sdk.action(host.port, 0xFE)
    for servo_id, address in ((1, 65), (2, 513)):
        assert host.read(servo_id, address, 1) == 1
        assert host.read(servo_id, {1: 69, 2: 517}[servo_id], 1) == 0


# Group instructions


def test_sync_read_in_the_order_of_the_list() -> None:
    host = Host(*(servo("xm430_w350", i, goal_position=0, led=i % 2) for i in (1, 2, 3)))
    assert host.sync_read(7, 1, 3, 1, 2) == (0, {3: 3, 1: 1, 2: 2})
    assert host.port.senders == [3, 1, 2]
    assert host.sync_read(7, 1, 2, 3, fast=True) == (0, {2: 2, 3: 3})


def test_a_dead_first_servo_silences_the_rest(host: Host) -> None:
    assert host.sync_read(0, 2, 9, 1, 2)[0] == TIMEOUT
    assert host.port.senders == []
    assert host.sync_read(0, 2, 1, 9, 2)[0] == TIMEOUT
    assert host.port.senders == [1]
    patient = Host(servo("xm430_w350", 1), servo("xm430_w350", 2), waits_for_predecessor=False)
    patient.sync_read(0, 2, 9, 1, 2)
    assert patient.port.senders == [1, 2]


def test_bulk_read_of_two_models(host: Host) -> None:
    assert host.bulk_read((2, 580, 4), (1, 132, 4)) == (0, {2: 0, 1: 2048})
    assert host.bulk_read((2, 592, 2), (1, 146, 1), fast=True) == (0, {2: 240, 1: 35})


def test_fast_read_is_not_stuffed_and_checks_in_one_piece() -> None:
    """A present position with FF FF FD in it, read by the SDK's own fast read."""
    host = Host(servo("xm430_w350", 1), servo("xm430_w350", 2))
    assert host.write(1, 11, 1, 4) == 0
    assert host.write(1, 20, 4, -131073 - 2048) == 0
    result, found = host.sync_read(116, 20, 1, 2, fast=True)
    assert result == 0
    assert set(found) == {1, 2}
    assert b"\xff\xff\xfd\xff" in host.port.received
    _, plain = host.sync_read(116, 20, 1, 2)
    assert b"\xff\xff\xfd\xfd\xff" in host.port.received
    assert plain == found
    assert host.signed(1, 132, 4) == -131073


def test_an_mx_does_not_know_fast_reads() -> None:
    host = Host(servo("mx_64", 1))
    assert host.sync_read(132, 4, 1)[0] == 0
    assert host.sync_read(132, 4, 1, fast=True)[0] == TIMEOUT


def test_sync_and_bulk_write(host: Host) -> None:
    assert host.sync_write(9, 1, {1: 5, 2: 6}) == 0
    assert (host.read(1, 9, 1), host.read(2, 9, 1)) == (5, 6)
    assert host.bulk_write((1, 65, 1, 1), (2, 560, 4, 77)) == 0
    assert (host.read(1, 65, 1), host.read(2, 560, 4)) == (1, 77)


def test_indirect_addresses(host: Host) -> None:
    """Goal position and LED side by side, through pointers, as the manual's example has it."""
    for servo_id, first, data, goal_at, led in ((1, 168, 224, 116, 65), (2, 168, 634, 564, 513)):
        for number, target in enumerate([goal_at, goal_at + 1, goal_at + 2, goal_at + 3, led]):
            assert host.write(servo_id, first + 2 * number, 2, target) == 0
        packed = [*(1024).to_bytes(4, "little"), 1]
        assert host.sdk.writeTxRx(host.port, servo_id, data, 5, packed) == (0, 0)
        assert host.read(servo_id, goal_at, 4) == 1024
        assert host.read(servo_id, led, 1) == 1
        assert host.sdk.readTxRx(host.port, servo_id, data, 5) == (packed, 0, 0)
        assert host.write(servo_id, data + 1, 2, 1) == 5  # the middle of a register
        assert host.write(servo_id, first, 2, 6) == 4  # the EEPROM area cannot be pointed at
        assert host.write(servo_id, data + 9, 1, 200) == 0  # a data byte nobody points from
        assert host.read(servo_id, data + 9, 1) == 200


# Addresses on the bus


def test_secondary_id_writes_to_the_ram_of_all_and_nobody_answers() -> None:
    host = Host(*(servo("xm430_w350", i, secondary_id=100) for i in (1, 2, 3)))
    assert host.sdk.write1ByteTxRx(host.port, 100, 65, 1)[0] == TIMEOUT
    assert host.sync_read(65, 1, 1, 2, 3) == (0, {1: 1, 2: 1, 3: 1})
    assert host.sdk.write1ByteTxRx(host.port, 100, 9, 77)[0] == TIMEOUT
    assert host.read(1, 9, 1) == 0
    five = Host(*(servo("xm430_w350", i, secondary_id=2) for i in (1, 2)))
    assert five.write(2, 65, 1, 1) == 0  # id goes before secondary id: one answer, two LEDs
    assert five.port.senders == [2]
    assert five.sync_read(65, 1, 1, 2) == (0, {1: 1, 2: 1})


def test_two_servos_with_one_id_collide() -> None:
    host = Host(servo("xm430_w350", 1), servo("xl330_m288", 1))
    assert host.sdk.ping(host.port, 1)[1] == CORRUPT


def test_another_baud_rate_is_silence() -> None:
    host = Host(servo("xm430_w350", 1), servo("xm430_w350", 2, baud_rate=1))
    assert host.bus.baud == 1_000_000
    assert set(host.sdk.broadcastPing(host.port)[0]) == {1}
    host.bus.host_baud = 57600
    assert set(host.sdk.broadcastPing(host.port)[0]) == {2}
    assert host.write(2, 8, 1, 3) == 0  # answered at the old rate, then it is gone
    host.wait(0.01)
    assert host.sdk.ping(host.port, 2)[1] == TIMEOUT
    host.bus.host_baud = 1_000_000
    assert host.sdk.ping(host.port, 2)[1] == 0


def test_set_id(host: Host) -> None:
    assert host.write(1, 7, 1, 33) == 0
    assert host.sdk.ping(host.port, 1)[1] == TIMEOUT
    assert host.sdk.ping(host.port, 33) == (1020, 0, 0)
    assert host.write(33, 7, 1, 253) == 4


# Hardware errors, reboot, reset, backup


def test_voltage_error_alerts_and_drops_torque_only_if_masked() -> None:
    felt = Felt(SETTINGS)
    host = Host(servo("xm430_w350", 1, on=felt))
    assert host.write(1, 64, 1, 1) == 0
    felt.volts = 0.7  # 8.4 V, the limit is 9.5 V
    assert host.status(1, 70, 1) == (0, ALERT)
    felt.volts = 1.0
    assert host.status(1, 64, 1) == (0, ALERT)  # it stays
    data, _, _ = host.sdk.readTxRx(host.port, 1, 70, 1)
    assert data == [1]
    assert host.sdk.readTxRx(host.port, 1, 64, 1)[0] == [1]  # voltage is not in the mask 52
    assert host.sdk.syncReadTx(host.port, 70, 1, [1], 1, False) == 0
    assert host.port.received[8] == ALERT


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


def test_overload_takes_a_while() -> None:
    felt = Felt(SETTINGS)
    host = Host(servo("xm430_w350", 1, on=felt))
    felt.held = True
    assert host.write(1, 64, 1, 1) == 0
    host.wait(2 * OVERLOAD_S)
    assert host.status(1, 70, 1) == (0, 0)  # it stands where it shall: nothing to push
    assert host.write(1, 112, 4, 200) == 0
    assert host.write(1, 116, 4, 3000) == 0
    felt.limp(host.clock.now_s())  # held in fact, too
    host.wait(0.8 * OVERLOAD_S)
    assert host.status(1, 70, 1) == (0, 0)
    host.wait(0.8 * OVERLOAD_S)
    data, result, error = host.sdk.readTxRx(host.port, 1, 70, 1)
    assert (data, result, error) == ([32], 0, ALERT)
    assert host.sdk.readTxRx(host.port, 1, 64, 1)[0] == [0]


def test_errors_that_a_test_raises() -> None:
    one = servo("ph42_020_s300", 1)
    host = Host(one)
    one.raise_error(8)
    assert host.sdk.readTxRx(host.port, 1, 518, 1) == ([8], 0, ALERT)


def test_reboot_forgets_ram_and_is_deaf_for_a_while(host: Host) -> None:
    assert host.write(1, 9, 1, 7) == 0
    assert host.write(1, 65, 1, 1) == 0
    assert host.write(1, 64, 1, 1) == 0
    assert host.write(1, 98, 1, 100) == 0
    assert host.sdk.reboot(host.port, 1) == (0, 0)
    assert host.sdk.ping(host.port, 1)[1] == TIMEOUT
    host.wait(BOOT_S + 0.01)
    assert [host.read(1, a, 1) for a in (9, 65, 64, 98)] == [7, 0, 0, 0]


def test_power_off_is_silence() -> None:
    one = servo("xm430_w350", 1)
    host = Host(one)
    one.set_power(False, 0.0)
    assert host.sdk.ping(host.port, 1)[1] == TIMEOUT
    one.set_power(True, 0.0)
    host.wait(BOOT_S + 0.01)
    assert host.sdk.ping(host.port, 1)[1] == 0


def test_factory_reset_keeps_what_it_is_told_to() -> None:
    for option, servo_id, baud in ((0xFF, 1, 57600), (1, 5, 57600), (2, 5, 1_000_000)):
        host = Host(servo("xm430_w350", 5, temperature_limit=60))
        assert host.sdk.factoryReset(host.port, 5, option) == (0, 0)
        host.wait(BOOT_S + 0.01)
        host.bus.host_baud = baud
        assert host.sdk.ping(host.port, servo_id) == (1020, 0, 0)
        assert host.read(servo_id, 31, 1) == 80
    host = Host(servo("xm430_w350", 5))
    assert host.sdk.factoryReset(host.port, 5, 9) == (0, 1)
    host.sdk.factoryReset(host.port, 0xFE, 0xFF)  # refused to all at once
    assert host.sdk.ping(host.port, 5)[1] == 0


def test_backup_and_restore() -> None:
    host = Host(servo("xc330_t288", 1))
    key = (0x43, 0x54, 0x52, 0x4C)
    assert host.instruct(1, 0x20, 2, *key) == (0, 1)  # there is none
    assert host.write(1, 31, 1, 55) == 0
    assert host.write(1, 84, 2, 444) == 0
    assert host.write(1, 60, 1, 2) == 0  # restore the RAM area at the start
    assert host.write(1, 64, 1, 1) == 0
    assert host.instruct(1, 0x20, 1, *key) == (0, 1)  # torque is on
    assert host.write(1, 64, 1, 0) == 0
    assert host.instruct(1, 0x20, 1, *key) == (0, 0)
    assert host.read(1, 147, 1) == 1
    assert host.write(1, 31, 1, 66) == 0
    assert host.write(1, 84, 2, 1) == 0
    assert host.instruct(1, 0x20, 2, *key) == (0, 0)
    host.wait(BOOT_S + 0.01)
    assert (host.read(1, 31, 1), host.read(1, 84, 2)) == (55, 444)


# Bus watchdog


def test_watchdog_stops_the_servo_and_locks_its_goals() -> None:
    """The example of the manual: velocity control, 50 units, 2 s (here 200 ms) without an instruction."""
    turned = axis()
    host = Host(servo("xm430_w350", 1, on=turned))
    assert host.write(1, 11, 1, 1) == 0
    assert host.write(1, 64, 1, 1) == 0
    assert host.write(1, 104, 4, 50) == 0
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
    assert host.write(1, 104, 4, 50) == 0
    host.wait(0.1)
    assert host.read(1, 128, 4) == 50


def test_watchdog_is_fed_by_a_packet_to_anyone_and_sleeps_without_torque(host: Host) -> None:
    assert host.write(1, 98, 1, 5) == 0
    host.wait(1.0)
    assert host.read(1, 98, 1) == 5  # torque is off
    assert host.write(1, 64, 1, 1) == 0
    for _ in range(10):
        host.wait(0.09)
        host.sdk.ping(host.port, 200)
    assert host.read(1, 98, 1) == 5
    host.wait(0.11)
    assert host.read(1, 98, 1) == 255


def test_noise_does_not_feed_the_watchdog(host: Host) -> None:
    assert host.write(1, 64, 1, 1) == 0
    assert host.write(1, 98, 1, 5) == 0
    for _ in range(12):
        host.wait(0.01)
        host.bus.receive(b"\xff\xff\xfd\x00\x01\x03\x00\x01\x00\x00noise", host.clock.now_s())
    assert host.read(1, 98, 1) == 255


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


def test_time_based_profile_takes_the_time_it_says() -> None:
    host = Host(servo("xm430_w350", 1, drive_mode=4))
    goal(host, 3048, velocity=1000, acceleration=250)
    host.wait(0.5)
    assert host.signed(1, 132, 4) == pytest.approx(2548, abs=1)  # halfway at half time
    assert host.signed(1, 128, 4) == pytest.approx(1000 / 0.75 / 4096 * 60 / 0.229, abs=1)
    host.wait(0.485)
    assert host.read(1, 122, 1) == 1
    host.wait(0.02)
    assert host.read(1, 122, 1) == 0
    assert host.signed(1, 132, 4) == 3048


@pytest.mark.parametrize(
    ("velocity", "acceleration", "kind"), [(0, 0, 0), (50, 0, 1), (50, 1, 2), (50, 50, 3)]
)
def test_types_of_profile(velocity: int, acceleration: int, kind: int) -> None:
    host = Host(servo("xm430_w350", 1))
    goal(host, 2148, velocity, acceleration)
    host.wait(0.005)
    assert host.read(1, 123, 1) >> 4 == kind


def test_velocity_pwm_and_current_modes(host: Host) -> None:
    for mode, address, size, value, velocity in (
        (1, 104, 4, -80, -80),
        (16, 100, 2, 885, 200),
        (0, 102, 2, -1193, -200),
    ):
        assert host.write(1, 64, 1, 0) == 0
        assert host.write(1, 11, 1, mode) == 0
        assert host.write(1, 64, 1, 1) == 0
        assert host.write(1, address, size, value) == 0
        host.wait(0.5)
        assert host.signed(1, 128, 4) == velocity
        assert host.read(1, 122, 1) == 1
    assert host.signed(1, 126, 2) < 0


def test_current_based_position_needs_current(host: Host) -> None:
    assert host.write(1, 11, 1, 5) == 0
    assert host.write(1, 64, 1, 1) == 0
    assert host.write(1, 102, 2, 0) == 0
    assert host.write(1, 116, 4, 3000) == 0
    host.wait(1.0)
    assert host.signed(1, 132, 4) == 2048
    assert host.write(1, 102, 2, 300) == 0
    assert host.write(1, 116, 4, 9000) == 0
    host.wait(5.0)
    assert host.signed(1, 132, 4) == 9000


def test_reverse_mode_turns_the_other_way() -> None:
    turned = axis()
    host = Host(servo("xm430_w350", 1, drive_mode=1, on=turned))
    before = host.signed(1, 132, 4)
    goal(host, before + 500, velocity=100)
    host.wait(2.0)
    assert host.signed(1, 132, 4) == before + 500
    assert turned.angle_rad(host.clock.now_s()) == pytest.approx(-500 * math.tau / 4096)


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


def test_more_than_a_turn_is_forgotten_as_the_manual_says() -> None:
    host = Host(servo("xm430_w350", 1, operating_mode=4))
    goal(host, 2048 + 3 * 4096)
    host.wait(6.0)
    assert host.signed(1, 132, 4) == 2048 + 3 * 4096
    assert host.write(1, 64, 1, 0) == 0
    assert host.signed(1, 132, 4) == 2048 + 3 * 4096  # torque off: 4 bytes, still
    assert host.instruct(1, 0x10, 1, 0x44, 0x58, 0x4C, 0x22) == (0, 0)  # clear
    assert host.signed(1, 132, 4) == 2048
    goal(host, 2048 + 4096)
    assert host.instruct(1, 0x10, 1, 0x44, 0x58, 0x4C, 0x22) == (0, 1)  # not while it moves
    host.wait(6.0)
    assert host.write(1, 64, 1, 0) == 0
    assert host.write(1, 11, 1, 3) == 0  # position control: back to one turn
    assert host.signed(1, 132, 4) == 2048


def test_a_head_parked_across_the_end_of_the_turn() -> None:
    """Zero of the axis at count 100: a bit to the left of it the servo starts near 4095, the rollover."""
    for sign in (1, -1):
        parked = axis(start_rad=-sign * 200 * math.tau / 4096)
        mast = SimulatedServo(
            "xm430_w350",
            1,
            parked,
            zero_counts=100,
            sign=sign,
            settings={"baud_rate": 3, "operating_mode": 4},
        )
        host = Host(mast)
        assert host.signed(1, 132, 4) == 4096 - 100
        goal(host, 4096 + 150)
        host.wait(1.0)
        assert parked.angle_rad(host.clock.now_s()) == pytest.approx(sign * 50 * math.tau / 4096)
        assert host.signed(1, 132, 4) == 4096 + 150
        assert host.sdk.reboot(host.port, 1)[0] == 0
        host.wait(BOOT_S + 0.01)
        assert host.signed(1, 132, 4) == 150  # after a restart the same place has another count


def test_a_goal_without_torque_moves_nothing_and_torque_on_holds(host: Host) -> None:
    assert host.write(1, 116, 4, 100) == 0
    host.wait(0.5)
    assert host.signed(1, 132, 4) == 2048
    assert host.write(1, 64, 1, 1) == 0
    assert host.read(1, 116, 4) == 2048
    host.wait(0.5)
    assert host.signed(1, 132, 4) == 2048


def test_torque_on_by_goal_update() -> None:
    host = Host(servo("xm430_w350", 1, drive_mode=8))
    assert host.write(1, 116, 4, 2100) == 0
    assert host.read(1, 64, 1) == 1
    host.wait(1.0)
    assert host.signed(1, 132, 4) == 2100


def test_torque_off_lets_a_tilt_axis_fall() -> None:
    tilt = axis(falls_to_rad=-1.0, start_rad=0.3)
    host = Host(servo("xm430_w350", 1, on=tilt))
    assert host.write(1, 64, 1, 1) == 0
    host.wait(1.0)
    assert tilt.angle_rad(host.clock.now_s()) == pytest.approx(0.3)
    assert host.sdk.reboot(host.port, 1)[0] == 0
    host.wait(3.0)
    assert tilt.angle_rad(host.clock.now_s()) == pytest.approx(-1.0)


def test_the_cameras_ride_on_what_the_bytes_ordered() -> None:
    """Goal bytes, then the mechanical angle, which alone the renderer sees: half the gap behind the motor."""
    gap = math.radians(0.25)
    geared = WireAxis(type(SETTINGS)(**{**SETTINGS.__dict__, "backlash_rad": gap}))
    host = Host(servo("xm430_w350", 1, on=geared))
    for counts, side in ((2500, -1), (1500, 1)):
        goal(host, counts)
        host.wait(3.0)
        motor = (counts - 2048) * math.tau / 4096
        assert geared.mechanical_rad(host.clock.now_s()) == pytest.approx(motor + side * gap / 2)


def test_following_error_and_full_current_of_a_seized_axis() -> None:
    class Seized(Felt):
        def angle_rad(self, time_s: float) -> float:
            return 0.0

    host = Host(servo("xm430_w350", 1, on=Seized(SETTINGS)))
    goal(host, 3000, velocity=100)
    host.wait(2.0)
    assert host.read(1, 123, 1) & 0x09 == 0x08
    assert host.signed(1, 126, 2) == 1193
    assert host.signed(1, 140, 4) == 3000
    assert host.signed(1, 132, 4) == 2048


def test_startup_torque_on_holds_where_it_has_fallen_to() -> None:
    """Startup Configuration, bit 0: torque is on again when the servo has started, and not before."""
    tilt = axis(falls_to_rad=-1.0, start_rad=0.3)
    host = Host(servo("xm430_w350", 1, on=tilt, startup_configuration=1))
    assert host.read(1, 64, 1) == 1
    host.wait(0.5)
    assert tilt.angle_rad(host.clock.now_s()) == pytest.approx(0.3)
    assert host.sdk.reboot(host.port, 1)[0] == 0
    host.wait(2.0)
    assert host.read(1, 64, 1) == 1
    held = tilt.angle_rad(host.clock.now_s())
    assert -0.2 < held < 0.25
    host.wait(1.0)
    assert tilt.angle_rad(host.clock.now_s()) == held
    # Braking took it a little further than it was when the torque came on.
    assert host.read(1, 116, 4) == pytest.approx(host.read(1, 132, 4), abs=3)


def test_an_absurd_reading_does_not_lose_a_turn() -> None:
    class Absurd(Felt):
        def angle_rad(self, time_s: float) -> float:
            return 500.0 if self.held else super().angle_rad(time_s)

    wild = Absurd(SETTINGS)
    host = Host(servo("xm430_w350", 1, on=wild))
    wild.held = True
    assert host.signed(1, 132, 4) > 100_000
    assert host.write(1, 64, 1, 1) == 0
    wild.held = False
    assert host.signed(1, 132, 4) == 2048


def test_realtime_tick_counts_milliseconds(host: Host) -> None:
    first = host.read(1, 120, 2)
    host.wait(1.0)
    assert host.read(1, 120, 2) - first in (999, 1000, 1001)
    host.clock.advance(32.768)
    assert host.read(1, 120, 2) - first in (999, 1000, 1001)


def test_an_mx_28_has_a_load_and_no_current() -> None:
    host = Host(servo("mx_28", 1))
    assert host.status(1, 102, 2) == (0, 7)
    assert host.read(1, 126, 2) == 0
    assert [host.write(1, 11, 1, mode) for mode in (0, 5, 4, 1, 3)] == [4, 4, 0, 0, 0]

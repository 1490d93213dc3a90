"""The simulated line in memory, as its host sees it on a turned clock."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import pytest

from drivers.errors import LineLost
from drivers.faults import PAN_TILT, FaultPanel
from drivers.serial_line import ByteLine, OpenLine, SerialLine
from drivers.sim.wire.carrier import Reply
from drivers.sim.wire.memory_line import MemoryLine
from drivers.simulation_clock import SimulationClock
from hil_tests.left_behind import held

BAUD = 9600
BYTE_S = 10 / BAUD
NEVER_S = 3600.0


class Parrot:
    """Answers every line of text with the same line; tells when it was looked at."""

    def __init__(self) -> None:
        self.baud = BAUD
        self.heard = b""
        self.host_baud: int | None = None
        self.polled_s: list[float] = []

    def receive(self, data: bytes, time_s: float) -> Sequence[Reply]:
        self.heard += data
        *lines, self.heard = self.heard.split(b"\n")
        return [Reply(line + b"\n", delay_s=0.25) for line in lines]

    def poll(self, time_s: float) -> Sequence[Reply]:
        self.polled_s.append(time_s)
        return ()


@pytest.fixture
def clock() -> Iterator[SimulationClock]:
    clock, before = SimulationClock(start_s=10.0), held()
    with clock.at_work():
        yield clock
    assert held() <= before


def opened(line: MemoryLine, baud: int = BAUD) -> ByteLine:
    opens: OpenLine = line.open
    return opens(line.path, baud)


def text(host: ByteLine, wait_s: float = 1.0) -> bytes:
    """What comes until nothing came for a while."""
    found = b""
    while data := host.read(wait_s):
        found += data
    return found


def test_a_driver_opens_its_line_by_pyserial_unless_told_otherwise() -> None:
    opens: OpenLine = SerialLine
    with pytest.raises(LineLost, match="no such file"):
        opens("/dev/none", BAUD, device="pan")


def test_bytes_take_10_bits_each_way_and_the_devices_own_delay(clock: SimulationClock) -> None:
    with MemoryLine(Parrot(), clock) as line:
        host = opened(line)
        host.write(b"seven\n")
        assert host.read(NEVER_S) == b"seven\n"
        assert clock.now_s() == pytest.approx(10.0 + 12 * BYTE_S + 0.25, abs=1e-9)


def test_without_wire_time_only_the_devices_delay_passes(clock: SimulationClock) -> None:
    with MemoryLine(Parrot(), clock, wire_time=False) as line:
        host = opened(line, 115200)
        host.write(b"one\n")
        assert host.read(0.25 - 1e-6) == b""
        assert host.read(NEVER_S) == b"one\n", "and every rate is right"
        assert clock.now_s() == pytest.approx(10.25, abs=1e-9)


def test_a_read_ends_exactly_at_its_deadline_and_one_that_waits_for_nothing_at_once(
    clock: SimulationClock,
) -> None:
    with MemoryLine(Parrot(), clock) as line:
        host = opened(line)
        assert (host.read(0.0), clock.now_s()) == (b"", 10.0)
        assert (host.read(0.125), clock.now_s()) == (b"", 10.125)


def test_the_device_is_looked_at_every_5_ms_while_somebody_waits_and_never_else(
    clock: SimulationClock,
) -> None:
    device = Parrot()
    with MemoryLine(device, clock):
        clock.sleep(1.0)
        assert len(device.polled_s) == pytest.approx(200, abs=2)


def test_at_another_baud_rate_nothing_is_understood_either_way(clock: SimulationClock) -> None:
    device = Parrot()
    with MemoryLine(device, clock) as line:
        host = opened(line, 115200)
        host.write(b"one\n")
        assert text(host) == b""
        assert (device.heard, device.host_baud) == (b"", 115200), "framing errors only"
        host.close()
        host = opened(line)
        host.write(b"two\n")
        device.baud = 57600  # before it has heard: it answers at its own rate
        assert text(host) == b""
        device.baud = BAUD
        host.write(b"two\n")
        clock.sleep(0.1)
        device.baud = 57600
        assert text(host) == bytes(byte ^ 0xA5 for byte in b"two\n")


def test_one_host_at_a_time_and_another_name_is_another_line(clock: SimulationClock) -> None:
    with MemoryLine(Parrot(), clock) as line:
        first = opened(line)
        with pytest.raises(LineLost, match="held by another program"):
            opened(line)
        with pytest.raises(LineLost, match="no such file"):
            line.open("/dev/ttyUSB0", BAUD)
        first.close()
        first.close()
        for call in (lambda: first.read(0.0), lambda: first.write(b"x")):
            with pytest.raises(LineLost, match="closed"):
                call()
        second = opened(line)
        second.write(b"two\n")
        assert text(second) == b"two\n"


def test_a_cable_that_is_pulled_ends_a_read_and_the_line_is_opened_anew_after(
    clock: SimulationClock,
) -> None:
    with MemoryLine(Parrot(), clock) as line:
        host = opened(line)
        host.write(b"lost\n")

        def pull() -> None:
            clock.sleep(0.1)
            line.hang_up()

        clock.thread(pull, "pulls").start()
        with pytest.raises(LineLost, match="hung up"):
            host.read(NEVER_S)
        assert clock.now_s() == pytest.approx(10.1)
        with pytest.raises(LineLost, match="no such file"):
            opened(line)
        line.come_back()
        with pytest.raises(LineLost, match="hung up"):
            host.write(b"x")
        host = opened(line)
        assert text(host) == b"", "what was under way is lost"
        host.write(b"new\n")
        assert text(host) == b"new\n"


def test_faults_of_the_line_act_and_the_observer_sees_both_sides(clock: SimulationClock) -> None:
    panel, seen = FaultPanel(clock.now_s, ()), []
    with MemoryLine(
        Parrot(), clock, panel, wire_time=False, observer=lambda *piece: seen.append(piece)
    ) as line:
        host = opened(line)
        panel.set(PAN_TILT, "late", delay_s=2.0)
        host.write(b"one\ntwo\n")
        assert host.read(NEVER_S) == b"two\n"
        assert host.read(NEVER_S) == b"one\n"
        assert seen == [
            ("host", b"one\ntwo\n", 10.0), ("device", b"two\n", 10.5), ("device", b"one\n", 12.25)
        ]  # fmt: skip
        panel.set(PAN_TILT, "hang_up")
        with pytest.raises(LineLost):
            host.read(NEVER_S)
        assert clock.now_s() <= 12.25 + 0.005, "it is looked at every 5 ms"
        panel.clear()
        clock.sleep(0.005)
        host = opened(line)
        host.write(b"back\n")
        assert text(host) == b"back\n"


def test_what_nobody_reads_is_lost_beyond_4096_bytes(clock: SimulationClock) -> None:
    with MemoryLine(Parrot(), clock, wire_time=False) as line:
        host = opened(line)
        host.write(b"x" * 5000 + b"\n")
        clock.sleep(1.0)
        assert host.read(0.0) == b"x" * 4096


def test_on_the_machines_clock_it_is_a_line_too() -> None:
    from drivers.clock import SystemClock

    with MemoryLine(Parrot(), SystemClock()) as line:
        host = opened(line)
        host.write(b"real\n")
        found = b""
        while len(found) < 5:
            found += host.read(60.0)
        assert found == b"real\n"

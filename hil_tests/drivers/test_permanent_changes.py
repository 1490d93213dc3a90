"""What the drivers change for good is what docs/how-to/hardware.md lists, as simulated devices see it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.dynamixel import workshop
from drivers.dynamixel.link import Link
from drivers.faults import FaultPanel
from drivers.flir_ptu import workshop as ptu_workshop
from drivers.flir_ptu.head import open_head as open_ptu
from drivers.sim.axis import AxisSettings, WireAxis
from drivers.sim.wire.dynamixel_servo import SimulatedServo
from drivers.sim.wire.line import MemoryLine
from drivers.sim.wire.ptu import SimulatedPtu
from hil_tests.drivers.dynamixel.dynamixel_rig import X, rig
from hil_tests.drivers.turned import turned


@pytest.fixture(scope="module")
def listed(repository: Path) -> dict[str, set[str]]:
    """Register names by what writes them, from the page's table."""
    page = (repository / "docs" / "how-to" / "hardware.md").read_text(encoding="utf-8")
    part = page.split("\n## Permanent changes\n", 1)[1].split("\n## ", 1)[0]
    found: dict[str, set[str]] = {}
    for line in part.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| `"):
            names = re.findall(r"`([a-z_]+)`", cells[0])
            for who in cells[2].split(", "):
                found.setdefault(who.strip("`"), set()).update(names)
    return found


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> Iterator[set[str]]:
    """Permanent registers that were written to any simulated servo, by the simulator's own table."""
    names: set[str] = set()
    plain = SimulatedServo.write

    def watching(servo: SimulatedServo, address: int, data: bytes, time_s: float, **how: bool) -> None:
        written = range(address, min(address + len(data), servo.model.ram_from))
        names.update(one.name for one in servo.model.registers if one.address in written)
        plain(servo, address, data, time_s, **how)

    monkeypatch.setattr(SimulatedServo, "write", watching)
    yield names


@pytest.mark.parametrize("model", [X, "mx_28", "ph42_020_s300"])
def test_a_dynamixel_head_writes_only_the_listed_eeprom_registers(
    model: str, written: set[str], listed: dict[str, set[str]]
) -> None:
    strange = {"operating_mode": 1, "drive_mode": 4, "return_delay_time": 250}
    with rig(models=(model, X), pan=strange) as it:
        current = {} if model == "mx_28" else {"current_limit_A": 0.5}
        pan = {**it.options["pan"], "on_hardware_error": "reboot", "at_close": "torque_off", **current}
        slow = {"acceleration_rad_per_s2": 9.0, "watchdog_s": 0.3} if model.startswith("ph") else {}
        head = it.open(pan=pan, **slow)
        try:
            assert {"operating_mode", "drive_mode", "return_delay_time"} <= written
            head.move(0.2, 0.1)
            it.settled(head)
            head.stop()
            it.servos[0].raise_error(32)
            it.until(lambda: it.servos[0].table["hardware_error_status"] == 0, "the reboot")
        finally:
            head.close()
    assert written <= listed["run"], written - listed["run"]
    if model == X:
        assert written == listed["run"], listed["run"] - written


def test_what_is_right_already_is_not_written_again(written: set[str]) -> None:
    with rig() as it:
        it.open().close()
        written.clear()
        it.open().close()
    assert written == set()


def test_the_commands_for_a_servo_write_only_what_is_listed(
    written: set[str], listed: dict[str, set[str]]
) -> None:
    with rig() as it:
        link = Link(it.line.path, 1_000_000, clock=it.clock, open_line=it.host)
        try:
            workshop.facts(link, 1)
            assert written == set()
            workshop.set_id(link, 1, 7, 57_600)
        finally:
            link.close()
    assert written == listed["mastctl rig servo set-id"]


def test_a_ptu_is_never_told_to_save() -> None:
    with turned() as it:
        axis = AxisSettings(0.001, 0.0, -2.7, 2.7, 1.0, 4.0)
        tilt = AxisSettings(0.001, 0.0, -1.3, 0.5, 1.0, 4.0)
        panel = FaultPanel(it.now_s, ())
        axes = [
            WireAxis(axis, panel, number=0, time_s=it.now_s()),
            WireAxis(tilt, panel, number=1, time_s=it.now_s()),
        ]
        unit = SimulatedPtu("d46_70", *axes)
        with MemoryLine(unit, it.clock, panel, wire_time=False) as line:
            ends = {"pan": {"limits_rad": [-1.0, 1.0], "sign": -1}, "tilt": {"limits_rad": [-0.5, 0.3]}}
            options = {"port": line.path, "speed_rad_per_s": 0.8, "acceleration_rad_per_s2": 2.0, **ends}
            head = open_ptu(options, it.clock, line.open)
            try:
                head.move(0.1, 0.1)
                it.settled(head)
                head.stop()
            finally:
                head.close()
            assert unit.eeprom_writes == 0
            ptu_workshop.facts(line.path, 9600, it.clock, line.open)
            assert unit.eeprom_writes == 0

"""The driver's servo table, of the SDK's files, against the simulator's, written from the manual."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.dynamixel import models as ours
from drivers.sim.wire import dynamixel_models as theirs
from drivers.sim.wire.dynamixel_registers import BAUD_RATES

NAMES = {
    "firmware": "firmware_version",
    "baud": "baud_rate",
    "return_delay": "return_delay_time",
    "hardware_error": "hardware_error_status",
    "present_voltage": "present_input_voltage",
}
LOAD_ONLY = {"present_current": "present_load"}
WITHOUT_CURRENT = {"current_limit", "goal_current"}


def test_a_model() -> None:
    for name in ours.MODELS:
        driver, simulator = ours.MODELS[name], theirs.model_named(name)
        assert driver.number == simulator.number, name
        assert driver.counts_per_turn == simulator.counts_per_turn, name
        assert driver.centre_count == simulator.zero_counts, name
        assert driver.velocity_unit_rad_per_s == pytest.approx(simulator.velocity_unit_rad_per_s), name
        assert driver.acceleration_unit_rad_per_s2 == pytest.approx(simulator.acceleration_unit_rad_per_s2), (
            name
        )
        assert simulator.firmware >= driver.watchdog_firmware, name
        limits = [simulator.by_name[f"{end}_position_limit"] for end in ("min", "max")]
        assert {(limit.low, limit.high) for limit in limits} == {(driver.low_count, driver.high_count)}, name
        if driver.current_unit_A is None:
            assert "present_current" not in simulator.by_name, name
        else:
            assert driver.current_unit_A == simulator.current_unit_a, name
            assert driver.most_current_counts == simulator.by_name["current_limit"].high, name


def test_its_registers() -> None:
    for name in ours.MODELS:
        driver, simulator = ours.MODELS[name], theirs.model_named(name)
        names = NAMES if driver.current_unit_A is not None else NAMES | LOAD_ONLY
        known = ours.MODELS["XM430-W350"].registers.keys()
        assert known - driver.registers.keys() == (WITHOUT_CURRENT if names is not NAMES else set()), name
        for register in driver.registers.values():
            other = simulator.by_name[names.get(register.name, register.name)]
            assert (register.address, register.size) == (other.address, other.size), register.name
            assert register.permanent == (other.address < simulator.ram_from), register.name
            if other.low < 0:
                assert register.signed, register.name


def test_what_is_read_for_a_register_has_no_gaps_that_a_servo_refuses() -> None:
    for name in ours.MODELS:
        driver, simulator = ours.MODELS[name], theirs.model_named(name)
        for register in driver.registers.values():
            first, length = register.window
            assert first <= register.address, register.name
            assert register.address + register.size <= first + length, register.name
            assert all(at in simulator.by_byte for at in range(first, first + length)), register.name


@pytest.mark.parametrize("name", ["XM430-W350", "PH42-020-S300"])
def test_what_a_head_is_made_ready_by_can_be_told_apart_by_its_length(name: str) -> None:
    deciding = (
        "secondary_id", "operating_mode", "drive_mode", "return_delay", "homing_offset", "current_limit",
        "min_position_limit", "max_position_limit", "torque_enable", "bus_watchdog", "hardware_error",
        "status_return_level", "temperature_limit",
    )  # fmt: skip
    windows = {ours.MODELS[name].registers[register].window for register in deciding}
    assert len({length for _, length in windows}) == len(windows)


def test_the_page_of_the_simulator_names_every_model(repository: Path) -> None:
    text = (repository / "docs" / "reference" / "dynamixel-simulator.md").read_text(encoding="utf-8")
    cell = next(line for line in text.splitlines() if line.startswith("| models | ")).split("|")[2]
    told = set()
    for group in cell.replace("(2.0)", "").split(","):
        first, *others = group.strip().split("/")
        told |= {first} | {f"{first.rpartition('-')[0]}-{other}" for other in others}
    plain = {name.lower().replace("-", "_") for name in told}
    assert len(plain) == len(theirs.MODELS)
    assert [name for name in theirs.MODELS if not any(name.startswith(one) for one in plain)] == []


def test_every_simulated_model_is_one_of_the_drivers() -> None:
    assert {m.number for m in theirs.MODELS.values()} == set(ours.MODELS_BY_NUMBER)


def test_baud_rates() -> None:
    assert tuple(ours.BAUD_RATES.values()) == BAUD_RATES

"""Dynamixel's codes: the driver's and the simulator's, each against what the maker's own pages and SDK say.

The values here are typed from the ROBOTIS e-manual (github.com/ROBOTIS-GIT/emanual), not taken from either.
"""

from __future__ import annotations

import math
from importlib.util import find_spec
from pathlib import Path

import pytest

from drivers.dynamixel import models as driver
from drivers.dynamixel import packets
from drivers.sim.wire import dynamixel_models, dynamixel_servo

# _includes/en/dxl/control_table_baudrate_2.md (X and MX: 0 to 7, XL330 and XC330: 0 to 6) and
# _includes/en/dxl/p/control_table_8_baud_rate.md (P: 0 to 9).
BAUD_OF_CODE = {
    0: 9600, 1: 57_600, 2: 115_200, 3: 1_000_000, 4: 2_000_000, 5: 3_000_000, 6: 4_000_000, 7: 4_500_000,
    8: 6_000_000, 9: 10_500_000,
}  # fmt: skip
HIGHEST_CODE = {"xl330_m288": 6, "xc330_t181": 6, "xm430_w350": 7, "mx_64": 7, "ph54_200_s500": 9}

# Hardware Error Status (70; P: 518), Shutdown's table: control_table_48_shutdown_pro.md.
HARDWARE_ERRORS = {
    0: "input voltage", 1: "hall sensor", 2: "overheating", 3: "encoder", 4: "electrical shock",
    5: "overload",
}  # fmt: skip

# Operating Mode (11).
OPERATING_MODES = {
    0: "current", 1: "velocity", 3: "position", 4: "extended position", 5: "current-based position",
    16: "PWM",
}  # fmt: skip

# Protocol 2.0, the error field: Result Fail, Instruction, CRC, Data Range, Data Length, Data Limit, Access.
ERRORS = {
    1: "RESULT_FAIL", 2: "INSTRUCTION_ERROR", 3: "CRC_ERROR", 4: "DATA_RANGE", 5: "DATA_LENGTH",
    6: "DATA_LIMIT", 7: "ACCESS",
}  # fmt: skip

# Current Limit (38), unit in mA and highest value, of the pages docs/en/dxl/x/xc330-m288.md and so on.
CURRENT_LIMITS = {
    "XC330-M288-T": (1.0, 2352), "XH540-V150": (2.69, 1188), "XH430-V350": (1.34, 689),
    "PH42-020-S300": (1.0, 4500),
}  # fmt: skip


def test_both_have_the_makers_codes_of_baud_rates() -> None:
    assert dict(driver.BAUD_RATES) == BAUD_OF_CODE
    assert dict(enumerate(dynamixel_models.BAUD_RATES)) == BAUD_OF_CODE
    for model, highest in HIGHEST_CODE.items():
        assert dynamixel_models.model_named(model).by_name["baud_rate"].high == highest, model


def test_both_have_the_makers_hardware_error_bits() -> None:
    assert set(driver.HARDWARE_ERRORS) == {1 << bit for bit in HARDWARE_ERRORS}
    for bit, word in HARDWARE_ERRORS.items():
        assert word in driver.HARDWARE_ERRORS[1 << bit], bit
    simulated = (
        dynamixel_servo.VOLTAGE, dynamixel_servo.HALL, dynamixel_servo.HEAT, dynamixel_servo.ENCODER,
        dynamixel_servo.SHOCK, dynamixel_servo.OVERLOAD,
    )  # fmt: skip
    assert simulated == tuple(1 << bit for bit in HARDWARE_ERRORS)


def test_both_have_the_makers_operating_modes_and_errors() -> None:
    assert dict(driver.OPERATING_MODES) == OPERATING_MODES
    assert [OPERATING_MODES[one] for one in dynamixel_models.MODES] == ["position", "extended position"]
    assert set(packets.REFUSALS) == ERRORS.keys()
    # 1 is of instructions that are not simulated
    assert all(getattr(dynamixel_models, name) == error for error, name in ERRORS.items() if error > 1)


def test_every_model_number_is_that_of_the_installed_sdk() -> None:
    found = find_spec("dynamixel_easy_sdk")
    assert found is not None and found.submodule_search_locations
    index = Path(found.submodule_search_locations[0]) / "control_table" / "dynamixel.model"
    theirs = {
        int(n): name.removesuffix(".model") for n, name in map(str.split, index.read_text().splitlines()[1:])
    }
    for number, model in driver.MODELS_BY_NUMBER.items():
        assert theirs[number] == model.name.lower().replace("-", "_").removesuffix("_t"), number
    for simulated in dynamixel_models.MODELS.values():
        assert theirs[simulated.number] == simulated.name


@pytest.mark.parametrize("name", CURRENT_LIMITS)
def test_both_have_the_makers_units_of_current(name: str) -> None:
    unit_mA, highest = CURRENT_LIMITS[name]
    ours, theirs = driver.MODELS[name], dynamixel_models.model_named(name)
    assert ours.current_unit_A == pytest.approx(unit_mA / 1000) == theirs.current_unit_a
    assert (ours.most_current_counts, theirs.by_name["current_limit"].high) == (highest, highest)


@pytest.mark.parametrize(
    ("name", "counts_per_turn", "rpm", "rev_per_min2"),
    [("XM430-W350", 4096, 0.229, 214.577), ("PH42-020-S300", 607_500, 0.01, 1.0)],
)
def test_both_count_as_the_maker_does(
    name: str, counts_per_turn: int, rpm: float, rev_per_min2: float
) -> None:
    for model in (driver.MODELS[name], dynamixel_models.model_named(name)):
        assert round(math.tau / model.count_rad) == counts_per_turn
        assert model.velocity_unit_rad_per_s == pytest.approx(rpm * math.tau / 60)
        assert model.acceleration_unit_rad_per_s2 == pytest.approx(rev_per_min2 * math.tau / 3600)

"""Feetech's codes: the driver's and the simulator's, each against what the maker's own files say.

The values here are typed from the maker's SDK and memory tables, not taken from either of the two.
"""

from __future__ import annotations

import math

import pytest

from drivers.feetech import servos as driver
from drivers.sim.wire import feetech_servo

# SMS_STS.h of 2021-12-08 and 2025-02-26 (SMS_STS_1M 0 ... SMS_STS_38400 7), and address 6 of the memory
# tables of STS servos.
BAUD_OF_CODE = {
    0: 1_000_000, 1: 500_000, 2: 250_000, 3: 128_000, 4: 115_200, 5: 76_800, 6: 57_600, 7: 38_400,
}  # fmt: skip

# scservo_sdk/protocol_packet_handler.py: ERRBIT_VOLTAGE 1, ANGLE 2, OVERHEAT 4, OVERELE 8, OVERLOAD 32.
STATUS_BITS = {1: "voltage", 2: "angle", 4: "heat", 8: "current", 32: "overload"}

# lerobot, src/lerobot/motors/feetech/tables.py, MODEL_NUMBER_TABLE; the maker publishes no such list.
MODEL_NUMBERS = {"sts3215": 777, "sts3250": 2825, "sm8512bl": 11272}

# SMS_STS.h: SMS_STS_TORQUE_ENABLE 40 and so on; the driver's name, the simulator's, the address.
ADDRESSES = [
    ("model_number", "model", 3), ("id", "id", 5), ("baud", "baud", 6), ("min_angle_limit", "min_angle", 9),
    ("max_angle_limit", "max_angle", 11), ("torque_enable", "torque_enable", 40),
    ("goal_position", "goal_position", 42), ("goal_time", "goal_time", 44), ("goal_speed", "goal_speed", 46),
    ("present_position", "present_position", 56), ("present_velocity", "present_speed", 58),
    ("present_load", "present_load", 60), ("present_voltage", "present_voltage", 62),
    ("present_temperature", "present_temperature", 63), ("moving", "moving", 66),
    ("offset", "offset", 31), ("operating_mode", "mode", 33), ("acceleration", "acceleration", 41),
    ("lock", "lock", 55), ("present_current", "present_current", 69),
]  # fmt: skip


def test_both_have_the_makers_codes_of_baud_rates() -> None:
    assert dict(enumerate(driver.BAUD_RATES)) == BAUD_OF_CODE
    assert dict(enumerate(feetech_servo.BAUDS)) == BAUD_OF_CODE


def test_both_have_the_makers_status_bits() -> None:
    assert set(driver.STATUS_FAULTS) == set(STATUS_BITS)
    for bit, word in STATUS_BITS.items():
        (fault,) = driver.status_faults(bit)
        assert word in fault, bit
    assert STATUS_BITS == {
        feetech_servo.VOLTAGE: "voltage", feetech_servo.SENSOR: "angle", feetech_servo.HEAT: "heat",
        feetech_servo.CURRENT: "current", feetech_servo.OVERLOAD: "overload",
    }  # fmt: skip


def test_both_have_the_known_model_numbers() -> None:
    named = {model.name.lower(): number for number, model in driver.MODELS_BY_NUMBER.items()}
    assert named == MODEL_NUMBERS
    assert {name: model.number for name, model in feetech_servo.MODELS.items()} == MODEL_NUMBERS


def test_both_have_the_makers_addresses() -> None:
    registers, cells = driver.REGISTERS, feetech_servo.model_named("STS3215").by_name
    for ours, theirs, address in ADDRESSES:
        assert (registers[ours].address, cells[theirs].address) == (address, address), ours


def test_both_count_as_the_maker_does() -> None:
    # memory tables: 0.087 degrees a step, a current of 6.5 mA, an acceleration of 100 steps/s2
    ours, theirs = driver.MODELS["STS3215"], feetech_servo.model_named("STS3215")
    count_rad = math.radians(360) / 4096
    assert ours.count_rad == pytest.approx(count_rad) and theirs.count_rad == pytest.approx(count_rad)
    assert driver.MODELS["STS3215"].current_unit_A == 0.0065
    assert driver.MODELS["STS3215"].acceleration_unit_rad_per_s2 == pytest.approx(100 * math.tau / 4096)
    assert feetech_servo.STEP_ACCELERATION == 100

"""When a device that is away is tried again, how often servos are rebooted, what counts as a number."""

from __future__ import annotations

import math

import pytest

from drivers.absent import Absence
from drivers.dynamixel.servo import Reboots
from drivers.errors import BadOptions, LineLost
from drivers.flir_ptu.axis import options_from


def test_each_failed_try_waits_longer_until_the_device_is_back() -> None:
    absence, waits_s = Absence(), []
    for _ in range(7):
        absence.note(LineLost("port is gone", device="head", detail={"port": "x"}), 100.0)
        waits_s.append(round(absence.again_s - 100.0, 6))
    assert waits_s == [0.1, 0.2, 0.4, 0.8, 1.6, 2.0, 2.0]
    with pytest.raises(LineLost, match=r"^head: port is gone$") as raised:
        absence.check()
    assert raised.value is not absence.error, "an exception grows with every raise"
    assert raised.value.device == "head" and raised.value.detail == {"port": "x"}
    absence.end()
    absence.check()
    absence.note(LineLost("again"), 200.0)
    assert absence.again_s == pytest.approx(200.1)


def test_servos_are_rebooted_three_times_in_ten_minutes_and_no_more() -> None:
    reboots = Reboots()

    def reboot(now_s: float) -> bool:
        if left := reboots.left(now_s):
            reboots.note(now_s)
        return bool(left)

    assert [reboot(now_s) for now_s in (0.0, 1.0, 2.0, 3.0, 599.0)] == [True, True, True, False, False]
    assert reboot(600.5) and not reboot(600.6)


@pytest.mark.parametrize("value", [math.nan, math.inf, 10**400, -(10**400), True, "1", None, [1.0]])
def test_what_is_no_finite_number_is_refused_in_words(value: object) -> None:
    ends = {"limits_rad": [-0.1, 0.1]}
    with pytest.raises(BadOptions, match=r"options\.pan\.approach_rad: .* where a number.* is expected"):
        options_from({"port": "/dev/x", "pan": {**ends, "approach_rad": value}, "tilt": ends})

"""The contract suite on a real head: ``pytest hil_tests/bench --hardware FILE``.

FILE is a configuration with narrow limits and a low speed; the head moves over all of them
(docs/hardware.md). Each test ends with a look at the device's own error registers. What a head of any driver
owes the service is asked of all; that goals go to whole counts and bad speeds are refused inside the driver,
of this repository's only.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from drivers.errors import BadReply, DriverError, NoReply
from drivers.open_hardware import HEADS
from hil_tests.bench.hardware_rig import CHOSEN, error_registers, hardware_rig
from hil_tests.drivers.test_head_contract import (  # noqa: F401  collected here a second time
    PATIENCE_S,
    settled,
    test_a_move_returns_at_once_and_ends_at_the_nearest_count,
    test_a_new_goal_replaces_the_old_one,
    test_a_reading_is_measured_now_and_healthy,
    test_calls_from_many_threads_at_once_are_all_answered,
    test_no_axis_goes_faster_than_asked_or_than_its_own_bound,
    test_stop_brakes_and_holds,
    test_under_way_every_reading_is_true_and_times_go_forward,
)
from hil_tests.drivers.test_head_contract import (
    test_goals_halfway_between_counts_go_to_either_never_further as goals_halfway_between_counts,
)
from mastctl.config import load_config
from mastctl.devices.devices import MOVE_TIMEOUT_S, READ_TIMEOUT_S, STOP_TIMEOUT_S
from tools.campaigns.servo_rigs import LIMITS_RAD, Rig

if CHOSEN is None:
    pytest.skip("moves a real head; name its configuration with --hardware FILE", allow_module_level=True)


@pytest.fixture
def rig() -> Iterator[Rig]:
    """The real head, sent to the suite's zero before each test."""
    assert CHOSEN is not None
    settings = load_config(CHOSEN).hardware.pan_tilt
    with hardware_rig(Path(CHOSEN)) as made:
        made.head.move(0.0, 0.0)
        settled(made)
        yield made
        assert tuple(made.head.read().faults) == ()
        made.head.stop()
    assert error_registers(settings) == {}, "the device has noted a hardware error"


def of_this_repository() -> bool:
    """Whether the head's driver is one of this repository's."""
    assert CHOSEN is not None
    return load_config(CHOSEN).hardware.pan_tilt.driver in HEADS


@pytest.mark.parametrize("end", [0, 1])
def test_goals_at_the_limits_of_the_configuration_are_reached(rig: Rig, end: int) -> None:
    """Goals beyond them never reach a driver: the service refuses them."""
    goal = (LIMITS_RAD[0][end], LIMITS_RAD[1][end])
    rig.head.move(*goal)
    reading = settled(rig)
    assert (reading.pan_rad, reading.tilt_rad) == pytest.approx(goal, abs=rig.count_rad + rig.settle_rad)


def test_goals_halfway_between_counts_go_to_either_never_further(rig: Rig) -> None:
    if not of_this_repository():
        pytest.skip("the count of a head from outside is not known")
    goals_halfway_between_counts(rig)


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan])
def test_a_speed_that_is_none_is_refused_and_nothing_moves(rig: Rig, speed: float) -> None:
    if not of_this_repository():
        pytest.skip("the service passes no such speed on, and a driver from outside need not check it")
    before = settled(rig)
    with pytest.raises(DriverError, match="not a positive number"):
        rig.head.move(0.1, 0.1, speed)
    time.sleep(0.1)
    after = rig.head.read()
    assert not after.moving
    there = pytest.approx((before.pan_rad, before.tilt_rad), abs=rig.count_rad)
    assert (after.pan_rad, after.tilt_rad) == there


def test_stop_comes_beside_a_read_under_way_and_several_times_at_once(rig: Rig) -> None:
    """The service sends a stop from another thread when the head's own is busy, and may send several."""
    rig.head.move(0.9, 0.3)
    errors: list[BaseException] = []

    def work(call: Callable[[], object], times: int) -> None:
        try:
            for _ in range(times):
                call()
        except BaseException as error:
            errors.append(error)

    def read() -> None:
        try:
            rig.head.read()
        except (NoReply, BadReply):  # a stop that cuts in may cost an answer: the service asks once more
            rig.head.read()

    calls = [(read, 8), (rig.head.stop, 2), (rig.head.stop, 2), (read, 8)]
    threads = [threading.Thread(target=work, args=call) for call in calls]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE_S)
        assert not thread.is_alive()
    assert not errors
    assert settled(rig).pan_rad < 0.85


def test_every_call_ends_within_the_services_deadlines(rig: Rig) -> None:
    """A head that needs nearly all of a deadline fails on a busy machine; so half of it is asked for here."""
    for call, deadline_s in (
        (rig.head.read, READ_TIMEOUT_S),
        (lambda: rig.head.move(0.2, -0.1), MOVE_TIMEOUT_S),
        (rig.head.read, READ_TIMEOUT_S),
        (rig.head.stop, STOP_TIMEOUT_S),
    ):
        took_s = []
        for _ in range(3):
            began_s = time.monotonic()
            call()
            took_s.append(time.monotonic() - began_s)
        assert min(took_s) < deadline_s / 2

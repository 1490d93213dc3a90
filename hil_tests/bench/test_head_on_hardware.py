"""The contract suite on a real head: ``pytest hil_tests/bench --hardware FILE``.

FILE is a configuration with narrow limits and a low speed; the head moves over all of them
(docs/hardware.md). Each test ends with a look at the device's own error registers.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from hil_tests.bench.hardware_rig import CHOSEN, error_registers, hardware_rig
from hil_tests.drivers.test_head_contract import (  # noqa: F401  collected here a second time
    settled,
    test_a_move_returns_at_once_and_ends_at_the_nearest_count,
    test_a_new_goal_replaces_the_old_one,
    test_a_reading_is_measured_now_and_healthy,
    test_a_speed_that_is_none_is_refused,
    test_calls_from_many_threads_at_once_are_all_answered,
    test_goals_at_the_limits_are_taken_and_those_beyond_refused,
    test_goals_halfway_between_counts_go_to_either_never_further,
    test_no_axis_goes_faster_than_asked_or_than_its_own_bound,
    test_stop_brakes_and_holds,
    test_under_way_every_reading_is_true_and_times_go_forward,
)
from mastctl.config import load_config
from tools.servo_rigs import Rig

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

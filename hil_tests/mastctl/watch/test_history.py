"""What is kept of the last hours: enough to draw a motion where it was, and no more than a bound."""

from __future__ import annotations

import pytest

from drivers.clock import SystemClock
from hil_tests.waiting import until
from mastctl.control.publisher import Publisher
from mastctl.control.standing import StandingFault
from mastctl.devices.joint_history import HeadReading
from mastctl.watch import history as history_module
from mastctl.watch.history import History


def reading(time_s: float, pan_rad: float) -> HeadReading:
    return HeadReading(pan_rad, 0.0, False, time_s, (), true_rad=(pan_rad, 0.0))


def test_a_motion_is_kept_where_it_was_and_rest_costs_next_to_nothing() -> None:
    publisher = Publisher()
    kept = History(publisher, lambda: {"pan": 31.5}, SystemClock())
    for k in range(1000):  # at rest, five readings a second; then one that moves, and rest again
        publisher.publish(
            "joints", "pan_tilt", reading(0.2 * k, 0.0 if k < 500 else min(0.5, 0.01 * (k - 500)))
        )
    publisher.publish("fault", "x", ())
    until(
        lambda: len(kept.told()["age_s"]) and kept._before is not None and kept._before.time_s > 199.7,
        "all is heard",
    )
    told = kept.told()
    kept.close()
    times = [one.time_s for one in kept._samples]
    assert 100.0 in times, "until then it stood"
    assert len(times) < 20 and told["pan_rad"][-1] == 0.5, "the newest reading is told, kept or not"
    assert told["temperatures_c"] == {"pan": [31.5] * len(told["age_s"])}


def test_a_long_motion_is_kept_for_as_long_as_is_said() -> None:
    publisher = Publisher()
    kept = History(publisher, dict, SystemClock())
    for k in range(1001):  # 200 s
        publisher.publish("joints", "pan_tilt", reading(0.2 * k, 0.001 * k))
    until(lambda: kept._before is not None and kept._before.time_s == 200.0, "all is heard")
    kept.close()
    assert len(kept._samples) == pytest.approx(200.0 / history_module.APART_S, abs=2)


def test_faults_come_and_go_once_and_the_oldest_events_give_way() -> None:
    publisher = Publisher()
    kept = History(publisher, dict, SystemClock())
    fault = StandingFault("head", "hot", "the head is hot", 0.0, "it is cold")
    for faults in ((fault,), (fault,), ()):
        publisher.publish("fault", "head", faults)
    until(lambda: len(kept.told()["events"]) == 2, "both are heard")
    assert [one["words"] for one in kept.told()["events"]] == [
        "head: the head is hot",
        "head: nothing is wrong any more",
    ]
    for number in range(2 * history_module.EVENTS):
        record = {
            "number": number,
            "who": "Ana",
            "command": "lease.renew" if number % 2 else "point",
            "result": "ok",
        }
        publisher.publish("command", str(number), record)
    publisher.publish("command", "end", {"ended": "x", "state": "failed", "message": "it is dark"})
    until(lambda: kept.told()["events"][-1]["words"] == "x: failed: it is dark", "the last is heard")
    events = kept.told()["events"]
    kept.close()
    assert len(events) == history_module.EVENTS
    assert {one["words"] for one in events[:-1]} == {"Ana: point"}, "what comes again and again is left out"

"""What Prometheus reads: parsed by its own library, from news that the test publishes."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from drivers.interfaces import Reading
from hil_tests.mastctl.service_fakes import FakePointing, FakeResult
from hil_tests.waiting import NET_S, until
from mastctl.control.publisher import Publisher
from mastctl.control.records import Operation
from mastctl.watch.metrics import Metrics

STATUS: dict[str, Any] = {
    "state": "ready",
    "version": "1.2.3",
    "hardware": "simulated",
    "uptime_s": 12.5,
    "mast": {"file": 'ma"st\\.yaml', "digest": "abc", "name": "little"},
    "joints": {"pan_rad": 0.25, "tilt_rad": -0.125, "age_s": 0.02},
    "cameras": {"navcam_left": {"age_s": 0.5}, "navcam_right": {"age_s": None}},
    "faults": [
        {"device": "navcam_right", "code": "no_reply"},
        {"device": "navcam_right", "code": "no_reply"},
    ],
    "control": {"holder": "a", "kind": "lease", "for_s": 4.0},
}

DONE = FakeResult((6.0, 1.0, 0.0), 6.2, (FakePointing((0.3, -0.1), (0.1, 0.1), "navcam_left-1"),))

Found = dict[tuple[str, tuple[tuple[str, str], ...]], float]
Scrape = Callable[[], Found]


@pytest.fixture
def publisher() -> Publisher:
    return Publisher()


def scraped(metrics: Metrics) -> Found:
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(metrics.text().decode())
        for sample in family.samples
    }


def hold_counting(publisher: Publisher) -> threading.Event:
    """Publish a frame in whose counting the metrics wait until the event is set."""
    counting, go_on = threading.Event(), threading.Event()

    class Held:
        @property
        def sequence(self) -> int:
            counting.set()
            assert go_on.wait(NET_S)
            return 0

    publisher.publish("frame", "navcam_left", Held())
    assert counting.wait(NET_S)
    return go_on


def test_the_status_is_told_as_it_is_when_somebody_asks(publisher: Publisher) -> None:
    status = dict(STATUS)
    metrics = Metrics(lambda: status, lambda: {("pan_tilt", "read", "no_reply"): 3}, publisher)
    found = scraped(metrics)
    assert found["mastctl_state", (("mastctl_state", "ready"),)] == 1.0
    assert found["mastctl_state", (("mastctl_state", "moving"),)] == 0.0
    assert found["mastctl_joint_radians", (("axis", "tilt"),)] == -0.125
    assert found["mastctl_frame_age_seconds", (("camera", "navcam_left"),)] == 0.5
    assert ("mastctl_frame_age_seconds", (("camera", "navcam_right"),)) not in found
    assert found["mastctl_fault", (("code", "no_reply"), ("device", "navcam_right"))] == 1.0
    assert found["mastctl_lease_left_seconds", ()] == 4.0
    failed = (("call", "read"), ("code", "no_reply"), ("device", "pan_tilt"))
    assert found["mastctl_device_errors_total", failed] == 3.0
    labels = dict(next(labels for name, labels in found if name == "mastctl_info"))
    assert labels["mast_file"] == 'ma"st\\.yaml'
    status |= {"state": "moving", "control": None, "joints": None, "faults": []}
    found = scraped(metrics)
    assert found["mastctl_state", (("mastctl_state", "ready"),)] == 0.0
    assert not [
        name for name, _ in found if name in ("mastctl_joint_radians", "mastctl_fault", "mastctl_lease")
    ]
    metrics.close()


def operation(name: str, state: str, **more: Any) -> Operation:
    return Operation(name, state, {}, 0.0, **more)  # type: ignore[arg-type]


def test_every_metric_has_its_row_on_the_page_and_no_other(publisher: Publisher, repository: Path) -> None:
    watched: dict[str, Any] = {
        "calibration": {"verdict": "good", "pointings": 20},
        "sentinel": {"reference": "a", "level": "good", "age_s": 5.0},
    }
    metrics = Metrics(lambda: STATUS | watched, dict, publisher)
    families = text_string_to_metric_families(metrics.text().decode())
    told = {one.name for one in families if re.match("mastctl_(?!.*_created$)", one.name)}
    page = (repository / "docs/how-to/operations.md").read_text()
    rows = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `mastctl_")]
    documented = {name.removesuffix("_total") for row in rows for name in re.findall("`(mastctl_\\w+)`", row)}
    assert told == documented
    metrics.close()


def test_operations_are_counted_once_when_they_have_ended(publisher: Publisher) -> None:
    metrics = Metrics(lambda: STATUS, dict, publisher)
    publisher.publish("operation", "1", operation("1", "running"))
    publisher.publish(
        "operation",
        "1",
        operation("1", "done", result=DONE, steps=({"name": "move", "duration_s": 0.3},)),
    )
    publisher.publish("operation", "2", operation("2", "failed", error={"code": "did_not_arrive"}))
    failed = "mastctl_operations_total", (("code", "did_not_arrive"), ("state", "failed"))
    until(lambda: failed in scraped(metrics), "the second operation")
    found = scraped(metrics)
    assert found["mastctl_operations_total", (("code", ""), ("state", "done"))] == 1.0
    assert found["mastctl_step_seconds_count", (("step", "move"),)] == 1.0
    assert found["mastctl_residual_pixels_count", ()] == 2.0
    metrics.close()


def test_frames_that_nobody_got_are_counted_by_the_cameras_own_count(publisher: Publisher) -> None:
    metrics = Metrics(lambda: STATUS, dict, publisher)
    taken = "mastctl_frames_total", (("camera", "navcam_left"),)
    for number, sequence in enumerate((7, 8, 12), 1):
        publisher.publish("frame", "navcam_left", SimpleNamespace(sequence=sequence))
        until(lambda number=number: scraped(metrics).get(taken) == number, "the frame")
    assert scraped(metrics)["mastctl_frames_missed_total", (("camera", "navcam_left"),)] == 3.0
    metrics.close()


def test_what_comes_in_quick_succession_is_counted_each_and_none_of_it_as_missed(
    publisher: Publisher,
) -> None:
    metrics = Metrics(lambda: STATUS, dict, publisher)
    go_on = hold_counting(publisher)
    for sequence in (1, 2, 3):
        publisher.publish("frame", "navcam_left", SimpleNamespace(sequence=sequence))
        publisher.publish("joints", "pan_tilt", Reading(0.0, 0.0, False, 10.0 + 0.1 * sequence))
        publisher.publish("command", f"{sequence}", {"command": "stop", "result": "ok"})
        publisher.forget("command", f"{sequence}")
    publisher.publish("command", "last", {"command": "point", "result": "ok"})
    go_on.set()
    last = "mastctl_commands_total", (("command", "point"), ("result", "ok"))
    until(lambda: last in scraped(metrics), "the last of them")
    found, camera = scraped(metrics), (("camera", "navcam_left"),)
    assert found["mastctl_frames_total", camera] == 4.0
    assert found.get(("mastctl_frames_missed_total", camera), 0.0) == 0.0
    assert found["mastctl_reading_interval_seconds_count", ()] == 2.0
    assert found["mastctl_commands_total", (("command", "stop"), ("result", "ok"))] == 3.0
    metrics.close()


def test_news_that_could_not_be_counted_are_not_told_as_missed_frames(
    publisher: Publisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mastctl.control.publisher.MOST_UNREAD", 1)
    metrics = Metrics(lambda: STATUS, dict, publisher)
    go_on = hold_counting(publisher)
    for sequence in (1, 2, 3):
        publisher.publish("frame", "navcam_left", SimpleNamespace(sequence=sequence))
    go_on.set()
    taken = "mastctl_frames_total", (("camera", "navcam_left"),)
    until(lambda: scraped(metrics).get(taken) == 2.0, "the one that was kept")
    publisher.publish("frame", "navcam_left", SimpleNamespace(sequence=4))
    until(lambda: scraped(metrics).get(taken) == 3.0, "the next")
    assert scraped(metrics).get(("mastctl_frames_missed_total", taken[1]), 0.0) == 0.0
    metrics.close()


def test_readings_of_the_head_are_counted_by_the_time_between_them(publisher: Publisher) -> None:
    metrics = Metrics(lambda: STATUS, dict, publisher)
    count = "mastctl_reading_interval_seconds_count", ()
    publisher.publish("joints", "pan_tilt", Reading(0.0, 0.0, False, 10.0))
    publisher.publish("command", "1", {"command": "point", "result": "ok"})
    point = "mastctl_commands_total", (("command", "point"), ("result", "ok"))
    until(lambda: point in scraped(metrics), "what was published after it")
    publisher.publish("joints", "pan_tilt", Reading(0.0, 0.0, False, 10.04))
    until(lambda: scraped(metrics)[count] == 1.0, "the second reading")
    assert scraped(metrics)["mastctl_reading_interval_seconds_sum", ()] == pytest.approx(0.04)
    metrics.close()


def test_a_record_that_nobody_foresaw_does_not_end_the_counting(publisher: Publisher) -> None:
    metrics = Metrics(lambda: STATUS, dict, publisher)
    publisher.publish("frame", "navcam_left", object())
    publisher.publish("operation", "3", operation("3", "stopped", error={"code": "stopped"}))
    stopped = "mastctl_operations_total", (("code", "stopped"), ("state", "stopped"))
    until(lambda: stopped in scraped(metrics), "what came after it")
    metrics.close()


def test_two_daemons_in_one_process_count_each_for_itself(publisher: Publisher) -> None:
    one, other = Metrics(lambda: STATUS, dict, publisher), Metrics(lambda: STATUS, dict, Publisher())
    publisher.publish("command", "1", {"command": "stop", "result": "ok"})
    counted = "mastctl_commands_total", (("command", "stop"), ("result", "ok"))
    until(lambda: counted in scraped(one), "the command")
    assert counted not in scraped(other)
    one.close()
    other.close()

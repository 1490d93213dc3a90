"""What Prometheus reads: parsed by its own library, from news that the test publishes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from hil_tests.mastctl.service_fakes import fake_result
from hil_tests.waiting import until
from mastctl.control.operations import Operation
from mastctl.control.publisher import Publisher
from mastctl.service.metrics import Metrics

STATUS: Any = {
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
    "calibration": {"verdict": "few", "pointings": 0},
    "sentinel": {"age_s": None},
}

DONE = fake_result((6.0, 1.0, 0.0), 6.2, (0.3, -0.1))

Found = dict[tuple[str, tuple[tuple[str, str], ...]], float]


@pytest.fixture
def publisher() -> Publisher:
    return Publisher()


def scraped(metrics: Metrics) -> Found:
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(metrics.text().decode())
        for sample in family.samples
    }


def test_the_status_is_current_at_each_request(publisher: Publisher) -> None:
    status: Any = dict(STATUS)
    errors = {("pan_tilt", "read", "no_reply"): 3}
    metrics = Metrics(lambda: status, lambda: errors, dict, publisher, lambda: {"pan": 41.5})
    found = scraped(metrics)
    assert found["mastctl_state", (("mastctl_state", "ready"),)] == 1.0
    assert found["mastctl_state", (("mastctl_state", "moving"),)] == 0.0
    assert found["mastctl_joint_radians", (("axis", "tilt"),)] == -0.125
    assert found["mastctl_frame_age_seconds", (("camera", "navcam_left"),)] == 0.5
    assert ("mastctl_frame_age_seconds", (("camera", "navcam_right"),)) not in found
    assert found["mastctl_axis_temperature_celsius", (("axis", "pan"),)] == 41.5
    assert found["mastctl_fault", (("code", "no_reply"), ("device", "navcam_right"))] == 1.0
    assert found["mastctl_lease_left_seconds", ()] == 4.0
    assert found["mastctl_lease", (("kind", "lease"),)] == 1.0, "no label that clients choose"
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


def test_operations_are_counted_once_when_they_have_ended(publisher: Publisher) -> None:
    metrics = Metrics(lambda: STATUS, dict, dict, publisher)
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


def test_frames_that_were_not_requested_are_not_missed(publisher: Publisher) -> None:
    counts = {"hazcam_left": (50, 3)}
    metrics = Metrics(lambda: STATUS, dict, lambda: counts, publisher)
    for number, sequence in enumerate((7, 8, 12), 1):
        publisher.publish("frame", "navcam_left", SimpleNamespace(sequence=sequence))
        taken = "mastctl_frames_total", (("camera", "navcam_left"),)
        until(lambda number=number, taken=taken: scraped(metrics).get(taken) == number, "the frame")  # type: ignore[misc]
    found, counting = scraped(metrics), (("camera", "hazcam_left"),)
    assert [name for name in found if name[0] == "mastctl_frames_missed_total"] == [
        ("mastctl_frames_missed_total", counting)
    ]
    assert found["mastctl_frames_received_total", counting] == 50.0
    assert found["mastctl_frames_missed_total", counting] == 3.0
    metrics.close()
